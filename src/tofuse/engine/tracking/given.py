"""Given poses in place of tracking: to refine them, or to check whether they are right."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from tofuse.engine.alignment import Registration, ViewOptions, covariance, projective
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.engine.search import SearchOptions
from tofuse.engine.tracking.base import Odometry, Status, Step, Tracker
from tofuse.engine.tracking.keyframe_map import Keyframe, KeyframeMap
from tofuse.engine.tracking.moving_objects import MIN_MOVING_FRACTION, MovingObjects, at_size
from tofuse.engine.tracking.outlines import moved_fraction
from tofuse.engine.views import PreparedView, prepare_view


@part("odometry", "given")
@dataclass(frozen=True)
class GivenPoses(Bounded, Odometry):
    """Adopts the poses of external odometry unchanged.

    Each frame is aligned with the newest keyframe, or with the nearest one if the newest does not
    overlap it, to measure their relative motion by the images; the pose stays as given. Moving
    objects are excluded. A frame without a pose is lost.

    Attributes
    ----------
    views
        How images are prepared and aligned.
    keyframe_angle, keyframe_distance
        Motion after which a frame becomes a keyframe: rad, and as a fraction of the median depth.
    moved_m
        Rms by which an earlier refinement moved the positions, m: the bound allows for it again.
    """

    views: ViewOptions = ViewOptions()  # noqa: RUF009 - immutable
    keyframe_angle: Annotated[float, Bounds(0, exclusive=True)] = 0.2
    keyframe_distance: Annotated[float, Bounds(0, exclusive=True)] = 0.1
    moved_m: Annotated[float, Bounds(0)] = 0.0

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        return _GivenTracker(self)


class _GivenTracker(Tracker):
    """See `GivenPoses`. By default the first frame with a pose defines the component's frame."""

    def __init__(self, options: GivenPoses, T_component_world: Float64 | None = None) -> None:
        self._options = options
        self._keyframes = KeyframeMap(options.keyframe_angle, options.keyframe_distance)
        self._objects = MovingObjects()
        self._T_component_world = T_component_world

    def prepare(self, frame: Frame) -> PreparedView | None:
        """See `Tracker.prepare`."""
        return (
            prepare_view(frame, self._options.views.surface)
            if isinstance(frame, RangeFrame)
            else None
        )

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        if not isinstance(frame, RangeFrame):
            raise InputError("is a cloud; poses are given for images", where=f"frame {frame.index}")
        if T_odometry is None:
            return Step("lost", "no pose was given", None)
        view = prepare_view(frame, self._options.views.surface) if surface is None else surface
        if self._T_component_world is None:
            self._T_component_world = se3.inverse(T_odometry)
        T = self._T_component_world @ T_odometry
        if not len(self._keyframes):
            self._keyframes.add(Keyframe(view, T, 0))
            return Step("tracked", "", T, surface=view)
        keyframe = self._keyframes.overlapping(T)
        moving = self._objects.compare(view, T, keyframe.view, keyframe.T_component_camera)
        self._objects.update(moving)
        mask, moved = None, 0.0
        target = keyframe.target
        if moving.fraction > MIN_MOVING_FRACTION:
            mask = at_size(moving.view, frame)
            moved = moved_fraction(moving.view, view, T, keyframe.view, keyframe.T_component_camera)
            view = moving.applied(view)
            reference = moving.applied_to_reference(keyframe.view)
            target = projective.Target(reference, se3.inverse(keyframe.T_component_camera))
        registration = self._registration(view, keyframe, target, T)
        if self._keyframes.is_far(T, self._keyframes.newest):
            self._keyframes.add(Keyframe(view, T, 0))
        index = keyframe.view.index
        return Step("tracked", "", T, index, registration, view, moving=mask, moved=moved)

    def _registration(
        self, view: PreparedView, keyframe: Keyframe, target: projective.Target, T: Float64
    ) -> Registration:
        alignment = self._options.views.alignment
        aligned = projective.align(view, [target], T, alignment)
        C = covariance(view, [target], aligned, alignment)
        T_keyframe_camera = se3.inverse(keyframe.T_component_camera) @ aligned.T_world_source
        return projective.registration_of(aligned, T_keyframe_camera, C)


