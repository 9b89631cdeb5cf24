"""Loops between range images: where the camera sees again what it had left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceMap
from tofuse.odometry.keyframes import Acceptance
from tofuse.parts import part
from tofuse.posegraph.graph import LoopRecord
from tofuse.posegraph.loops import (
    ClosedLoop,
    GivenLoop,
    LoopDetector,
    Loops,
    given_loop,
    in_order,
)
from tofuse.posegraph.views import KeptView, Spacing, ViewStore, overlaps
from tofuse.recordings.frames import Frame
from tofuse.registration.projective import Aligned, Level, ProjectiveOptions, Target, align
from tofuse.registration.uncertainty import covariance

Float64 = NDArray[np.float64]
Integers = NDArray[np.intp]

_COLUMNS = 200
_POINTS = 600
# The trajectory has drifted when a loop closes: little, or much.
_NEAR = (Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02), Level(1, 4, 0.0, 0.0))
_FAR = (Level(4, 20, 0.15, 0.3), *_NEAR)
_ALIGNMENT = ProjectiveOptions(prior_m=3.0, prior_rad=3.0)
# Sigma, in units of 1 cm and 1 degree, above which a direction keeps the prediction: never.
_NOT_HELD = 1e6
_ACCEPTANCE = Acceptance(0.8, 0.3, 0.05, 200, 0.02, 0.6)


@part("loops", "revisits")
@dataclass(frozen=True)
class Revisits(LoopDetector):
    """Aligns views that, as the trajectory has it, overlap again after they did not.

    A loop is accepted if it fits, holds the camera in every direction, and is found the same from
    both ends.

    Attributes
    ----------
    spacing
        Which views are tried.
    overlap, apart
        Least share that two views must see of each other, and the share below which a view in
        between must have seen either.
    per_view
        At most so many candidates for each view, those of the largest overlap.
    alignment
        How two views are aligned, apart from the levels.
    near, far
        Levels to try, and those where they fail; at least two each.
    acceptance
        When an alignment is believed.
    both_ways_m, both_ways_rad
        How far apart the alignments of either view with the other may end.
    """

    spacing: Spacing = Spacing(angle=0.15, distance=0.08, most=200)  # noqa: RUF009 - immutable
    overlap: float = 0.4
    apart: float = 0.1
    per_view: int = 2
    alignment: ProjectiveOptions = _ALIGNMENT
    near: tuple[Level, ...] = _NEAR
    far: tuple[Level, ...] = _FAR
    acceptance: Acceptance = _ACCEPTANCE
    both_ways_m: float = 0.03
    both_ways_rad: float = 0.03

    def __post_init__(self) -> None:
        if not 0 <= self.apart < self.overlap <= 1:
            raise ValueError("apart must be below overlap, both 0 to 1")
        if self.per_view < 0:
            raise ValueError(f"per_view is {self.per_view}, not 0 or more")
        if not (self.both_ways_m > 0 and self.both_ways_rad > 0):
            raise ValueError("both_ways_m and both_ways_rad must be above 0")

    def start(self, seed: int, given: Sequence[GivenLoop] = ()) -> Loops:
        """See `LoopDetector.start`. There is nothing random in it."""
        return _RevisitLoops(self, given)

    def candidates(self, surfaces: Sequence[SurfaceMap], poses: Float64) -> list[tuple[int, int]]:
        """Positions (i, j), i < j, of the views that may form a loop under the poses (N, 4, 4)."""
        views = [KeptView.of(s, _POINTS) for s in surfaces]
        pairs, shares = overlaps(views, poses, self.apart)
        found: list[tuple[int, int]] = []
        for j in range(len(views)):
            mine = pairs[:, 1] == j
            partners, share = pairs[mine, 0], shares[mine]
            # The unbroken run of partners up to this view is what it never left.
            seen = np.zeros(j + 1, bool)
            seen[partners], seen[j] = True, True
            start = int(np.flatnonzero(~seen)[-1]) if not seen.all() else -1
            again = (partners < start) & (share >= self.overlap)
            order = np.argsort(-share[again], kind="stable")[: self.per_view]
            found += [(int(i), j) for i in np.sort(partners[again][order])]
        return found


class _RevisitLoops(Loops):
    def __init__(self, options: Revisits, given: Sequence[GivenLoop]) -> None:
        self._options = options
        self._store = ViewStore(options.spacing)
        self._poses: dict[int, Float64] = {}
        self._given_loops = given
        self._asked = {frame for loop in given for frame in (loop.i, loop.j)}
        self._given_surfaces: dict[int, SurfaceMap] = {}

    def push(self, view: Frame, T_world_camera: Float64, surface: SurfaceMap | None = None) -> None:
        """See `Loops.push`."""
        self._poses[view.index] = T_world_camera
        if surface is None:
            return
        thin = surface.thinned(_COLUMNS)
        self._store.push(thin, T_world_camera)
        if view.index in self._asked:
            self._given_surfaces[view.index] = thin

    def finish(self) -> list[ClosedLoop]:
        """See `Loops.finish`. What a person gives takes the place of what was found."""
        surfaces = self._store.surfaces
        poses = np.array([self._poses[s.index] for s in surfaces]).reshape(-1, 4, 4)
        closed = {
            (surfaces[i].index, surfaces[j].index): self._confirm(surfaces[i], surfaces[j])
            for i, j in self._options.candidates(surfaces, poses)
        }
        known = self._given_surfaces
        for loop in self._given_loops:
            closed[loop.i, loop.j] = given_loop(
                loop, known, lambda i, j: self._confirm(known[i], known[j])
            )
        return in_order(closed)

    def _confirm(self, target: SurfaceMap, source: SurfaceMap) -> ClosedLoop:
        """Align the later view with the earlier one, and back."""
        options = self._options
        guess = se3.inverse(self._poses[target.index]) @ self._poses[source.index]
        there = self._align(target, source, guess, options.near)
        objection = self._objection(there)
        if objection:
            again = self._align(target, source, guess, options.far)
            if not self._objection(again):
                there, objection = again, ""
        T = there.T_world_source
        if not objection:
            back = self._align(source, target, se3.inverse(T), options.near)
            objection = self._objection(back)
            gap = T @ back.T_world_source
            if not objection and (
                np.linalg.norm(gap[:3, 3]) > options.both_ways_m
                or se3.angle(gap) > options.both_ways_rad
            ):
                objection = "the alignment back ends elsewhere"
        record = LoopRecord(
            target.index,
            source.index,
            not objection,
            objection or f"{there.inlier_share:.0%} of what both see fits",
            overlap=there.overlap,
            rms_m=there.rms_m if np.isfinite(there.rms_m) else None,
            free_space_violation=there.in_front / max(there.compared, 1),
        )
        if objection:
            return ClosedLoop(record)
        C = covariance(source, [Target(target, np.eye(4))], there, options.alignment)
        return ClosedLoop(record, T, np.asarray(np.linalg.inv(C), np.float64))

    def _align(
        self, target: SurfaceMap, source: SurfaceMap, guess: Float64, levels: tuple[Level, ...]
    ) -> Aligned:
        """Align with nothing held at the guess, which has drifted; then see what is held."""
        options = replace(self._options.alignment, levels=levels)
        free = replace(options, held=_NOT_HELD, common_tilt=0.0, common_slope=0.0)
        targets = [Target(target, np.eye(4))]
        T = align(source, targets, guess, free).T_world_source
        return align(source, targets, T, replace(options, levels=levels[-2:]))

    def _objection(self, aligned: Aligned) -> str:
        found = self._options.acceptance.objection(aligned)
        if found:
            return found
        if not aligned.converged:
            return "the alignment does not settle"
        if len(aligned.unobservable):
            return "what both see does not hold the camera in every direction"
        return ""
