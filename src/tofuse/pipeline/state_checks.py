"""Validation of the objects of a state before they are used.

Objects of a state are filled, not constructed, and compiled code does not check array bounds. So
the checks of constructors are repeated here, and arrays must have the types and shapes that their
classes declare.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofuse.files.spill import _Entry
from tofuse.fusion.cloud import Cloud
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.range_view import RangeView
from tofuse.geometry import se3
from tofuse.kernels.alignment import PIXEL_SIZE, POINT_SIZE
from tofuse.odometry.base import Step
from tofuse.odometry.keyframe_map import Keyframe
from tofuse.pipeline.frame_log import Entry
from tofuse.posegraph.graph import PoseGraph
from tofuse.posegraph.refinement import Refinement
from tofuse.posegraph.view_store import CoarseView, PosedView
from tofuse.registration.base import Registration
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projection import Projection
from tofuse.results.samples import FrameSample
from tofuse.results.types import FrameRecord

if TYPE_CHECKING:
    from tofuse.pipeline.reconstruct import TrackingState
    from tofuse.recordings.recording import Recording

# Type and shape of arrays; letters stand for sizes, equal within one object. Exclamation mark: all
# values are finite. Attributes that an object lacks, or that are None, are not checked.
_ARRAYS: dict[type, dict[str, str]] = {
    PreparedView: {
        "rays": "f4 H W 2", "z": "f4 H W", "sigma": "f4 H W", "planes": "f4 H W 4",
        "plane_variance": "f4 H W", "albedo": "f4 H W 3", "pixel_variance": "f4 H W",
        "target": f"f4 H W {PIXEL_SIZE}",
    },
    Projection: {"rays": "f4 H W 2", "lookup": "f4 A B 2", "frame": "f8! 4", "lengths2": "f4 H W"},
    CoarseView: {"points": f"f4 N {POINT_SIZE}", "target": f"f4 H W {PIXEL_SIZE}"},
    RangeView: {"z": "u2 H W", "normals": "i1 H W 3", "strength": "u1 H W"},
    Step: {"T_component_camera": "f8! 4 4", "moving": "b1 H W"},
    Keyframe: {"T_component_camera": "f8! 4 4"},
    PosedView: {"T_component_camera": "f8! 4 4"},
    Registration: {"T_target_source": "f8! 4 4", "information": "f8! 6 6",
                   "unobservable": "f8! N 6"},
    FrameRecord: {"covariance": "f8 6 6", "unobservable": "f8! N 6"},
    Entry: {"T_odometry": "f8! 4 4", "gravity": "f8! 4"},
    FrameSample: {"depth": "f2 H W", "fate": "u1 H W", "amplitude": "f4 H W"},
    PoseGraph: {"ids": "i8 N", "poses": "f8! N 4 4", "edges": "i8 M 2", "loop": "b1 M",
                "measurements": "f8! M 4 4", "information": "f8! M 6 6"},
    Refinement: {"poses": "f8! N 4 4"},
    Mesh: {"vertices": "f4! N 3", "faces": "i4 M 3", "normals": "f4 N 3", "color": "u1 N 3",
           "sigma": "f4 N", "views": "i4 N", "offset": "f8! 3"},
    Cloud: {"points": "f4! N 3", "normals": "f4 N 3", "color": "u1 N 3", "sigma": "f4 N",
            "views": "i4 N", "offset": "f8! 3"},
}  # fmt: skip


def check_objects(items: Iterable[Any]) -> None:
    """Reject objects of the package that their constructors would not accept.

    Raises
    ------
    ValueError, InputError
        With the name of the invalid attribute. Constructors may raise others.
    """
    objects = list(items)
    # Spilled objects are in a file: an entry has their shapes, and the object without arrays.
    entries = [item for item in objects if type(item) is _Entry]
    shells = {id(entry.shell) for entry in entries}
    for entry in entries:
        arrays = dict(vars(entry.shell))
        for name, shape in entry.shapes.items():
            arrays[name] = np.broadcast_to(np.zeros((), arrays[name].dtype), _sizes(shape))
        check_arrays(type(entry.shell), arrays)
    for item in objects:
        if id(item) in shells:
            continue
        post_init = getattr(item, "__post_init__", None)
        if post_init is not None:
            post_init()
        check_arrays(type(item), vars(item))
        if type(item) is Mesh and not _within(item.faces, len(item.vertices)):
            raise ValueError("a triangle of a mesh names a vertex that is not there")


def check_arrays(kind: type, attributes: Mapping[str, Any]) -> None:
    """Reject attributes of a class that do not have the declared types and shapes.

    Raises
    ------
    ValueError, InputError
        With the name of the attribute.
    """
    sizes: dict[str, int] = {}
    for name, declared in _ARRAYS.get(kind, {}).items():
        array = attributes.get(name)
        if array is None:
            continue
        code, *dimensions = declared.split()
        if not isinstance(array, np.ndarray) or array.dtype != np.dtype(code.rstrip("!")):
            raise ValueError(f"{name} of a {kind.__name__} is not an array of {code.rstrip('!')}")
        fits = len(array.shape) == len(dimensions) and all(
            size == (int(dimension) if dimension.isdecimal() else sizes.setdefault(dimension, size))
            for size, dimension in zip(array.shape, dimensions, strict=True)
        )
        if not fits:
            raise ValueError(f"{name} of a {kind.__name__} has shape {array.shape}")
        if code.endswith("!") and not np.isfinite(array).all():
            raise ValueError(f"{name} of a {kind.__name__} is not finite")
        if name.startswith("T_"):
            se3.check_pose(array, where=f"{name} of a {kind.__name__}")


def check_tracked(tracked: TrackingState, recording: Recording) -> None:
    """Reject a state of tracking of another recording.

    Raises
    ------
    ValueError
        With the difference.
    """
    entries = tracked.mapper.log.entries
    n_done = tracked.done
    if type(n_done) is not int or not 0 <= n_done <= len(recording) or len(entries) != n_done:
        raise ValueError(f"{len(entries)} frames are kept of {n_done} that were tracked")
    indices = [entry.record.index for entry in entries]
    times = np.array([entry.record.timestamp for entry in entries])
    if indices != recording.indices[:n_done].tolist():
        raise ValueError("the frames that were tracked have other numbers")
    if not np.array_equal(times, recording.timestamps[:n_done]):
        raise ValueError("the frames that were tracked have other times")
    tracked_frames = set(indices)
    for entry in entries:
        step = entry.step
        referenced = [] if step is None else [k for link in step.links for k in (link.i, link.j)]
        if step is not None and step.reference is not None:
            referenced.append(step.reference)
        if not tracked_frames.issuperset(referenced):
            raise ValueError(f"frame {entry.record.index} was registered to one that is not there")
    if not tracked_frames.issuperset(view.index for view in tracked.mapper.views):
        raise ValueError("a view is of a frame that is not there")


def _within(index: NDArray[Any], count: int) -> bool:
    return not index.size or bool(index.min() >= 0 and index.max() < count)


def _sizes(shape: Any) -> tuple[int, ...]:
    sizes = tuple(shape)
    if not all(type(size) is int and 0 <= size < 1 << 31 for size in sizes):
        raise ValueError("an array that was put away has no shape")
    return sizes
