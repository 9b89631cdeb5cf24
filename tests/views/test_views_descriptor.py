"""Similarity of views: the slightly rotated view ranks first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_descriptors import (
    DescriptorIndex,
    dissimilarity,
    mutual_dissimilarity,
    view_descriptor,
)
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.simulation.render import render
from tofuse.lab.world.scene import build


@pytest.fixture(scope="module")
def views():
    """A rotation in the room, in steps of 19 degrees."""
    scene, path = build("room")
    effects = Effects.none(shot_noise=True)
    model = camera_model("sr4000")
    return [
        prepare_view(render(scene, path, model, k, effects=effects).frame, SurfaceOptions())
        for k in range(0, 384, 20)
    ]


@pytest.fixture(scope="module")
def descriptors(views):
    return np.stack([view_descriptor(view) for view in views])


def test_descriptor_is_mean_log_depth_and_albedo_of_cells(views, descriptors) -> None:
    view = views[0]
    made = descriptors[0]
    assert made.shape == (2, 9, 12)
    rows, columns = view.z.shape
    for i, j in ((0, 0), (4, 7), (8, 11)):
        cell = [
            (r, c)
            for r in range(rows)
            for c in range(columns)
            if r * 9 // rows == i and c * 12 // columns == j
        ]
        depth = [np.log(view.z[r, c]) for r, c in cell if view.z[r, c] > 0]
        light = [view.albedo[r, c, 0] for r, c in cell if np.isfinite(view.albedo[r, c, 0])]
        assert made[0, i, j] == pytest.approx(np.mean(depth), rel=1e-5)
        if 3 * len(light) > len(cell):
            assert made[1, i, j] == pytest.approx(np.mean(light), rel=1e-5)
        else:
            assert np.isnan(made[1, i, j])
    assert np.isfinite(made[1]).sum() > 20
    empty = replace(view, z=np.where(np.arange(columns) < columns // 2, 0, view.z))
    assert np.isnan(view_descriptor(empty)[0, :, :6]).all()
    np.testing.assert_array_equal(view_descriptor(empty)[0, :, 6:], made[0, :, 6:])


def test_same_view_is_most_similar(descriptors) -> None:
    for k, descriptor in enumerate(descriptors):
        far = dissimilarity(descriptor, descriptors, 0.25)
        assert far[k] == 0
        assert np.delete(far, k).min() > 0.02


def test_neighbours_are_more_similar_than_distant_views(descriptors) -> None:
    """They overlap by more than half: with a shift of half the width a neighbour ranks first."""
    for k, descriptor in enumerate(descriptors[:-1]):
        far = dissimilarity(descriptor, descriptors, 0.5)
        far[k] = np.inf
        assert {k - 1, k + 1} & set(np.argsort(far)[:2]), k


def test_dissimilarity_to_many_matches_mutual_dissimilarity(descriptors) -> None:
    mutual = mutual_dissimilarity(descriptors, 0.25)
    for k, descriptor in enumerate(descriptors):
        np.testing.assert_array_equal(
            mutual[k, k:], dissimilarity(descriptor, descriptors[k:], 0.25)
        )


def test_unknown_cells_are_dissimilar(descriptors) -> None:
    descriptor = descriptors[0]
    nothing = np.full_like(descriptor, np.nan)
    far = dissimilarity(descriptor, np.stack([nothing, descriptor, descriptor + 10.0]), 0.25)
    assert far[1] == 0
    # A constant difference is exposure for albedo, but another place for depth.
    np.testing.assert_allclose(far[[0, 2]], [1.0, 0.5], atol=1e-5)


def test_index_finds_neighbours_first(descriptors) -> None:
    for k in range(1, len(descriptors) - 1):
        others = np.delete(descriptors, k, axis=0)
        nearest = DescriptorIndex(others).most_similar(descriptors[k], 0.5)
        assert sorted(nearest) == list(range(len(others)))
        assert nearest[0] in (k - 1, k)


def test_views_exposed_alike_differ_by_their_albedo(descriptors) -> None:
    """A darker scene of the same shape is another one, unless the exposure is unknown."""
    darker, nearer = descriptors[:1].copy(), descriptors[:1].copy()
    darker[:, 1] -= 0.3
    nearer[:, 0] -= 0.01
    assert dissimilarity(descriptors[0], darker, 0.25) == pytest.approx(0, abs=1e-6)
    index = DescriptorIndex(np.concatenate([darker, nearer]))
    assert index.most_similar(descriptors[0], 0.25).tolist() == [1, 0]
