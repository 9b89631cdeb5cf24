"""Selection of the views that the global stages work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views.view_store import Spacing, ViewStore


@dataclass(frozen=True, eq=False)
class Look:
    """A view of which only the pose matters."""

    index: int
    depth: float = 2.0


def turn(steps: int = 72) -> list[Float64]:
    """One turn of the camera about its vertical axis."""
    return [se3.exp(np.array([0, 0, 0, 0, 2 * np.pi * k / steps, 0])) for k in range(steps)]


def stored(turns: int, spacing: Spacing) -> list[int]:
    store: ViewStore[Look] = ViewStore(spacing)
    for k, T in enumerate(turn() * turns):
        store.push(Look(k), T)
    return [view.index for view in store.views]


def test_views_are_stored_when_the_camera_has_moved() -> None:
    # Steps are of 0.087 rad.
    assert stored(1, Spacing(angle=0.03)) == list(range(72))
    assert stored(1, Spacing(angle=0.17)) == list(range(0, 72, 2))


def test_views_are_spaced_more_sparsely_as_their_number_grows() -> None:
    found = stored(3, Spacing(angle=0.03, max_views=30, max_stretch=4))
    assert set(np.diff(found)[-20:]) == {2}


def test_views_of_a_path_that_repeats_itself_are_thinned() -> None:
    spacing = Spacing(angle=0.03, max_views=30, max_stretch=4, views_per_place=8)
    few, many = len(stored(20, spacing)), len(stored(160, spacing))
    assert few > 8 * 72 / 2
    assert many < 3 * few
    late = [k for k in stored(160, spacing) if k > 80 * 72]
    # Wherever the camera looks, some views of later turns are stored as well.
    assert np.histogram(np.mod(late, 72), bins=9)[0].min() > 0


def test_required_frames_are_always_stored() -> None:
    store: ViewStore[Look] = ViewStore(Spacing(angle=1.0), always=[5, 6])
    for k in range(10):
        store.push(Look(k), np.eye(4))
    assert [view.index for view in store.views] == [0, 5, 6]


def test_views_are_reduced_only_if_they_are_stored() -> None:
    store: ViewStore[Look] = ViewStore(Spacing(angle=1.0))
    reduced: list[int] = []

    def smaller(view: Look) -> Look:
        reduced.append(view.index)
        return Look(view.index, 1.0)

    for k in range(3):
        store.push(Look(k), np.eye(4), 0, smaller)
    assert reduced == [0]
    assert store.views[0].depth == 1.0
