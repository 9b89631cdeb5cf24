"""People and boxes that pass through the view of a moving camera."""

from __future__ import annotations

import numpy as np
import pytest

from tofuse.engine.geometry.rays import unit_rays
from tofuse.formats.images.images import read_image
from tofuse.lab.simulation.effects import Effects, Flag
from tofuse.lab.simulation.passing import Passing
from tofuse.lab.simulation.record import plan, simulate, simulate_recording


def covered(made, step=3):
    """Fraction of the image that the passing object covers in each frame (N,)."""
    ids = list(made.scene.passing_surfaces)
    rays = unit_rays(made.model.camera.rays()[::step, ::step].reshape(-1, 2))
    out = []
    for raw in made.raw:
        t = raw / made.sequence.frame_rate_hz
        T = made.sequence.T_room_camera(t)
        hits = made.scene.cast(T[:3, 3], rays @ T[:3, :3].T, made.sequence.T_room_bodies(t))
        out.append(np.isin(hits.surface, ids).mean())
    return np.array(out)


@pytest.mark.parametrize("kind", ["person", "box"])
@pytest.mark.parametrize("scene", ["room", "flat", "rail"])
@pytest.mark.parametrize("share", [0.10, 0.25, 0.40])
def test_passing_object_covers_requested_fraction(kind, scene, share) -> None:
    part = covered(plan(scene, passing=Passing(kind, share), every=6, frames=40))
    seen = part > 0.02
    assert 0.25 < seen.mean() < 0.6
    assert 0.6 * share < part[seen].mean() < 1.5 * share
    # It enters and leaves at least once.
    assert (np.diff(seen.astype(int)) == 1).sum() >= 1
    assert (np.diff(seen.astype(int)) == -1).sum() >= 1


def test_ground_truth_is_unaffected_by_passing_object() -> None:
    plain, passed = plan("flat", frames=20), plan("flat", frames=20, passing=Passing())
    np.testing.assert_array_equal(plain.poses, passed.poses)
    np.testing.assert_array_equal(plain.scene.truth_mesh()[0], passed.scene.truth_mesh()[0])
    assert passed.scene.triangles > plain.scene.triangles
    assert not plain.scene.passing_surfaces


def test_passing_pixels_are_flagged_and_nearer(tmp_path) -> None:
    options = {"every": 3, "frames": 3, "first": 66, "effects": Effects.none()}
    passing = Passing("box", 0.3, start_s=-1.0)
    path = simulate("rail", tmp_path / "rail", passing=passing, **options)
    flags = read_image(path / "truth" / "flags" / "000000.png") & Flag.PASSING > 0
    assert 0.15 < flags.mean() < 0.6
    memory = simulate_recording("rail", passing=passing, **options)
    empty = simulate_recording("rail", **options)
    nearer = memory[0].z < empty[0].z - 0.05
    assert nearer[flags].mean() > 0.9
    assert nearer[~flags].mean() < 0.02
    np.testing.assert_array_equal(memory.reference, empty.reference)
