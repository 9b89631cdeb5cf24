"""What papers say of their methods beside others, decided by the leaderboard's numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from leaders import Score

Scores = Mapping[str, Mapping[str, Sequence[Score]]]
# Shares of right poses that differ by less are alike.
_ALIKE = 0.05


def statements(found: Mapping[str, Scores]) -> Iterator[tuple[str, str, str]]:
    """Paper, statement, and what came out, as far as the methods were run."""
    pairs = found.get("pairs", {})
    for paper, claim, better, other, group, number in (
        *_more("Rusinkiewicz 2019", "converges from further away than point-to-plane",
               "symmetric", "point-to-plane", "start2"),
        *_more("Segal et al. 2009", "converges from further away than point-to-point",
               "gicp", "icp, point-to-point", "start2"),
        *_more("Chetverikov et al. 2005", "stands less overlap than ICP",
               "tricp", "icp, point-to-point", "apart4"),
        *_more("Magnusson 2009", "NDT converges from further away than ICP",
               "ndt", "icp, point-to-point", "start2"),
        *_more("Yang et al. 2020", "stands more outliers than least squares",
               "icp, gnc", "icp, point-to-point", "outliers0.3"),
        *_more("Chebrolu et al. 2021", "stands more outliers than point-to-plane",
               "icp, adaptive", "point-to-plane", "outliers0.3"),
        *_more("Almhdie et al. 2007", "is better among noise than ICP",
               "cicp", "icp, point-to-point", "noise0.03"),
        *_more("Gruen and Akca 2005", "converges from further away than ICP",
               "ls3d", "icp, point-to-point", "start2"),
        *_less("Pottmann et al. 2004", "is nearer than point-to-point after as few steps",
               "icp, squared-distance", "icp, point-to-point", "start1"),
        *_less("Deschaud 2018", "is nearer than point-to-plane among noise",
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
        text = f"{100 * a:.0f} % against {100 * b:.0f} %"
        return (
            f"{'agrees' if a > b + _ALIKE else 'alike' if a > b - _ALIKE else 'disagrees'}: {text}"
        )
    text = f"{1000 * a:.1f} mm against {1000 * b:.1f} mm"
    return f"{'agrees' if a < 0.95 * b else 'alike' if a < 1.05 * b else 'disagrees'}: {text}"
