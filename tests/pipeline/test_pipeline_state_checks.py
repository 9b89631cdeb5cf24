"""States with valid checksums and invalid contents: forged, or of another recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import tofuse
from kept_stages import Kept
from made_rooms import at, seen
from tofuse.files.spill import Scratch, Spill
from tofuse.fusion.mesh import Mesh
from tofuse.pipeline import reconstruct
from tofuse.pipeline.config import changed, from_method
from tofuse.pipeline.state_checks import check_tracked
from tofuse.pipeline.states import StateError, decode, encode
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.view_store import PosedView
from tofuse.recordings.recording import ArraySource, Recording
from tofuse.registration.prepared_view import PreparedView


@pytest.fixture(scope="module")
def recording() -> Recording:
    frames = [seen(at(0.1 * k, -0.5, 0.05 * k), k) for k in range(3)]
    return Recording.of(ArraySource(frames), "made", "made")


@pytest.fixture(scope="module")
def kept(recording: Recording) -> Kept:
    stages = Kept(stop_at=0)
    config = changed(from_method("default"), {"self_calibration": False}, where="test")
    reconstruct.reconstruct(recording, config, stages=stages)
    return stages


def through(state: object) -> Any:
    return decode({name: np.asarray(array) for name, array in encode(state)})


def put(item: object, name: str, value: object) -> None:
    object.__setattr__(item, name, value)


def step(tracked: Any) -> Any:
    return tracked.mapper.log.entries[1].step


FORGED: dict[str, tuple[str, Callable[[Any], None], str]] = {
    "a pose of five rows": (
        "tracking",
        lambda t: put(step(t), "T_component_camera", np.eye(5)),
        "T_component_camera of a Step has shape (5, 5)",
    ),
    "a pose that is not finite": (
        "tracking",
        lambda t: put(step(t), "T_component_camera", np.full((4, 4), np.nan)),
        "T_component_camera of a Step is not finite",
    ),
    "a pose that is a mirror": (
        "tracking",
        lambda t: put(step(t), "T_component_camera", np.diag([1.0, 1, -1, 1])),
        "has no rotation",
    ),
    "a pose of whole numbers": (
        "tracking",
        lambda t: put(step(t), "T_component_camera", np.eye(4, dtype=int)),
        "is not an array of f8",
    ),
    "a mesh without its vertices": (
        "fusion",
        lambda f: put(f[0].model.mesh, "faces", f[0].model.mesh.faces + np.int32(1 << 20)),
        "a triangle of a mesh names a vertex that is not there",
    ),
    "an edge to nowhere": (
        "refinement",
        lambda f: put(f[0].graph, "edges", f[0].graph.edges + 1000),
        "an edge names a vertex that is not there",
    ),
    "an option out of its bounds": (
        "tracking",
        lambda t: put(t.mapper.config, "memory_mb", -1),
        "memory_mb must be 500 to 10000000",
    ),
}


@pytest.mark.parametrize("name", FORGED)
def test_invalid_objects_are_refused(kept: Kept, name: str) -> None:
    stage, forge, says = FORGED[name]
    state = kept.load(stage)
    through(state)
    forge(state)
    with pytest.raises(StateError) as caught:
        through(state)
    assert says in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_view_with_inconsistent_images_is_refused(kept: Kept) -> None:
    view = kept.load("tracking").mapper.views[0].view
    assert isinstance(through(view), PreparedView)
    for name in ("rays", "z", "sigma", "planes", "plane_variance", "albedo"):
        array = getattr(view, name)
        for other in (array[:-3].copy(), array[..., :1].copy(), array.astype(np.float64)):
            with pytest.raises(StateError, match="of a PreparedView"):
                through(replace(view, **{name: other}))


def test_spilled_views_are_checked_too(kept: Kept) -> None:
    """Views beyond the memory budget are bytes in a file, with their shapes."""
    view = kept.load("tracking").mapper.views[0].view
    spill: Spill[PreparedView] = Scratch(0).part(1.0)
    for _ in range(2):
        spill.put(view)
    again = through(spill)
    np.testing.assert_array_equal(again.get(0).z, view.z)
    entry = again._entries[0]
    for shape, says in (((1, 1), "of a PreparedView has shape"), ((1 << 40, 1), "has no shape")):
        entry.shapes["z"] = shape
        with pytest.raises(StateError, match=says):
            through(again)


FOREIGN: dict[str, tuple[Callable[[Any], None], str]] = {
    "fewer frames": (lambda t: t.mapper.log.entries.pop(), "frames are kept of"),
    "more than there are": (lambda t: put(t, "done", 1000), "frames are kept of"),
    "other numbers": (
        lambda t: put(t.mapper.log.entries[1].record, "index", 77),
        "have other numbers",
    ),
    "other times": (
        lambda t: put(t.mapper.log.entries[1].record, "timestamp", -5.0),
        "have other times",
    ),
    "a reference that is not there": (lambda t: put(step(t), "reference", 99), "not there"),
    "a view that is not there": (lambda t: put(t.mapper.views[0], "index", 99), "not there"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_state_of_another_recording_is_refused(kept: Kept, recording: Recording, name: str) -> None:
    forge, says = FOREIGN[name]
    tracked = kept.load("tracking")
    check_tracked(tracked, recording)
    forge(tracked)
    with pytest.raises(ValueError, match=says):
        check_tracked(tracked, recording)


def test_all_checked_types_occur_in_a_run(kept: Kept) -> None:
    """Otherwise a class has been renamed and is no longer checked."""
    from tofuse.pipeline import state_checks

    states = [a for arrays in kept.states.values() for n, a in arrays.items() if "nodes" in n]
    text = b"".join(array.tobytes() for array in states).decode()
    rare = {"SampledView", "Cloud", "Keyframe"}
    for kind, arrays in state_checks._ARRAYS.items():
        assert f"{kind.__module__}.{kind.__qualname__}" in text or kind.__name__ in rare, kind
        annotated = {*vars(kind), *getattr(kind, "__annotations__", ())}
        inside = {"T_component_camera"} if kind is PosedView else set()
        assert set(arrays) <= annotated | inside, kind
    for kind in (Mesh, PoseGraph, PreparedView):
        assert kind in state_checks._ARRAYS


def test_replace_is_checked_like_a_constructor(kept: Kept) -> None:
    graph = kept.load("refinement")[0].graph
    with pytest.raises(tofuse.InputError):
        replace(graph, poses=graph.poses[:-1])
