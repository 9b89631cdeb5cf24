"""`report.html` of a comparison: the verdict, the coloured model, and where it deviates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.apps.compare.comparing import Comparison, millimetres
from tofuse.apps.compare.deviations import COVERAGE
from tofuse.apps.report import fields, html, plots, scene, thumbnails, words
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, UInt8

# Of inside, no and outside deviations, and of what was not seen: distinct for the colour-blind.
_INSIDE, _NONE, _OUTSIDE, _UNSEEN = (33, 102, 172), (240, 240, 240), (178, 24, 43), (96, 100, 108)
_MAX_POINTS, _MAX_UNSEEN = 120_000, 15_000
_LIMIT_TOLERANCES, _LIMIT_PERCENTILE = 1.5, 98.0
_BINS, _ROWS = 60, 30
_LEVELS = {"pass": "good", "fail": "failed", "undecided": "degraded"}


def limit_of(comparison: Comparison) -> float:
    """Return the deviation that has the strongest colour, m."""
    if comparison.tolerance_m is not None:
        return _LIMIT_TOLERANCES * comparison.tolerance_m
    size = np.abs(comparison.deviations.deviation)
    return max(float(np.nanpercentile(size, _LIMIT_PERCENTILE)), 1e-6)


def colors(deviation: Float64, limit: float) -> UInt8:
    """Return the colours (N, 3) of deviations, grey where there is none."""
    t = np.clip(deviation / limit, -1, 1)[:, None]
    end = np.where(t > 0, np.array(_OUTSIDE), np.array(_INSIDE))
    mixed = np.array(_NONE) + np.abs(t) * (end - np.array(_NONE))
    return np.where(np.isfinite(t), np.nan_to_num(mixed), np.array(_UNSEEN)).astype(np.uint8)


def write_compare_report(comparison: Comparison, path: Path) -> None:
    """Write the page to `path`.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    drawn, field = compare_scene(comparison)
    limit = limit_of(comparison)
    names = [
        Path(n).name or n for n in (comparison.measured.name, comparison.reference.surface.name)
    ]
    head, _, rest = comparison.sentence.partition(": ")
    level = _LEVELS.get(
        str(comparison.verdict or ("undecided" if comparison.reason else "")), "note"
    )
    regions = [r for r in comparison.regions if r.places]
    regions.sort(key=lambda r: -abs(r.worst_m))
    unseen = [r for r in comparison.regions if not r.places]
    ends = [f"{s}{quantities.length(limit)}" for s in ("\N{MINUS SIGN}", "+")]
    html.write_page(
        path,
        "compare.html.j2",
        title=f"{names[0]} compared with {names[1]}",
        script=html.script(charts=True),
        comparison=comparison,
        level=level,
        sentence=(head, rest) if rest and comparison.verdict else ("", comparison.sentence),
        facts=_facts(comparison),
        scene=scene.packed(drawn) | {"fields": {field.name: field.packed()}},
        still=thumbnails.data_uri(scene.render(drawn, yaw=scene.opening_yaw(drawn))),
        gradient=", ".join(thumbnails.css(c) for c in (_INSIDE, _NONE, _OUTSIDE)),
        unseen_color=thumbnails.css(_UNSEEN),
        ends=ends,
        histogram=_histogram(comparison),
        regions=regions[:_ROWS],
        more=words.more(len(regions) - _ROWS),
        unseen=unseen,
        worst=sorted(comparison.worst, key=lambda row: -abs(row["deviation_m"]))[:_ROWS],
        expanded=COVERAGE,
        mm=_signed,
    )


def _facts(comparison: Comparison) -> list[tuple[str, str]]:
    places = comparison.deviations.places
    facts = [] if comparison.tolerance_m is None else [
        ("Tolerance", f"±{1e3 * comparison.tolerance_m:g} mm")
    ]  # fmt: skip
    finite = np.isfinite(places.sigma)
    sigma = COVERAGE * float(np.median(places.sigma))
    facts += [
        ("Seen", quantities.percent(comparison.seen)),
        ("Places", f"{len(places.deviation):,}"),
    ]
    if finite.any():
        limit = float(np.median(places.detectable))
        facts.append(("Typical uncertainty", f"{millimetres(sigma)} mm"))
        facts.append(("Typical detection limit", f"{millimetres(limit)} mm"))
    return facts


def _signed(metres: float) -> str:
    if not np.isfinite(metres):
        return "–"
    return ("+" if metres >= 0 else "\N{MINUS SIGN}") + millimetres(abs(metres))


def compare_scene(comparison: Comparison) -> tuple[scene.Scene, fields.Field]:
    """Return the coloured points and what was not seen, y down, and their sigma."""
    found, reference = comparison.deviations, comparison.reference
    rows = np.flatnonzero(np.isfinite(found.deviation))
    total = len(rows)
    rows = rows[scene.random_subset(total, _MAX_POINTS)]
    unseen = np.flatnonzero(~found.seen)
    unseen = unseen[scene.random_subset(len(unseen), _MAX_UNSEEN)]
    points = np.concatenate([found.points[rows], reference.centres[unseen]])
    normals = np.concatenate([found.normals[rows], reference.normals[unseen]])
    limit = limit_of(comparison)
    missing = np.full(len(unseen), np.nan)
    shown = np.concatenate([found.deviation[rows], missing])
    R = reference.surface.R_shown
    # CAD models are z up; seen from above only if what was measured faces there.
    if not reference.surface.is_result and found.normals[:, 2].sum() > 0:
        R = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    drawn = scene.Scene(
        points @ R.T,
        colors(shown, limit),
        normals @ R.T,
        total + len(unseen),
        scene.spacing_of(points),
    )
    sigma = np.concatenate([found.sigma[rows], missing])
    finite = sigma[np.isfinite(sigma)]
    high = max(float(np.percentile(finite, 98)), 1e-6) if len(finite) else 1e-3
    labels = "0", quantities.length(high / 2), quantities.length(high)
    return drawn, fields.Field("sigma", "Sigma", sigma, 0.0, high, labels, (0.0, high))


def _histogram(comparison: Comparison) -> dict[str, object]:
    limit = 2 * limit_of(comparison)
    d = np.clip(comparison.deviations.places.deviation, -limit, limit)
    edges = 1e3 * np.linspace(-limit, limit, _BINS + 1)
    counts = np.histogram(1e3 * d, edges, weights=comparison.deviations.places.points)[0]
    share = 100 * counts / max(counts.sum(), 1)
    return plots.lines(
        0.5 * (edges[1:] + edges[:-1]),
        {"after": share},
        label="Histogram of the deviations of places",
        ylabel="share of the surface, %",
        xlabel="deviation, mm",
        floor=True,
    )
