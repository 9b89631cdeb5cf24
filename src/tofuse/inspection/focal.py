"""Is the focal length right? What frames say of each other, where z tells nothing by itself.

A wrong focal length stretches the world of a view sideways, and planes stay planes. But when the
camera turns, what was stretched along one direction is seen along another: the turn that the
texture tells and the one that the slope of walls tells differ, and no rigid motion fits both. So
views are aligned anew under several focal lengths, and the one under which they agree best is
right. A camera that only slides tells nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import UnreadableFrameError
from tofuse.inspection.finding import Finding
from tofuse.inspection.geometry import check_kind, wrong_focal
from tofuse.inspection.motion import Pair, aligned, aligned_pair, field_of_view
from tofuse.inspection.sample import MAP_COLUMNS, Sample, part_starts
from tofuse.recordings.frames import RangeFrame
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view

# Views that are turned by this share of the field of view tell; by less than that many degrees,
# too little.
_TURN, _LEAST_TURN = 0.25, np.radians(4.0)
_FURTHEST = 60
_FEWEST_PAIRS, _MOST_PAIRS = 6, 12
# Logarithms of the factors on the rays that are tried.
_TRIED = np.array([-0.42, -0.28, -0.14, 0.0, 0.14, 0.28, 0.42])
_HERE = 3
# How much better the views must agree, in score, and by how many standard deviations.
_LEAD, _LEAD_SIGMAS, _SIGMAS = 0.015, 1.5, 3.0
_LEAST, _AGREES, _WELL = 0.08, 0.5, 0.75


def check_focal(sample: Sample) -> Iterator[Finding]:
    """Do frames agree better under another focal length?"""
    if not sample.images or sample.images[0].depth_kind != "z" or sample.turning:
        return
    if any(check_kind(sample)):
        return
    pairs = _turned_pairs(sample)
    if len(pairs) < _FEWEST_PAIRS:
        return
    scores = np.array([_scores(pair) for pair in pairs])
    # Views that agree under none of them have another fault.
    scores = scores[scores.max(1) > _AGREES]
    if len(scores) < _FEWEST_PAIRS:
        return
    best = int(scores.mean(0).argmax())
    # At either end nothing says that it is a best one; where views hardly agree, nothing is best.
    if best in (0, _HERE, len(_TRIED) - 1) or scores[:, best].mean() < _WELL:
        return
    lead = scores[:, best] - scores[:, _HERE]
    error = float(lead.std(ddof=1)) / np.sqrt(len(lead))
    # Jackknife: what it would be without each of the pairs (Efron 1982), about the same top.
    tops = np.array([_top(np.delete(scores, k, 0).mean(0), best) for k in range(len(scores))])
    sigma = float(np.sqrt((len(tops) - 1) * tops.var()))
    log_scale = _top(scores.mean(0), best)
    if lead.mean() > max(_LEAD, _LEAD_SIGMAS * error) and abs(log_scale) > max(
        _LEAST, _SIGMAS * sigma
    ):
        factor = float(np.exp(-log_scale))
        yield wrong_focal(factor, factor * max(sigma, 0.01), "frames disagree")


def _top(score: Float64, best: int) -> float:
    """Where the parabola through an inner score and its neighbours is highest."""
    a, b, c = score[best - 1 : best + 2]
    bend = a - 2 * b + c
    shift = 0.0 if bend >= 0 else 0.5 * (a - c) / bend
    return float(_TRIED[best] + np.clip(shift, -1.0, 1.0) * (_TRIED[1] - _TRIED[0]))


def _turned_pairs(sample: Sample) -> list[Pair]:
    """Views far enough from each other, each aligned as it is."""
    out = []
    for step in sample.pairs[:_MOST_PAIRS]:
        if not step.fits:
            continue
        wanted = _TURN * field_of_view(step.first)
        gap = int(np.clip(np.round(wanted / max(step.angle, 1e-4)), 1, _FURTHEST))
        if gap * step.angle < _LEAST_TURN:
            continue
        pair = step if gap == 1 else _further(sample, step, gap)
        if pair is not None:
            out.append(pair)
    return out


def _further(sample: Sample, step: Pair, gap: int) -> Pair | None:
    """The same first frame and a later one; an earlier one at the end."""
    recording = sample.recording
    here = int(np.searchsorted(recording.indices, sample.frames[step.i].index))
    starts = [0, *part_starts(recording), len(recording)]
    part = int(np.searchsorted(starts, here, "right"))
    for k in (here + gap, here - gap):
        if not starts[part - 1] <= k < starts[part]:
            continue
        try:
            frame = recording[k]
        except UnreadableFrameError:
            continue
        if isinstance(frame, RangeFrame) and frame.valid.any():
            other = prepare_view(frame, SurfaceOptions(columns=MAP_COLUMNS))
            return aligned_pair(step.first, other, step.i, k)
    return None


def _scores(pair: Pair) -> list[float]:
    """How well the views agree under each of the focal lengths."""
    out = []
    for log_scale in _TRIED:
        scale = float(np.exp(log_scale))
        first, second = _scaled(pair.first, scale), _scaled(pair.second, scale)
        found = aligned(second, first, pair.T)
        out.append(aligned(second, first, found.T_world_source).score)
    return out


def _scaled(view: PreparedView, scale: float) -> PreparedView:
    """Return the view had its rays been longer by a factor to all sides."""
    rays = view.rays * np.float32(scale)
    planes, albedo = view.planes.copy(), view.albedo.copy()
    planes[..., :2] /= np.float32(scale)
    albedo[..., 1:] /= np.float32(scale)
    x0, y0, per_x, per_y = view.projection.frame
    frame = np.array([x0 * scale, y0 * scale, per_x / scale, per_y / scale])
    projection = replace(view.projection, rays=rays, frame=frame)
    return replace(view, rays=rays, planes=planes, albedo=albedo, projection=projection)
