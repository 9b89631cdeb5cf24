"""The sessions of a merged map in words."""

from __future__ import annotations

from tofuse.engine.quantities import percent
from tofuse.engine.results import Reconstruction, SessionPair

# Higher probabilities can't be justified by any model.
MAX_STATED_PROBABILITY = 0.999


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
        count = change_counts(result, pair)
        if count:
            sentences.append(f"Between {names[pair.a]} and {names[pair.b]} {count}.")
    return sentences


def change_counts(result: Reconstruction, pair: SessionPair) -> str:
    """Describe changed surfaces: "2 surfaces appeared and 1 vanished"; empty if none changed."""
    kinds = [c.change.kind for c in result.changes if (c.a, c.b) == (pair.a, pair.b)]
    counts = [(kinds.count(kind), kind) for kind in ("appeared", "vanished") if kind in kinds]
    if not counts:
        return ""
    (n, kind), *more = counts
    return " and ".join(
        [f"{n} surface{'s' * (n > 1)} {kind}", *(f"{n} {kind}" for n, kind in more)]
    )


def overlap_evidence(pair: SessionPair) -> list[str]:
    """Return the evidence for an overlap: "86 % of the views", "8 registrations", ..."""
    evidence = [f"{percent(pair.overlap)} of the views"]
    if pair.links:
        evidence.append(f"{pair.links} registration{'s' * (pair.links > 1)}")
    if pair.probability is not None:
        evidence.append(f"right with a probability of {probability_text(pair.probability)}")
    if pair.support is not None:
        evidence.append(f"{percent(pair.support)} of the overlapping measurements agree")
    return evidence


def probability_text(value: float) -> str:
    """Return a probability as text, no closer to 1 than can be justified: "over 99.9 %"."""
    if value >= MAX_STATED_PROBABILITY:
        return f"over {100 * MAX_STATED_PROBABILITY:.1f} %"
    return f"{100 * value:.1f} %"
