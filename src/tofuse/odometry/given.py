"""Poses from elsewhere in place of tracking: to refine them, and to see whether they are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap, SurfaceOptions, surface_map
from tofuse.odometry.base import Odometry, Step, Tracker
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.base import Registration
from tofuse.registration.projective import ProjectiveOptions, align, registration_of
from tofuse.registration.uncertainty import UncertaintyOptions, covariance

Float64 = NDArray[np.float64]


@part("odometry", "given")
@dataclass(frozen=True)
class GivenPoses(Odometry):
    """Takes the poses of the odometry beside the images as they are.

    Each frame is aligned with the newest keyframe, to know what the images say of the motion
    between them; the pose stays as given. A frame without a pose is lost.

    Attributes
    ----------
    surface, alignment, uncertainty
        As of `Keyframes`.
    keyframe_angle, keyframe_distance
        Motion after which a frame becomes a keyframe: rad, and as a fraction of the median depth.
    """

    surface: SurfaceOptions = SurfaceOptions()  # noqa: RUF009 - immutable
    alignment: ProjectiveOptions = ProjectiveOptions()  # noqa: RUF009 - immutable
    uncertainty: UncertaintyOptions = UncertaintyOptions()  # noqa: RUF009 - immutable
    keyframe_angle: float = 0.2
    keyframe_distance: float = 0.1

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def start(self, seed: int) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        return _GivenTracker(self)


class _GivenTracker(Tracker):
    def __init__(self, options: GivenPoses) -> None:
        self._options = options
        self._keyframes = KeyframeMap(options.keyframe_angle, options.keyframe_distance)
        self._T_component_world: Float64 | None = None

    def prepare(self, frame: Frame) -> SurfaceMap | None:
        """See `Tracker.prepare`."""
        return surface_map(frame, self._options.surface) if isinstance(frame, RangeFrame) else None

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: SurfaceMap | None = None
    ) -> Step:
        """See `Tracker.push`."""
        if not isinstance(frame, RangeFrame):
            raise InputError("is a cloud; poses are given for images", where=f"frame {frame.index}")
        if T_odometry is None:
            return Step("lost", "no pose was given", None)
        view = surface_map(frame, self._options.surface) if surface is None else surface
        if self._T_component_world is None:
            self._T_component_world = se3.inverse(T_odometry)
        T = self._T_component_world @ T_odometry
        if not len(self._keyframes):
            self._keyframes.add(Keyframe(view, T, 0))
            return Step("tracked", "", T, surface=view)
        keyframe = self._keyframes.newest
        registration = self._registration(view, keyframe, T)
        if self._keyframes.is_far(T, keyframe):
            self._keyframes.add(Keyframe(view, T, 0))
        return Step("tracked", "", T, keyframe.view.index, registration, view)

    def _registration(self, view: SurfaceMap, keyframe: Keyframe, T: Float64) -> Registration:
        options = self._options
        aligned = align(view, [keyframe.target], T, options.alignment)
        C = covariance(view, [keyframe.target], aligned, options.alignment, options.uncertainty)
        T_keyframe_camera = se3.inverse(keyframe.T_component_camera) @ aligned.T_world_source
        return registration_of(aligned, T_keyframe_camera, C)