@dataclass(frozen=True, eq=False)
class StatedPose:
    """The pose of a frame in an earlier result.

    Attributes
    ----------
    status, reason
        As in `Step`.
    T_component_camera
        (4, 4); None without a pose.
    component
        Number of the component.
    covariance
        (6, 6) of its right perturbation, m and rad, relative to the first pose of the component;
        None if unknown.
    """

    status: Status
    reason: str
    T_component_camera: Float64 | None = None
    component: int = 0
    covariance: Float64 | None = None


@dataclass(frozen=True, eq=False)
class StatedPoses(Odometry):
    """Adopts the poses of earlier results unchanged, each component in a frame of its own.

    Attributes
    ----------
    stated
        By frame index. Other frames are lost.
    options
        How frames are aligned with keyframes of their component.
    """

    stated: Mapping[int, StatedPose]
    options: GivenPoses

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def start(self, seed: int, search: SearchOptions | None = None) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        return _StatedTracker(self)


# m^2 and rad^2: keeps the covariance of the first frame invertible.
_MIN_VARIANCE = np.array([1e-10] * 6)
_UNKNOWN = StatedPose("lost", "no pose was given")


class _StatedTracker(Tracker):
    def __init__(self, odometry: StatedPoses) -> None:
        self._odometry = odometry
        self._trackers: dict[int, Tracker] = {}  # by component

    def prepare(self, frame: Frame) -> PreparedView | None:
        """See `Tracker.prepare`."""
        if self._stated(frame).T_component_camera is None or not isinstance(frame, RangeFrame):
            return None
        return prepare_view(frame, self._odometry.options.views.surface)

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: PreparedView | None = None
    ) -> Step:
        """See `Tracker.push`."""
        stated = self._stated(frame)
        if stated.T_component_camera is None:
            return Step("lost", stated.reason, None)
        if stated.component not in self._trackers:
            # Another session of the component may have begun at another pose.
            self._trackers[stated.component] = _GivenTracker(self._odometry.options, np.eye(4))
        step = self._trackers[stated.component].push(frame, stated.T_component_camera, surface)
        registration = self._constrained(step, stated)
        return replace(
            step,
            status=stated.status,
            reason=stated.reason,
            component=stated.component,
            registration=registration,
        )

    def _constrained(self, step: Step, stated: StatedPose) -> Registration | None:
        """Return the registration of a frame; if degenerate, the relative pose of the result.

        The refinement of the earlier result may have constrained it by other views.
        """
        registration = step.registration
        if registration is None or not len(registration.unobservable) or step.reference is None:
            return registration
        reference = self._odometry.stated[step.reference]
        T, T_reference = stated.T_component_camera, reference.T_component_camera
        if T is None or T_reference is None:
            return registration
        if stated.covariance is None or reference.covariance is None:
            return registration
        T_reference_frame = np.asarray(se3.inverse(T_reference) @ T, np.float64)
        A = se3.adjoint(se3.inverse(T_reference_frame))
        # An upper limit: errors that both poses share cancel.
        C = A @ reference.covariance @ A.T + stated.covariance
        alignment = self._odometry.options.views.alignment
        prior = np.array([alignment.prior_m] * 3 + [alignment.prior_rad] * 3)
        if np.linalg.eigvalsh(C / np.outer(prior, prior))[-1] > 1:
            return registration
        return replace(
            registration,
            T_target_source=T_reference_frame,
            information=np.asarray(np.linalg.inv(C + np.diag(_MIN_VARIANCE)), np.float64),
            unobservable=np.zeros((0, 6)),
        )

    def _stated(self, frame: Frame) -> StatedPose:
        return self._odometry.stated.get(frame.index, _UNKNOWN)
