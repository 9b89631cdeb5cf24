"""Halves of the images reveal pose errors that leave hardly any residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aligned_surfaces import OPTIONS, SHARP, corner, path
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement.joint_alignment import RefinedViews, refine
from tofuse.engine.refinement.split_half import split_half_errors
from tofuse.engine.stored_views.view_store import SampledView
from tofuse.engine.views.prepared_view import prepare_view


def errors(
    bend: float = 0.0, noise: float = 0.003, *, upper: bool = True
) -> tuple[tuple[float, float], tuple[float, float]]:
    """True errors (m, rad) of refined poses, and those by halves of the images.

    Parameters
    ----------
    bend
        Relative depth error at the right edge of the image; that at the left edge is opposite.
    noise
        Standard deviation of the depth, m.
    upper
        Whether the upper half of the images has depth.
    """
    truth = path(48)[:12]  # one direction only, so that errors accumulate
    rng = np.random.default_rng(5)
    views = []
    for k, T in enumerate(truth):
        frame = replace(corner(T), index=k)
        columns = np.linspace(-1, 1, frame.depth.shape[1])
        depth = frame.depth * (1 + bend * columns * np.abs(columns))
        depth += noise * rng.standard_normal(depth.shape)
        if not upper:
            depth[: len(depth) // 2] = 0
        view = prepare_view(replace(frame, depth=depth.astype(np.float32)), SHARP)
        views.append(SampledView.of(view, 1500))
    refined = refine(views, truth, OPTIONS)
    found = split_half_errors(RefinedViews(views, refined, OPTIONS))
    return displacement(truth, refined.poses), found


def test_systematic_errors_are_revealed():
    true, found = errors(bend=0.01)
    assert true[0] > 2 * errors()[0][0]
    assert found[0] > true[0]
    assert found[1] > true[1]


@pytest.mark.parametrize("noise", [0.001, 0.003, 0.01])
def test_noise_is_not_overestimated(noise):
    true, found = errors(noise=noise)
    assert found[0] < 2 * true[0]


def test_empty_half_reveals_nothing():
    """Without measurements poses stay where they are, and the other half does not count twice."""
    _, found = errors(bend=0.01, upper=False)
    assert 0 < found[0] < 0.1
    assert np.isfinite(found).all()
