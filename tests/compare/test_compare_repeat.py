"""Repeated results: variance components and whether the stated bounds hold."""

from __future__ import annotations

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from measured_parts import NOISE, drawn, scan
from tofuse.apps.compare import comparing
from tofuse.apps.compare.deviations import mapped
from tofuse.apps.compare.nearest import Reach, Reference
from tofuse.apps.compare.repeating import (
    Session,
    _pose_differences,
    components,
    loaded_sessions,
    repeated,
)
from tofuse.apps.compare.surface import spacing_of
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.progress import Silent
from written_run_json import change_run


def test_components_are_those_of_the_model() -> None:
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(4), 3)
    values = rng.normal(0, 0.003, (2000, 4))[:, group] + rng.normal(0, 0.002, (2000, 12))
    values += rng.normal(0, 1, (2000, 1))  # of the places themselves
    found = components("surface", "m", values, group)
    assert found.repeatability == pytest.approx(0.002, rel=0.05)
    assert found.reproducibility == pytest.approx(0.003, rel=0.05)
    assert found.total == pytest.approx(np.hypot(0.002, 0.003), rel=0.05)
    assert (found.within, found.between) == (8, 3)


def test_components_that_are_not_determined_are_none() -> None:
    values = np.random.default_rng(1).normal(size=(50, 3))
    one = components("surface", "m", values, np.zeros(3, np.intp))
    assert one.reproducibility is None
    assert one.repeatability == pytest.approx(1, rel=0.2)
    single = components("surface", "m", values, np.arange(3))
    assert single.repeatability is None
    assert single.total == single.reproducibility == pytest.approx(1, rel=0.2)


def sessions(stated: float, shared: float) -> list[Session]:
    """Two sessions of two scans; the surface of the second session is farther out at one side."""
    part = Reference.of(drawn())
    found = []
    for k in range(4):
        surface = scan(part, k, 8000, stated)
        d = shared * np.cos(30 * surface.points[:, 0]) * (k // 2)
        points = surface.points + d[:, None] * surface.normals
        found.append(Session(str(k), f"day {k // 2}", None, replace(surface, points=points)))
    return found


def test_differences_between_sessions_are_separated() -> None:
    found = repeated(sessions(0.0002, 0.001), searched=False)
    surface = found.components[0]
    assert surface.repeatability is not None
    assert surface.reproducibility is not None
    assert surface.repeatability < 0.7 * NOISE  # of means of points
    assert surface.reproducibility > 3 * surface.repeatability
    assert found.components[1].name == "dimension"
    assert found.held[0].share < 0.9  # of bounds that are too small
    assert any("poses are not compared" in text for text in found.warnings)
    honest = repeated(sessions(0.0005, 0.0), searched=False).held[0]
    assert honest.share > 0.95
    assert honest.low < honest.share <= honest.high
    assert found.to_dict()["components"][0]["unit"] == "m"


def test_the_noise_of_the_reference_is_not_in_the_bounds_of_differences() -> None:
    part = Reference.of(drawn())
    first, second = (scan(part, k, 12_000, NOISE) for k in range(2))
    reference = Reference.of(first)
    reach = Reach.of(reference, spacing_of(first.points))
    places = mapped(first, reference, np.eye(4), reach).places
    with_reference, alone = (
        mapped(second, reference, np.eye(4), reach, centres=centres).places
        for centres in (None, places)
    )
    variance, own = (np.median(at.sigma**2 * at.points) for at in (with_reference, alone))
    assert own == pytest.approx(0.5 * variance, rel=0.15)  # both surfaces have the same noise


def test_another_place_is_refused(monkeypatch) -> None:
    """Also without a bound on its poses, which alone is no reason."""
    one, other = (
        replace(s, surface=replace(s.surface, shared_m=np.inf)) for s in sessions(1, 0)[:2]
    )
    for believed in (True, False):
        found = SimpleNamespace(T_target_source=np.eye(4), believed=believed)
        reason = "" if believed else "the registration is not accepted"
        monkeypatch.setattr(comparing, "_registered", lambda *_, f=found, r=reason: (f, "", r))
        if believed:
            assert repeated([one, other]).common > 0.5
        else:
            with pytest.raises(InputError, match="not accepted"):
                repeated([one, other])


def with_poses(trajectories: list[np.ndarray], shift: np.ndarray) -> list[Session]:
    results = [SimpleNamespace(trajectory=each, shift=shift) for each in trajectories]
    return [Session("", "", result, None) for result in results]  # type: ignore[arg-type]


def test_poses_in_map_coordinates_are_those_of_their_surfaces() -> None:
    path = se3.exp(np.linspace(0, 1, 5)[:, None] * np.eye(6)[0])
    shift, turn = np.array([500_000.0, 5_000_000.0, 0.0]), se3.exp(0.02 * np.eye(6)[5])
    other = se3.translation(shift) @ turn @ se3.translation(-shift)  # of what is in its file
    results = with_poses([path, se3.inverse(turn) @ path], shift)
    motions = _pose_differences(results, np.stack([np.eye(4), other]), 4.0)
    np.testing.assert_allclose(motions, 0.0, atol=1e-6)


def test_a_camera_that_turned_elsewhere_did_not_repeat_its_path() -> None:
    turns = se3.exp(np.linspace(0, 0.6, 5)[:, None] * np.eye(6)[4])
    ends = [turns, turns @ se3.exp(0.02 * np.eye(6)[4]), turns @ se3.exp(0.3 * np.eye(6)[4])]
    results = with_poses(ends, np.zeros(3))
    same = _pose_differences(results[:2], np.stack([np.eye(4)] * 2), 4.0)
    np.testing.assert_allclose(same[:, 4, 1], 0.02)
    assert "did not repeat" in _pose_differences(results[::2], np.stack([np.eye(4)] * 2), 4.0)


def test_results_of_the_same_frames_are_refused(room_result, tmp_path) -> None:
    again = shutil.copytree(room_result, tmp_path / "again")
    with pytest.raises(InputError, match="same recording"):
        loaded_sessions([room_result, again], Silent())


def test_arrays_in_memory_are_not_one_recording(room_result, tmp_path) -> None:
    folders = [shutil.copytree(room_result, tmp_path / name) for name in "ab"]
    for folder in folders:
        facts = {"path": "arrays", "format": "arrays", "frames": 3, "opening": None}
        change_run(folder, input=facts)
    assert len(loaded_sessions(folders, Silent())) == 2


def test_folders_of_the_same_name_are_other_sessions(room_result, tmp_path) -> None:
    parents = [tmp_path / name for name in ("monday/results", "tuesday/results", "wednesday")]
    folders = [shutil.copytree(room_result, parent / "a") for parent in parents]
    folders.append(shutil.copytree(room_result, parents[0] / "b"))
    for folder in folders:
        facts = {"path": "arrays", "format": "arrays", "frames": 3, "opening": None}
        change_run(folder, input=facts)
    found = [session.session for session in loaded_sessions(folders, Silent())]
    assert found == [str(parents[0]), str(parents[1]), "wednesday", str(parents[0])]


def test_a_single_result_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="two or more"):
        loaded_sessions([tmp_path], Silent())
