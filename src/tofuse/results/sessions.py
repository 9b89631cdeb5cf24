"""What to say of several sessions in one map."""

from __future__ import annotations

from tofuse.results.types import Reconstruction, SessionPair

# No model of probabilities is to be trusted beyond this.
AS_GOOD_AS_CERTAIN = 0.999


def sentences(result: Reconstruction) -> list[str]:
    """One sentence for each two sessions in one model, and one for each that stays apart."""
    names = [session.name for session in result.sessions]
    found = []
    for pair in result.session_pairs:
        if not pair.joined:
            continue
        both = f"{names[pair.a]} and {names[pair.b]}"
        if pair.links or pair.overlap:
            found.append(f"{both} overlap: {', '.join(evidence(pair))}.")
        else:
            found.append(f"{both} are in one map, but see nothing in common.")
    found += [
        f"{s.name} stays apart: no overlap with the first session could be confirmed."
        for s in result.sessions
        if s.T_main_session is None
    ]
    for pair in result.session_pairs:
        count = changed(result, pair)
        if count:
            found.append(f"Between {names[pair.a]} and {names[pair.b]} {count}.")
    return found


def changed(result: Reconstruction, pair: SessionPair) -> str:
    """How many surfaces changed: "2 surfaces appeared and 1 vanished"; empty if none did."""
    kinds = [c.change.kind for c in result.changes if (c.a, c.b) == (pair.a, pair.b)]
    counts = [(kinds.count(kind), kind) for kind in ("appeared", "vanished") if kind in kinds]
    if not counts:
        return ""
    (n, kind), *more = counts
    return " and ".join(
        [f"{n} surface{'s' * (n > 1)} {kind}", *(f"{n} {kind}" for n, kind in more)]
    )


def evidence(pair: SessionPair) -> list[str]:
    """What speaks for an overlap: "86 % of the views", "8 registrations", ..."""
    found = [f"{_percent(pair.overlap)} of the views"]
    if pair.links:
        found.append(f"{pair.links} registration{'s' * (pair.links > 1)}")
    if pair.probability is not None:
        found.append(f"right with a probability of {probability(pair.probability)}")
    if pair.support is not None:
        found.append(f"{_percent(pair.support)} of what both saw agrees")
    return found


def _percent(share: float) -> str:
    """Down, so that only all of it is 100 %."""
    return f"{int(100 * share)} %"


def probability(value: float) -> str:
    """In words, no more exact than it can be known: "99.5 %", "over 99.9 %"."""
    if value >= AS_GOOD_AS_CERTAIN:
        return f"over {100 * AS_GOOD_AS_CERTAIN:.1f} %"
    return f"{100 * value:.1f} %"
