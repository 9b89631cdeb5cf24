"""Odometry against keyframes: projective, photometric, and aware of what it can't see."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.kernels.motion import distance_and_angle
from tofuse.maps.surface_map import SurfaceMap, SurfaceOptions, surface_map
from tofuse.odometry.base import Odometry, Step, Tracker
from tofuse.odometry.likeness import look_of, unlikeness
from tofuse.odometry.mending import (
    Mending,
    glance,
    looks_rescaled,
    looks_turned_over,
    mendings,
)
from tofuse.odometry.motion import Moment, Motion, is_small
from tofuse.odometry.waiting import Waiting
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.base import Registration
from tofuse.registration.projective import (
    UNITS,
    Aligned,
    Level,
    ProjectiveOptions,
    Target,
    align,
)
from tofuse.registration.search import Match, SearchOptions, search
from tofuse.registration.uncertainty import UncertaintyOptions, covariance

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Guess = Literal["identity", "previous", "odometry"]

# A relocalisation starts far off: coarser, and with more patience, than tracking.
_PATIENT = (Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02), Level(1, 6, 0.0, 0.0))
_WIDE = (Level(4, 25, 0.15, 0.3), Level(4, 10, 0.03, 0.1), Level(2, 6, 0.005, 0.02))
# To see how well two views fit that are aligned.
_GLANCE = Level(4, 2, 0.0, 0.0)

# From one frame to the next no view gets so many times deeper, nor as much nearer.
_RESCALED = 4.0
# Nor does the camera; so far, as a share of the depth, it may have been taken elsewhere by mistake.
_FAR_RAD, _FAR_SHARE = 0.35, 0.35
# An image that fits is wrong all the same if it fits so many times better otherwise, or, where the
# camera would have had to jump, nearly as well.
_CLEARLY, _NEARLY = 1.02, 0.95
# Keyframes that are kept, so that memory stays flat, and those of them that a lost view is aligned
# with, so that it does not cost more than ten that are not.
_REMEMBERED, _TRIED = 40, 5
# By which share of its width the image of a lost view may be shifted against that of a keyframe
# which it is aligned with, and of one which it is searched in.
_TURNED, _TURNED_FAR = 0.25, 0.5


@dataclass(frozen=True)
class Acceptance:
    """When an alignment is believed.

    Attributes
    ----------
    inlier_share
        Least share of the compared points that fit.
    overlap
        Least share of the points that land in the target.
    in_front
        Largest share of the compared points that lie where the target saw through.
    inliers
        Fewest points that fit, of those the finest level used.
    rms_m, rms_share
        Largest rms of the distances of the points that fit: the larger of a length and a share of
        the typical depth, with which the errors of cameras grow.
    fit
        Least score of the points that land in the target: what lies where the target has no
        surface speaks against a view as well.
    albedo
        Largest standard deviation of what the log albedo differs by, where it takes part.
    """

    inlier_share: float = 0.75
    overlap: float = 0.2
    in_front: float = 0.1
    inliers: int = 40
    rms_m: float = 0.03
    fit: float = 0.5
    albedo: float = 0.1
    rms_share: float = 0.02

    def __post_init__(self) -> None:
        for name in ("inlier_share", "overlap", "in_front", "fit", "rms_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 to 1")
        for name in ("inliers", "rms_m", "albedo"):
            if not 0 <= getattr(self, name) < 1e9:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 or more")

    def objection(self, a: Aligned, depth: float = 0.0) -> str:
        """Return why an alignment is not believed, or nothing if it is.

        `depth` is the median depth of what was aligned, m.
        """
        if a.overlap < self.overlap:
            return f"only {a.overlap:.0%} of the points land in the view of the keyframe"
        if a.inliers < self.inliers:
            return f"only {a.inliers} points fit, {self.inliers} are needed"
        if a.inlier_share < self.inlier_share:
            return f"only {a.inlier_share:.0%} of the points fit, not {self.inlier_share:.0%}"
        if a.in_front > self.in_front * a.compared:
            return f"{a.in_front / a.compared:.0%} of the points lie where the keyframe saw through"
        if a.rms_m > max(self.rms_m, self.rms_share * depth):
            return f"the points that fit lie {a.rms_m * 1e3:.0f} mm from the surfaces"
        if a.score < self.fit * a.overlap:
            return f"only {max(a.score / a.overlap, 0):.0%} of what is seen fits well"
        if a.photometric and a.photo_scale > self.albedo:
            return f"the surfaces reflect otherwise, by {a.photo_scale:.0%}"
        return ""


@dataclass(frozen=True)
class Recovery:
    """When a frame that fits no prediction is searched for exhaustively, and what is believed.

    Attributes
    ----------
    keyframes
        In how many of the newest keyframes a frame is searched for; 0 never searches.
    patience
        After so many frames in a row that the search did not find, only every so many-th is
        searched for; at the end, lost frames are searched for until it fails so many times.
    support, clear_support
        Least share of both views' points that support the pose; the second where it leads by
        `lost_margin`.
    score
        Least score: the same share, by how alike they reflect, less those that contradict it.
    margin, lost_margin
        Least lead in score before the best other pose; the second after a frame was lost, when
        the keyframe may show another place that looks alike.
    relocated_margin
        Least lead, as a share of the points, of the keyframe that a lost view fits best before
        others that put it elsewhere.
    contradiction
        Largest share of what lands on a surface that lies where the other view saw through, or
        reflects otherwise.
    prior_m, prior_rad
        Sigma of the pose found, as the prediction of the last alignment.
    search
        How far and how finely is searched.
    """

    keyframes: int = 1
    patience: int = 10
    support: float = 0.25
    clear_support: float = 0.15
    score: float = 0.1
    margin: float = 0.025
    lost_margin: float = 0.1
    relocated_margin: float = 0.05
    contradiction: float = 0.08
    prior_m: float = 0.03
    prior_rad: float = 0.03
    search: SearchOptions = SearchOptions(mode="both")  # noqa: RUF009 - immutable

    def __post_init__(self) -> None:
        if not 0 <= self.keyframes <= _REMEMBERED:
            raise ValueError(f"keyframes is {self.keyframes}, not 0 to {_REMEMBERED}")
        if not 1 <= self.patience <= 1_000_000:
            raise ValueError(f"patience is {self.patience}, not 1 or more")
        for name in (
            "support",
            "clear_support",
            "score",
            "margin",
            "lost_margin",
            "relocated_margin",
            "contradiction",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 to 1")
        for name in ("prior_m", "prior_rad"):
            if not 1e-6 <= getattr(self, name) <= 1e6:
                raise ValueError(f"{name} is {getattr(self, name)}, not above 0")

    def believes(self, match: Match, lost: bool = False, said_before: bool = False) -> bool:
        """Whether what both views say of the best pose, and of its rivals, is convincing.

        Of a camera that was `lost` half the lead is enough if the frame before said the same.
        """
        margin = self.margin
        if lost:
            margin = max(margin, self.lost_margin * (0.5 if said_before else 1))
        clear = match.margin >= self.lost_margin
        return (
            match.agreement.support >= (self.clear_support if clear else self.support)
            and match.score >= self.score
            and match.margin >= margin
            and match.agreement.contradiction <= self.contradiction
        )


@part("odometry", "keyframes")
@dataclass(frozen=True)
class Keyframes(Odometry):
    """Aligns each frame with the newest keyframes, coarse to fine.

    A frame that leaves the keyframe becomes the next one. Directions that the data does not hold
    keep the prediction, and are reported. A frame that fits nothing is lost: it and its
    successors are looked for among the keyframes until one fits again.

    Attributes
    ----------
    surface
        How views are prepared.
    alignment
        How they are aligned.
    uncertainty
        How its covariance is told.
    acceptance
        When an alignment is believed; `relocated` when nothing predicted it.
    recovery
        How a frame that fits no prediction is searched for.
    guess
        Where an alignment starts: "previous" (the last motion goes on), "identity" (the camera
        stands still), "odometry" (the motion between the poses of an odometry file).
    keyframe_angle, keyframe_distance
        Motion after which a frame becomes a keyframe: rad, and as a share of the median depth.
    targets
        With how many keyframes a frame is aligned at once.
    minimum_points
        Valid points that a frame must have.
    """

    surface: SurfaceOptions = SurfaceOptions()  # noqa: RUF009 - immutable
    alignment: ProjectiveOptions = ProjectiveOptions()  # noqa: RUF009 - immutable
    uncertainty: UncertaintyOptions = UncertaintyOptions()  # noqa: RUF009 - immutable
    acceptance: Acceptance = Acceptance()
    relocated: Acceptance = Acceptance(0.85, 0.4, 0.05, 300, 0.02, 0.62, rms_share=0.015)
    recovery: Recovery = Recovery()
    guess: Guess = "previous"
    keyframe_angle: float = 0.2
    keyframe_distance: float = 0.1
    targets: int = 1
    minimum_points: int = 300

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def __post_init__(self) -> None:
        if not 1 <= self.targets <= _REMEMBERED:
            raise ValueError(f"targets is {self.targets}, not 1 to {_REMEMBERED}")
        if self.minimum_points < 1:
            raise ValueError(f"minimum_points is {self.minimum_points}, not 1 or more")
        if not (self.keyframe_angle > 0 and self.keyframe_distance > 0):
            raise ValueError("keyframe_angle and keyframe_distance must be above 0")

    def start(self, seed: int) -> Tracker:
        """See `Odometry.start`. There is nothing random in it."""
        return _KeyframeTracker(self)


@dataclass(frozen=True, eq=False)
class _Keyframe:
    view: SurfaceMap
    T_world_camera: Float64
    depth: float  # median, m

    @cached_property
    def look(self) -> Float32:
        """See `look_of`."""
        return look_of(self.view)

    @cached_property
    def target(self) -> Target:
        return Target(self.view, se3.inverse(self.T_world_camera))


@dataclass(frozen=True, eq=False)
class _Found:
    """Where a view is: how it was aligned, with what, beside which keyframe, and in words."""

    aligned: Aligned
    targets: list[Target]
    reference: _Keyframe
    how: str = ""


@dataclass(frozen=True, eq=False)
class _Mended:
    """A view that fits where it was expected, once what is wrong with its image is undone."""

    mending: Mending
    frame: RangeFrame
    view: SurfaceMap
    aligned: Aligned
    target: _Keyframe


class _KeyframeTracker(Tracker):
    def __init__(self, options: Keyframes) -> None:
        self._options = options
        self._keyframes: list[_Keyframe] = []
        self._T: Float64 | None = None  # of the last frame with a pose
        self._T_odometry: Float64 | None = None
        self._motion = Motion()
        self._before: Moment | None = None  # and when that was
        self._doubted: tuple[int, Step] | None = None  # a surprise that may yet be confirmed
        self._lost = False
        self._depth = 0.0  # median of the last frame with a pose, m
        self._waiting: Waiting[SurfaceMap] = Waiting()
        self._matched: tuple[tuple[int, int], Match | None] | None = None  # the last search
        self._tried: set[tuple[int, int]] = set()  # lost frames, and keyframes they are not in
        self._searched = 0  # frames in a row that only a search could find, or not even that
        self._frame: RangeFrame | None = None  # the last one where it was expected, and its depths
        self._glance = np.zeros((0, 0), np.float32)
        self._mended: _Mended | None = None  # what the frame before was, if that was wrong

    def prepare(self, frame: Frame) -> SurfaceMap | None:
        """See `Tracker.prepare`."""
        if not isinstance(frame, RangeFrame) or self._unfit(frame):
            return None
        return surface_map(frame, self._options.surface)

    def _unfit(self, frame: RangeFrame) -> str:
        """Why nothing can be made of a frame; empty if something can."""
        least = self._options.minimum_points
        if len(frame) < least:
            return f"{len(frame)} valid points, {least} are needed"
        first = frame.depth.flat[np.argmax(frame.valid)]
        # Some of the pixels nearly always tell.
        for some in (np.s_[::8, ::8], np.s_[:, :]):
            if np.any((frame.depth[some] != first) & frame.valid[some]):
                return ""
        return f"every depth is {first:.3g} m"

    def push(
        self, frame: Frame, T_odometry: Float64 | None = None, surface: SurfaceMap | None = None
    ) -> Step:
        """See `Tracker.push`."""
        options = self._options
        if not isinstance(frame, RangeFrame):
            raise InputError("is a cloud; this tracker needs images", where=f"frame {frame.index}")
        if surface is None and (reason := self._unfit(frame)):
            return self._lose(reason)
        view = surface_map(frame, options.surface) if surface is None else surface
        if np.count_nonzero(view.planes[..., 3] > 0) < options.minimum_points:
            return self._lose("nearly no surface in what is left of the image")
        now, look = Moment(frame.index, frame.timestamp), glance(view.z)
        if self._T is None:
            self._keep(view, np.eye(4))
            self._T = np.eye(4)
            self._follow(frame, view, look, self._T, T_odometry, now)
            return Step("tracked", "", np.eye(4), surface=view)

        reasons: list[str] = []
        expected = self._expected(T_odometry)
        found = None
        rescaled = not self._lost and not _is_comparable(view.depth, self._depth)
        if rescaled:
            words = f"the typical depth was {self._depth:.2g} m and is {view.depth:.2g} m"
            reasons.append(words)
        else:
            found = self._track(view, expected, reasons)
        since = now.seconds_since(self._before)
        mended = None
        if self._is_suspicious(look, found, expected, since):
            mended = self._mend(frame, view, expected, found, since)
        elif expected is not None and looks_rescaled(self._glance, look):
            mended = self._mend(frame, view, expected, found, since, turned=False)
        if mended is not None:
            return self._follow_mended(mended, T_odometry, now)
        if found is not None:
            self._searched = 0
        elif rescaled:
            return self._lose(reasons[0])
        elif self._lost:
            fits = self._relocated(view)
            found = self._leading(fits, reasons) if fits else self._search(view)
        else:
            # It was there a moment ago, and an older keyframe may show a place that looks alike.
            found = self._search(view) or self._leading(self._relocated(view), reasons)
        if found is None:
            self._waiting.add(view.bare())
            return self._lose(reasons[0])
        reference, was_lost = found.reference, self._lost
        T = found.aligned.T_world_source
        surprise = self._motion.surprise(T, expected, since)
        if surprise:  # few iterations do for small motions alone
            how = replace(options.alignment, levels=_PATIENT)
            found = replace(found, aligned=align(view, found.targets, T, how))
        step = self._step(view, found, lit=frame.amplitude_image is not None)
        if surprise:
            self._doubted = frame.index, step
            return self._lose(f"fits keyframe {reference.view.index}, but {surprise}")
        earlier: tuple[tuple[int, Step], ...] = ()
        if self._follow(frame, view, look, T, T_odometry, now):
            words = "the camera jumped, and this view goes on from there"
            step = replace(step, reason="; ".join(filter(None, (step.reason, words))))
            if self._doubted is not None:
                earlier = (self._doubted,)
        self._doubted = self._mended = None
        if self._searched:  # a camera that is put down anew for each view has no velocity
            self._motion.interrupt()
        if self._is_new(T, reference):
            self._keep(view, T)
        if was_lost:
            earlier = tuple(sorted([*earlier, *self._found_beside(_keyframe(view, T))]))
        return replace(step, earlier=earlier)

    @property
    def waiting(self) -> Collection[int]:
        """See `Tracker.waiting`."""
        doubted = () if self._doubted is None else (self._doubted[0],)
        return {*self._waiting.indices, *doubted}

    def finish(self) -> tuple[tuple[int, Step], ...]:
        """See `Tracker.finish`: lost views are searched for where they look most alike."""
        found: list[tuple[int, Step]] = []
        unlike: dict[tuple[int, int], float] = {}
        in_vain = 0
        while in_vain < self._options.recovery.patience:
            self._compare(unlike)
            left = {pair: far for pair, far in unlike.items() if pair not in self._tried}
            if not left:
                break
            lost, known = min(left, key=lambda pair: (left[pair], pair))
            view = self._waiting[lost]
            keyframe = next(k for k in self._keyframes if k.view.index == known)
            fit = self._searched_in(view, keyframe, lost=True)
            in_vain += 1
            if fit is not None:
                step, _ = self._place(view, fit)
                beside = self._found_beside(_keyframe(view, fit.aligned.T_world_source))
                found += [(lost, step), *beside]
                in_vain = 0
        return tuple(sorted(found))

    def _compare(self, unlike: dict[tuple[int, int], float]) -> None:
        """See how much each lost view differs from each keyframe, where that is not known yet."""
        frames = {k.view.index for k in self._keyframes}
        for lost, frame in list(unlike):
            if lost not in self._waiting.indices or frame not in frames:
                del unlike[lost, frame]
        for view in self._waiting.views:
            new = [k for k in self._keyframes if (view.index, k.view.index) not in unlike]
            if new:
                far = unlikeness(look_of(view), np.stack([k.look for k in new]), _TURNED_FAR)
                unlike |= {
                    (view.index, k.view.index): float(f) for k, f in zip(new, far, strict=True)
                }

    def _place(self, view: SurfaceMap, found: _Found) -> tuple[Step, _Keyframe | None]:
        """Take the pose of a view that waited; returns the keyframe as well that it makes, if any.

        The newest keyframes, which are tracked against, stay so.
        """
        self._waiting.remove(view.index)
        step = self._step(view, found, lit=view.has_photo)
        T = found.aligned.T_world_source
        if not self._is_new(T, found.reference):
            return step, None
        at = max(len(self._keyframes) - self._options.targets, 0)
        self._keyframes.insert(at, _keyframe(view.bare(), T))
        self._drop_dispensable()
        return step, _keyframe(view, T)

    def _found_beside(self, keyframe: _Keyframe) -> list[tuple[int, Step]]:
        """Find lost views just before and after one that was found, as far as they hang together.

        The camera was there a moment before or after, so that what fits need not lead by much.
        """
        found: list[tuple[int, Step]] = []
        for views in self._waiting.away_from(keyframe.view.index):
            reference = keyframe
            for view in views:
                fit = self._beside(view, reference)
                if fit is None:
                    break
                step, new = self._place(view, fit)
                found.append((view.index, step))
                reference = new or reference
        return found

    def _beside(self, view: SurfaceMap, keyframe: _Keyframe) -> _Found | None:
        """Where a lost view is that was taken just before or after a keyframe."""
        options = self._options
        if not _is_comparable(view.depth, keyframe.depth):
            return None
        how = replace(options.alignment, levels=_PATIENT)
        aligned = align(view, [keyframe.target], keyframe.T_world_camera, how)
        near = is_small(se3.inverse(keyframe.T_world_camera) @ aligned.T_world_source)
        acceptance = options.acceptance if near else options.relocated
        held = aligned.converged and not len(aligned.unobservable)
        if held and not acceptance.objection(aligned, view.depth):
            words = f"was lost, and is found beside frame {keyframe.view.index}"
            return _Found(aligned, [keyframe.target], keyframe, words)
        return self._searched_in(view, keyframe, lost=False)

    def _follow(
        self,
        frame: RangeFrame,
        view: SurfaceMap,
        look: Float32,
        T: Float64,
        T_odometry: Float64 | None,
        now: Moment,
    ) -> bool:
        """Take the pose of a frame; returns whether the camera jumped to get there."""
        self._T, self._T_odometry, self._before, self._lost = T, T_odometry, now, False
        self._depth, self._frame, self._glance = view.depth, frame, look
        return self._motion.follow(T)

    def _is_suspicious(
        self,
        look: Float32,
        found: _Found | None,
        expected: Float64 | None,
        seconds: float | None,
    ) -> bool:
        """Whether it must be asked if something is wrong with an image."""
        if expected is None and self._lost:
            return False  # where it would fit is not known
        if found is None or self._mended is not None:
            return True
        T = found.aligned.T_world_source
        return self._motion.is_surprising(T, expected, seconds) or looks_turned_over(
            self._glance, look
        )

    def _mend(
        self,
        frame: RangeFrame,
        as_is: SurfaceMap,
        expected: Float64 | None,
        found: _Found | None,
        seconds: float | None,
        *,
        turned: bool = True,
    ) -> _Mended | None:
        """See whether a frame fits better where it was expected if it is mirrored or rescaled.

        It is not asked whether it is mirrored unless it may be `turned` over.
        """
        assert self._T is not None
        assert self._frame is not None
        options = self._options
        before = self._mended
        keyframe = self._keyframes[-1] if before is None else before.target
        targets = [keyframe.target]
        start = self._T if expected is None else expected
        wrong: Iterable[Mending] = () if before is None else [before.mending]
        wrong = wrong or mendings(self._frame, frame, se3.inverse(self._T) @ start, turned=turned)
        best, least = None, np.zeros(2)
        if found is not None:
            T = found.aligned.T_world_source
            jumped = self._motion.is_surprising(T, expected, seconds)
            least = self._scores(as_is, found.aligned, keyframe) * (_NEARLY if jumped else _CLEARLY)
        for mending in wrong:
            mended = mending(frame)
            view = surface_map(mended, options.surface)
            aligned = align(view, targets, start, options.alignment)
            if (
                aligned.score > 0
                # A flat wall fits whichever way it is turned.
                and (before is not None or not len(aligned.unobservable))
                and not options.acceptance.objection(aligned, view.depth)
                and is_small(se3.inverse(start) @ aligned.T_world_source)
            ):
                scores = self._scores(view, aligned, keyframe)
                if (scores > least).any():
                    best, least = _Mended(mending, mended, view, aligned, keyframe), scores
        return best

    def _scores(self, view: SurfaceMap, aligned: Aligned, keyframe: _Keyframe) -> Float64:
        """How well a view fits a keyframe, and how well each fits the other, (2,).

        A view that shrinks lands wherever the keyframe has a surface, but leaves much of it bare.
        """
        how = replace(self._options.alignment, levels=(_GLANCE,))
        target = Target(view, se3.inverse(aligned.T_world_source))
        back = align(keyframe.view, [target], keyframe.T_world_camera, how)
        return np.array([aligned.score, aligned.score + back.score])

    def _follow_mended(self, mended: _Mended, T_odometry: Float64 | None, now: Moment) -> Step:
        """Follow the camera by an image that is wrong, which gets no pose for that."""
        self._motion.dismiss()
        T = mended.aligned.T_world_source
        view = mended.view
        self._follow(mended.frame, view, glance(view.z), T, T_odometry, now)
        self._doubted = None
        if self._is_new(T, mended.target):
            # Poses that are told must not rest on it, so it is no keyframe like others.
            mended = replace(mended, target=_keyframe(view, T))
        self._mended = mended
        words = "it fits where the camera was expected once that is undone"
        return Step("lost", f"the image is {mended.mending.words}: {words}", None)

    def _step(self, view: SurfaceMap, found: _Found, *, lit: bool) -> Step:
        """What a view is taken for that was aligned and is believed."""
        options, aligned, reference = self._options, found.aligned, found.reference
        notes = [found.how] if found.how else []
        if lit and not aligned.photometric:
            notes.append("the albedo took no part")
        C = covariance(view, found.targets, aligned, options.alignment, options.uncertainty)
        registration = _registration(aligned, reference.T_world_camera, C)
        status: Literal["tracked", "predicted"] = "tracked"
        if len(aligned.unobservable) == 6:
            status = "predicted"
            notes.insert(0, "nothing in view holds the camera in any direction")
        T = aligned.T_world_source
        return Step(status, "; ".join(notes), T, reference.view.index, registration, view)

    def interrupt(self) -> None:
        """See `Tracker.interrupt`."""
        self._motion.interrupt()
        self._doubted = None
        self._lost = True

    def _expected(self, T_odometry: Float64 | None) -> Float64 | None:
        """Where the guess puts the camera; None where it does not tell."""
        assert self._T is not None
        if self._options.guess == "previous":
            return self._motion.expected
        if self._options.guess == "identity":
            return self._T
        before = self._T_odometry
        if T_odometry is None or before is None:
            return None
        return np.asarray(self._T @ se3.inverse(before) @ T_odometry, np.float64)

    def _lose(self, reason: str) -> Step:
        self._lost = True
        self._motion.miss()
        return Step("lost", reason, None)

    def _track(
        self, view: SurfaceMap, expected: Float64 | None, reasons: list[str]
    ) -> _Found | None:
        """Align with the newest keyframes, from the guess and then from where the camera was."""
        options = self._options
        newest = self._keyframes[-options.targets :]
        if not _is_comparable(view.depth, newest[-1].depth):
            reasons.append(
                f"the typical depth of keyframe {newest[-1].view.index} is "
                f"{newest[-1].depth:.2g} m, and of this view {view.depth:.2g} m"
            )
            return None
        targets = [k.target for k in newest]
        for predicted, start, how, chosen in self._predictions(view, targets, expected):
            aligned = align(view, targets, predicted, how, start=start)
            if how is options.alignment:
                objection = options.acceptance.objection(aligned, view.depth)
            else:
                acceptance = options.acceptance if self._is_near(aligned) else options.relocated
                objection = acceptance.objection(aligned, view.depth) or self._doubt(aligned)
            if not objection and chosen and self._is_far(aligned):
                found = self._unrivalled(view, _Found(aligned, targets, newest[-1], chosen))
                if found is not None:
                    return found
                objection = "it is far from where the camera was, and a rival fits as well"
            if not objection:
                return _Found(aligned, targets, newest[-1], chosen)
            reasons.append(f"does not fit keyframe {newest[-1].view.index}: {objection}")
        return None

    def _is_near(self, aligned: Aligned) -> bool:
        """Whether the camera hardly moved since the last frame, which needs no prediction."""
        assert self._T is not None
        return not self._lost and is_small(se3.inverse(self._T) @ aligned.T_world_source)

    def _is_far(self, aligned: Aligned) -> bool:
        """Whether the camera moved so far that a rival may lie nearer, as a box looks alike."""
        assert self._T is not None
        distance, angle = distance_and_angle(self._T, aligned.T_world_source)
        return angle > _FAR_RAD or distance > _FAR_SHARE * self._depth

    def _unrivalled(self, view: SurfaceMap, found: _Found) -> _Found | None:
        """Ask an exhaustive search about an alignment that nothing predicted.

        Returns it if the search finds nothing better, else what that finds, if it is believed.
        """
        match = self._match(view, found.reference)
        if match is None:
            return found
        T = found.reference.T_world_camera @ match.T_target_source
        if not self._options.recovery.search.differ(T, found.aligned.T_world_source):
            return found
        return self._searched_in(view, found.reference, lost=self._lost)

    def _doubt(self, aligned: Aligned) -> str:
        """Why an alignment that nothing predicted is not believed though it fits."""
        if not aligned.converged:
            return "the search does not settle"
        if self._lost and len(aligned.unobservable):
            # A flat wall fits anywhere.
            return "the camera was lost, and this view does not hold it in every direction"
        return ""

    def _predictions(
        self, view: SurfaceMap, targets: list[Target], expected: Float64 | None
    ) -> Iterator[tuple[Float64, Float64, ProjectiveOptions, str]]:
        """Where the camera may be, where to begin, how, and in words; the likeliest first."""
        assert self._T is not None
        if expected is not None and self._options.guess != "identity":
            steady = self._motion.steadily if self._options.guess == "previous" else None
            kept = expected if steady is None else steady
            yield kept, expected, self._options.alignment, ""
        # Nothing tells how the camera moves: try some turns of it, and of what it sees.
        coarse = replace(self._options.alignment, levels=_PATIENT[:1])
        starts = [self._T @ motion for motion in _turns(view)]
        still, *turned = [align(view, targets, start, coarse) for start in starts]
        best = max(turned, key=lambda aligned: aligned.score)
        # A motion must explain more than standing still does: a flat wall fits any.
        chosen = best if best.score > 1.03 * still.score else still
        T = self._T if chosen is still else chosen.T_world_source
        how = replace(self._options.alignment, levels=_PATIENT)
        if not self._lost:
            # With no prediction to keep to, what little the data tells is the better guess.
            how = replace(how, common_tilt=0.0, common_slope=0.0)
        turn = np.degrees(se3.angle(se3.inverse(self._T) @ starts[1 + turned.index(best)]))
        where = "where the camera was" if chosen is still else f"a turn by {turn:.0f} degrees"
        unknown = "the prediction did not fit" if expected is not None else "nothing predicted it"
        yield T, chosen.T_world_source, how, f"{unknown}: found from {where}"

    def _relocated(self, view: SurfaceMap) -> list[_Found]:
        """Where the view fits, among the keyframes that look most like it; the best first."""
        options = self._options
        wide = replace(options.alignment, levels=_WIDE, prior_m=3.0, prior_rad=3.0)
        fine = replace(options.alignment, levels=_PATIENT)
        found = []
        for keyframe in self._alike(view, _TURNED, _TRIED):
            if not _is_comparable(view.depth, keyframe.depth):
                continue
            target = [keyframe.target]
            coarse = align(view, target, keyframe.T_world_camera, wide)
            if not options.relocated.objection(coarse, view.depth):
                found.append((coarse.score, keyframe, coarse.T_world_source))
        fits = []
        for _, keyframe, T in sorted(found, key=lambda one: (-one[0], one[1].view.index)):
            target = [keyframe.target]
            aligned = align(view, target, T, fine)
            # A flat wall fits anywhere: only a view that is held in every direction is found again.
            objection = options.relocated.objection(aligned, view.depth)
            if not objection and aligned.converged and not len(aligned.unobservable):
                how = f"found again at keyframe {keyframe.view.index}"
                fits.append(_Found(aligned, target, keyframe, how))
        return fits

    def _leading(self, fits: list[_Found], reasons: list[str]) -> _Found | None:
        """The best fit, unless the view fits elsewhere nearly as well: places may look alike."""
        if not fits:
            return None
        assert self._T is not None
        best, recovery = fits[0], self._options.recovery
        T = best.aligned.T_world_source
        rivals = [fit for fit in fits[1:] if recovery.search.differ(T, fit.aligned.T_world_source)]
        if not rivals or is_small(se3.inverse(self._T) @ T):
            return best
        rival = max(rivals, key=lambda fit: fit.aligned.score)
        lead = best.aligned.score - rival.aligned.score
        if lead >= recovery.relocated_margin:
            return replace(best, how=f"{best.how}, leading by {lead:.0%} of the points")
        reasons.insert(
            0,
            f"fits keyframe {best.reference.view.index}, but leads the fit of keyframe "
            f"{rival.reference.view.index}, elsewhere, by {max(lead, 0):.0%} of the points only",
        )
        return None

    def _search(self, view: SurfaceMap) -> _Found | None:
        """Search keyframes exhaustively, from no guess at all."""
        recovery = self._options.recovery
        self._searched += 1
        if self._searched > recovery.patience and self._searched % recovery.patience:
            return None
        keyframes = self._keyframes[: -recovery.keyframes - 1 : -1]
        if keyframes and self._lost:
            newest = {keyframe.view.index for keyframe in keyframes}
            alike = self._alike(view, _TURNED_FAR, 1)
            keyframes += [k for k in alike if k.view.index not in newest]
        for keyframe in keyframes:
            found = self._searched_in(view, keyframe, lost=self._lost)
            if found is not None:
                return found
        return None

    def _alike(self, view: SurfaceMap, shift: float, most: int) -> list[_Keyframe]:
        """So many keyframes that look most like a view, the likest first, of equals the newest."""
        far = unlikeness(look_of(view), np.stack([k.look for k in self._keyframes]), shift)
        order = np.lexsort((-np.arange(len(far)), far))
        return [self._keyframes[k] for k in order[:most]]

    def _match(self, view: SurfaceMap, keyframe: _Keyframe) -> Match | None:
        """Search a keyframe, unless that was the last thing done; None where none is to be made."""
        recovery, pair = self._options.recovery, (view.index, keyframe.view.index)
        if not recovery.keyframes:
            return None
        if self._matched is None or self._matched[0] != pair:
            self._matched = pair, search(view, keyframe.view, recovery.search)
        return self._matched[1]

    def _searched_in(self, view: SurfaceMap, keyframe: _Keyframe, *, lost: bool) -> _Found | None:
        """Search a keyframe exhaustively; `lost` if it may show another place."""
        options = self._options
        recovery = options.recovery
        self._tried.add((view.index, keyframe.view.index))
        if not _is_comparable(view.depth, keyframe.depth):
            return None
        match = self._match(view, keyframe)
        if match is None:
            return None
        T = keyframe.T_world_camera @ match.T_target_source
        doubted = None if self._doubted is None else self._doubted[1].T_world_camera
        said_before = doubted is not None and is_small(se3.inverse(doubted) @ T)
        if not recovery.believes(match, lost, said_before):
            return None
        target = [keyframe.target]
        near = replace(
            options.alignment,
            levels=_PATIENT,
            prior_m=recovery.prior_m,
            prior_rad=recovery.prior_rad,
        )
        lead = f"leading by {match.margin:.0%} of the points"
        how = f"found by a search of keyframe {keyframe.view.index}, {lead}"
        return _Found(align(view, target, T, near), target, keyframe, how)

    def _is_new(self, T: Float64, reference: _Keyframe) -> bool:
        options = self._options
        distance, angle = distance_and_angle(reference.T_world_camera, T)
        return (
            angle > options.keyframe_angle or distance > options.keyframe_distance * reference.depth
        )

    def _keep(self, view: SurfaceMap, T: Float64) -> None:
        self._keyframes.append(_keyframe(view, T))
        before = len(self._keyframes) - 1 - self._options.targets
        if before >= 0:  # only lost views are held against it from here on
            keyframe = self._keyframes[before]
            self._keyframes[before] = replace(keyframe, view=keyframe.view.bare())
        self._drop_dispensable()

    def _drop_dispensable(self) -> None:
        if len(self._keyframes) > _REMEMBERED:
            del self._keyframes[self._dispensable()]

    def _dispensable(self) -> int:
        """Which keyframe is missed least: the later one of the two that are nearest in pose.

        The earlier one has drifted less. The newest ones, which are tracked against, stay.
        """
        options = self._options
        old = self._keyframes[: -options.targets]
        T = np.stack([k.T_world_camera for k in old])
        reach = options.keyframe_distance * np.array([k.depth for k in old])
        place = T[:, :3, 3]
        apart = np.linalg.norm(place[:, None] - place, axis=-1) / np.minimum(reach[:, None], reach)
        turned = np.einsum("aij,bij->ab", T[:, :3, :3], T[:, :3, :3])
        angle = np.arccos(np.clip((turned - 1) / 2, -1, 1)) / options.keyframe_angle
        away = np.hypot(apart, angle)
        away[np.triu_indices(len(old))] = np.inf
        return int(np.argmin(away.min(1)))


def _keyframe(view: SurfaceMap, T: Float64) -> _Keyframe:
    return _Keyframe(view, T, view.depth)


def _is_comparable(depth: float, other: float) -> bool:
    """Whether two views of such typical depths can show the same from near the same place."""
    return 1 / _RESCALED < depth / other < _RESCALED


def _turns(view: SurfaceMap) -> list[Float64]:
    """Motions of the camera to try: none, and turns about itself and about what it sees."""
    centre = np.eye(4)
    centre[2, 3] = view.depth
    motions = [np.eye(4)]
    for angle in np.radians([-12, -6, 6, 12]):
        for axis in (3, 4):
            twist = np.zeros(6)
            twist[axis] = angle
            turn = se3.exp(twist)
            motions += [turn, centre @ turn @ se3.inverse(centre)]
    return motions


def _registration(
    aligned: Aligned, T_world_reference: Float64, covariance: Float64
) -> Registration:
    directions = aligned.unobservable * UNITS
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    return Registration(
        T_target_source=se3.inverse(T_world_reference) @ aligned.T_world_source,
        converged=aligned.converged,
        iterations=aligned.iterations,
        correspondences=aligned.inliers,
        points=max(aligned.compared, 1),
        error=aligned.scale,
        rms_m=aligned.rms_m,
        information=information,
        unobservable=directions / np.maximum(lengths, 1e-12),
    )
