"""The sessions of a merged map in words."""

from __future__ import annotations

from tofuse.engine.quantities import count, percent, probability
from tofuse.engine.results import Reconstruction, SessionPair


def session_sentences(result: Reconstruction) -> list[str]:
    """Return a sentence for each pair of joined sessions, and for each that was not joined."""
    names = [session.name for session in result.sessions]
    sentences = []
    for pair in result.session_pairs:
        if not pair.joined:
            continue
        names_of_pair = f"{names[pair.a]} and {names[pair.b]}"
        if pair.links or pair.overlap:
            sentences.append(f"{names_of_pair} overlap: {', '.join(overlap_evidence(pair))}.")
        else:
            sentences.append(f"{names_of_pair} are in one map, but do not overlap.")
    sentences += [
        f"{s.name} is not joined: no overlap with the first session could be confirmed."
        for s in result.sessions
        if s.T_main_session is None
    ]
    for pair in result.session_pairs:
        if changes := change_counts(result, pair):
            sentences.append(f"Between {names[pair.a]} and {names[pair.b]} {changes}.")
    return sentences


def change_counts(result: Reconstruction, pair: SessionPair) -> str:
    """Describe changed surfaces: "2 surfaces appeared and 1 vanished"; empty if none changed."""
    kinds = [c.change.kind for c in result.changes if (c.a, c.b) == (pair.a, pair.b)]
    counts = [(kinds.count(kind), kind) for kind in ("appeared", "vanished") if kind in kinds]
    if not counts:
        return ""
    (n, kind), *more = counts
    return " and ".join([f"{count(n, 'surface')} {kind}", *(f"{n} {kind}" for n, kind in more)])


def overlap_evidence(pair: SessionPair) -> list[str]:
    """Return the evidence for an overlap: "86 % of the views", "8 registrations", ..."""
    evidence = [f"{percent(pair.overlap)} of the views"]
    if pair.links:
        evidence.append(count(pair.links, "registration"))
    if pair.probability is not None:
        evidence.append(f"right with a probability of {probability(pair.probability)}")
    if pair.support is not None:
        evidence.append(f"{percent(pair.support)} of the overlapping measurements agree")
    return evidence
