"""Claims of papers about their methods, tested with the scores of the leaderboard."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from boards import Score

Scores = Mapping[str, Mapping[str, Sequence[Score]]]
# Success rates that differ by less are comparable.
_MARGIN = 0.05


def statements(found: Mapping[str, Scores]) -> Iterator[tuple[str, str, str]]:
    """Yield paper, claim and outcome, as far as the methods were run."""
    pairs = found.get("pairs", {})
    for paper, claim, better, other, group, number in (
        *_more("Rusinkiewicz 2019", "wider convergence basin than point-to-plane",
               "symmetric", "point-to-plane", "start2"),
        *_more("Segal et al. 2009", "wider convergence basin than point-to-point",
               "gicp", "icp, point-to-point", "start2"),
        *_more("Chetverikov et al. 2005", "tolerates less overlap than ICP",
               "tricp", "icp, point-to-point", "apart4"),
        *_more("Magnusson 2009", "NDT has a wider convergence basin than ICP",
               "ndt", "icp, point-to-point", "start2"),
        *_more("Yang et al. 2020", "tolerates more outliers than least squares",
               "icp, gnc", "icp, point-to-point", "outliers0.3"),
        *_more("Chebrolu et al. 2021", "tolerates more outliers than point-to-plane",
               "icp, adaptive", "point-to-plane", "outliers0.3"),
        *_more("Almhdie et al. 2007", "more robust to noise than ICP",
               "cicp", "icp, point-to-point", "noise0.03"),
        *_more("Gruen and Akca 2005", "wider convergence basin than ICP",
               "ls3d", "icp, point-to-point", "start2"),
        *_less("Pottmann et al. 2004", "more accurate than point-to-point after as few iterations",
               "icp, squared-distance", "icp, point-to-point", "start1"),
        *_less("Deschaud 2018", "more accurate than point-to-plane in noise",
               "icp, imls", "point-to-plane", "noise0.03"),
    ):  # fmt: skip
        if better in pairs and other in pairs and group in pairs[better] and group in pairs[other]:
            a, b = (_value(pairs[m][group], number) for m in (better, other))
            yield paper, claim, _outcome(a, b, number)


def _more(*row: str) -> list[tuple[str, ...]]:
    return [(*row, "right")]


def _less(*row: str) -> list[tuple[str, ...]]:
    return [(*row, "off")]


def _value(scores: Sequence[Score], number: str) -> float:
    if number == "right":
        return float(np.mean([s["right"] for s in scores]))
    return float(np.median([s["off"] for s in scores]))


def _outcome(a: float, b: float, number: str) -> str:
    if number == "right":
        text = f"{100 * a:.0f} % vs. {100 * b:.0f} %"
        outcome = (
            "confirmed" if a > b + _MARGIN else "comparable" if a > b - _MARGIN else "not confirmed"
        )
        return f"{outcome}: {text}"
    text = f"{1000 * a:.1f} mm vs. {1000 * b:.1f} mm"
    outcome = "confirmed" if a < 0.95 * b else "comparable" if a < 1.05 * b else "not confirmed"
    return f"{outcome}: {text}"
