"""The sessions of a merged result, and which of them overlap."""

from __future__ import annotations

from tofuse.report import words
from tofuse.report.subject import ROWS, Subject, Values
from tofuse.results.output import CHANGE_COLORS
from tofuse.results.session_words import probability_text
from tofuse.results.types import SessionChange, SessionPair


def sessions(s: Subject) -> Values:
    """Return the tables of sessions and of pairs of them; empty for a single recording."""
    records, pairs = s.result.sessions, s.result.session_pairs
    if not records:
        return {
            "sessions": [],
            "session_pairs": [],
            "sessions_text": "",
            "changes": [],
            "met": False,
        }
    rows = []
    for session in records:
        frames = [f for f in s.result.diagnostics.frames if session.has(f.index)]
        last = frames[-1].index if frames else session.first
        rows.append(
            {
                "name": session.name,
                "frames": f"{frames[0].index if frames else session.first}–{last}",
                "count": f"{len(frames):,}",
                "where": "in this map" if session.T_main_session is not None else "apart",
                "recording": ", ".join(session.opening["paths"]),
            }
        )
    unjoined = sum(session.T_main_session is None for session in records)
    text = f"{words.count(len(records), 'session')} were merged. "
    if unjoined:
        text += (
            f"For {unjoined:,} of them no overlap with the first one could be confirmed: "
            f"{'it is' if unjoined == 1 else 'they are'} not joined."
        )
    else:
        text += "All of them are in this map, in the world frame of the first."
    names = [session.name for session in records]
    overlaps = [_pair(pair, names) for pair in pairs]
    changes = [_change(change, names) for change in s.result.changes[:ROWS]]
    return {
        "sessions": rows[:ROWS],
        "session_pairs": overlaps[:ROWS],
        "sessions_text": text,
        "changes": changes,
        "met": any(pair.joined and pair.overlap > 0 for pair in pairs),
    }


def _change(record: SessionChange, names: list[str]) -> Values:
    change = record.change
    return {
        "kind": change.kind,
        "color": "#{:02x}{:02x}{:02x}".format(*CHANGE_COLORS[change.kind]),
        "sessions": f"{names[record.a]}, then {names[record.b]}",
        "centre": ", ".join(f"{x:.2f}" for x in change.centre).replace("-", "−"),
        "size": " × ".join(words.length(float(x)) for x in change.size),
        "volume": f"{1e3 * change.volume_m3:.1f} l",
    }


def _pair(pair: SessionPair, names: list[str]) -> Values:
    joined = "no"
    if pair.joined:
        joined = "before" if pair.before else "yes"
        joined += "" if pair.links or pair.overlap else ", through others"
    return {
        "names": f"{names[pair.a]}, {names[pair.b]}",
        "joined": joined,
        "overlap": words.percent(pair.overlap) if pair.joined else "–",
        "links": f"{pair.links:,}" if pair.joined else "–",
        "probability": "–" if pair.probability is None else probability_text(pair.probability),
        "support": "–" if pair.support is None else words.percent(pair.support),
    }
