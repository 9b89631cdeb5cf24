"""Statements of the thesis about its results, each tested against the numbers measured here.

A statement is graded for every draw of the random points (every noise seed for the synthetic data)
by the fraction of its parts that are true; the mean grade decides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.geometry import se3
from tofuse.lab.experiments import measures
from tofuse.lab.experiments.cases import CaseResult, Estimate, Run
from tofuse.lab.experiments.peaks import PeaksSweep
from tofuse.lab.scenes import box, rail, room, torso
from tofuse.lab.simulation import peaks

Outcome = Literal["agrees", "partly", "disagrees"]
Judge = TypeVar("Judge", bound=Callable[..., "Finding"])
T = TypeVar("T")

_AGREES, _DISAGREES = 0.8, 0.2
Y_DOWN = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Finding:
    """Outcome of a statement, and the numbers behind it."""

    outcome: Outcome
    numbers: str


@dataclass(frozen=True)
class Results:
    """Results by which statements are tested; those about cases that were not run are skipped."""

    cases: Mapping[str, CaseResult]
    peaks: PeaksSweep | None


@dataclass(frozen=True)
class Statement:
    """One statement of the thesis.

    Attributes
    ----------
    name
        Short identifier, in results.json.
    section
        Of the thesis.
    needs
        Cases required by the statement.
    quote
        The words of the thesis, shortened.
    judge
        Function that decides from the results of the cases, or of the synthetic data.
    """

    name: str
    section: str
    needs: tuple[str, ...]
    quote: str
    judge: Callable[..., Finding]

    def findings(self, results: Results, methods: Sequence[str]) -> dict[str, Finding]:
        """Return the outcome by method; none if a required case was not run."""
        if self.needs == ("peaks",):  # it has only one method
            return {} if results.peaks is None else {methods[0]: self.judge(results.peaks)}
        cases = [results.cases[name] for name in self.needs if name in results.cases]
        if len(cases) < len(self.needs):
            return {}
        return {method: self.judge(*cases, method=method) for method in methods}


STATEMENTS: list[Statement] = []  # in the order of the thesis


def _states(name: str, section: str, *needs: str) -> Callable[[Judge], Judge]:
    """Register the function that judges a statement, whose words are its docstring."""

    def register(judge: Judge) -> Judge:
        quote = " ".join((judge.__doc__ or "").split())
        STATEMENTS.append(Statement(name, section, needs, quote, judge))
        return judge

    return register


def graded(grades: Iterable[float], numbers: str, unit: str = "draw") -> Finding:
    """Decide by the mean of grades between 0 (false) and 1 (true)."""
    values = [float(g) for g in grades]
    mean = float(np.mean(values))
    outcome: Outcome = "partly"
    if mean >= _AGREES:
        outcome = "agrees"
    elif mean <= _DISAGREES:
        outcome = "disagrees"
    if len(values) > 1:
        numbers += f" Holds in {sum(g == 1 for g in values)} of {len(values)} {unit}s."
    return Finding(outcome, numbers)


def _fraction_true(*parts: bool) -> float:
    return float(np.mean(parts))


def _both(runs: Sequence[Run], of: Callable[[Estimate], T]) -> tuple[list[T], list[T]]:
    """Return a value of the runs' estimates before and after optimisation."""
    return [of(r.before) for r in runs], [of(r.after) for r in runs]


def _lowered(before: Iterable[float], after: Iterable[float]) -> list[bool]:
    return [a < b for b, a in zip(before, after, strict=True)]


def _median(values: Iterable[float]) -> float:
    return float(np.median(list(values)))


def _cm(values: Iterable[float]) -> str:
    return f"{100 * _median(values):.1f} cm"


def _deg(values: Iterable[float]) -> str:
    return f"{_median(values):.1f}°"


# 5.1, the rail


def _legs(run: Run) -> tuple[Float64, Float64]:
    """End-to-end lengths in m of the outward and the return path: estimated, and true."""
    has_pose = np.flatnonzero(np.isfinite(run.before.poses[:, 0, 0]))
    turning_point = has_pose[np.linalg.norm(run.truth[has_pose, :3, 3], axis=1).argmax()]
    ends = [0, turning_point, has_pose[-1]]
    return (
        np.linalg.norm(np.diff(run.before.poses[ends, :3, 3], axis=0), axis=1),
        np.linalg.norm(np.diff(run.truth[ends, :3, 3], axis=0), axis=1),
    )


@_states("rail-pushed-together", "5.1", "rail")
def _pushed_together(case: CaseResult, method: str) -> Finding:
    """Identity guess: “The camera positions have been pushed closer to each other during the
    translation to the left.”
    """
    fractions = {
        guess: [
            float(estimate[0] / true[0])
            for estimate, true in map(_legs, case.select(method, guess))
        ]
        for guess in ("identity", "previous")
    }
    return graded(
        [s < 0.9 for s in fractions["identity"]],
        f"The way out comes out {_median(fractions['identity']):.0%} as long as it is "
        f"({_median(fractions['previous']):.0%} with the previous motion as guess).",
    )


@_states("rail-slower-is-better", "5.1", "rail")
def _slower_is_better(case: CaseResult, method: str) -> Finding:
    """“The registrations did improve on the way back … somewhat slower translation speed.”"""
    errors = []
    for run in case.select(method, "identity"):
        turn = int(np.linalg.norm(run.truth[:, :3, 3], axis=1).argmax())
        step = run.before.score.step_m
        legs = [leg[np.isfinite(leg)] for leg in (step[: turn + 1], step[turn + 1 :])]
        if all(len(leg) for leg in legs):
            errors.append([float(leg.mean()) for leg in legs])
    if not errors:
        return Finding("disagrees", "The sequence ends before the way back.")
    outward, returning = zip(*errors, strict=True)
    return graded(
        [b < o for o, b in errors],
        f"Mean error of one motion: {1000 * _median(outward):.1f} mm on the way out, "
        f"{1000 * _median(returning):.1f} mm on the way back.",
    )


@_states("rail-almost-returns", "5.1", "rail")
def _almost_returns(case: CaseResult, method: str) -> Finding:
    """Previous guess: “the camera almost returns to the starting point.”"""
    ends = [r.before.score.end_m for r in case.select(method)]
    path = 2 * rail.RAIL_LENGTH
    return graded(
        [1.0 if e < 0.1 * path else 0.5 if e < 0.2 * path else 0.0 for e in ends],
        f"It ends {_cm(ends)} from where it should, {_median(ends) / path:.0%} of the path.",
    )


@_states("rail-mostly-y", "5.1", "rail")
def _mostly_in_y(case: CaseResult, method: str) -> Finding:
    """“It has deteriorated from its actual path mostly in the y-direction.”"""
    rms, _ = _axes_rms(case.select(method))
    return graded(
        [_fraction_true(x < y, z < y) for x, y, z in rms],
        f"Error rms: x {_cm(rms[:, 0])}, y {_cm(rms[:, 1])}, z {_cm(rms[:, 2])}.",
    )


@_states("rail-lowered", "5.1", "rail")
def _lower_y_and_z(case: CaseResult, method: str) -> Finding:
    """“In the optimized case … the cumulative error of the cameras’ y and z-positions has been
    lowered.”
    """
    before, after = _axes_rms(case.select(method))
    return graded(
        [_fraction_true(a[1] < b[1], a[2] < b[2]) for b, a in zip(before, after, strict=True)],
        _before_after(before, after, (1, 2)),
    )


def _axes_rms(runs: Sequence[Run]) -> tuple[Float64, Float64]:
    before, after = _both(runs, lambda e: e.score.axes_rms_m)
    return np.array(before), np.array(after)


def _before_after(before: Float64, after: Float64, columns: Sequence[int]) -> str:
    parts = [f"{'xyz'[k]} {_cm(before[:, k])} to {_cm(after[:, k])}" for k in columns]
    return f"Error rms, before to after: {', '.join(parts)}."


@_states("rail-straighter", "5.1", "rail")
def _straighter(case: CaseResult, method: str) -> Finding:
    """“They now follow a straighter path, as if the camera actually was moved along a rail.”"""
    before, after = _both(case.select(method), lambda e: measures.straightness_m(e.poses[:, :3, 3]))
    return graded(
        _lowered(before, after),
        f"Distance from a straight line, rms: {_cm(before)} before, {_cm(after)} after.",
    )


@_states("rail-objective", "5.1", "rail")
def _fluctuates(case: CaseResult, method: str) -> Finding:
    """“The function value fluctuates strongly near the end … in the end it finds a reasonable
    minimum.”
    """
    runs = [r for r in case.select(method) if r.objective]
    if not runs:
        return Finding("disagrees", "No loop was closed, so nothing was optimised.")
    rises = [int((np.diff(r.objective) > 0).sum()) for r in runs]
    first, last = (_median(r.objective[k] for r in runs) for k in (0, -1))
    steps = _median(len(r.objective) - 1 for r in runs)
    return graded(
        [
            _fraction_true(up > 0, r.objective[-1] < r.objective[0])
            for r, up in zip(runs, rises, strict=True)
        ],
        f"Falls from {first:.3g} to {last:.3g} in {steps:.0f} steps and rises in "
        f"{_median(rises):.0f} of them: this optimiser keeps the constraint at every step.",
    )


# 5.2, the room with chairs


@_states("room-keeps-shape", "5.2", "room")
def _keeps_shape(case: CaseResult, method: str) -> Finding:
    """“The room roughly keeps its shape.”"""
    sizes = [r.before.model.sizes for r in case.select(method)]
    return graded(
        [_fraction_true(*_near_size(s)) for s in sizes],
        f"{_room_size(sizes)} before optimisation ({_room_size([case.perfect.sizes])} when the "
        "same frames are put together by the true poses).",
    )


def _near_size(sizes: Mapping[str, float]) -> tuple[bool, bool]:
    return (
        abs(sizes["length_m"] / room.LENGTH - 1) < 0.1,
        abs(sizes["width_m"] / room.WIDTH - 1) < 0.1,
    )


def _room_size(sizes: Sequence[Mapping[str, float]]) -> str:
    return (
        f"{_median(s['length_m'] for s in sizes):.2f} x "
        f"{_median(s['width_m'] for s in sizes):.2f} m"
    )


@_states("room-error-at-end", "5.2", "room")
def _error_at_end(case: CaseResult, method: str) -> Finding:
    """“The accumulated error becomes visible at the end of the revolution.”"""
    pairs = []
    for run in case.select(method):
        errors = measures.displacement_m(run.before.poses, run.truth)
        third = len(errors) // 3
        pairs.append(
            (np.nanmean(errors[third : 2 * third]), np.nanmean(errors[-max(1, third // 3) :]))
        )
    middle, end = zip(*pairs, strict=True)
    return graded(
        [e > m for m, e in pairs],
        f"A point 2 m ahead is off by {_cm(middle)} in the middle third of the turn and by "
        f"{_cm(end)} at its end.",
    )


@_states("room-every-third", "5.2", "room")
def _every_third(case: CaseResult, method: str) -> Finding:
    """“Using every third frame produced better results than using every second, or every fourth
    frame.”
    """
    errors = {
        s: [r.before.model.sizes["surface_error_m"] for r in case.select(method, stride=s)]
        for s in (2, 3, 4)
    }
    medians = {s: _median(v) for s, v in errors.items()}
    numbers = "; ".join(
        f"every {name}: {100 * medians[s]:.0f} ({100 * min(errors[s]):.0f} to "
        f"{100 * max(errors[s]):.0f})"
        for s, name in ((2, "second"), (3, "third"), (4, "fourth"))
    )
    return graded(
        [_fraction_true(medians[3] < medians[2], medians[3] < medians[4])],
        f"Median distance of the model from the true surface, cm, with the range over the draws: "
        f"{numbers}.",
    )


@_states("room-door", "5.2", "room")
def _door_gap(case: CaseResult, method: str) -> Finding:
    """“There is a gap with no points … a consequence of the glossy door.”"""
    counts = case.facts["door"]
    ratio = counts["door"] / max(counts["wall"], 1e-9)
    return graded(
        [1.0 if ratio < 0.25 else 0.5 if ratio < 0.5 else 0.0],
        f"The filters leave {ratio:.0%} as many points on the door as on as much of the same "
        "wall on the other side.",
    )


@_states("room-little-change", "5.2", "room")
def _little_change(case: CaseResult, method: str) -> Finding:
    """“The reconstructed room did not change much after the optimization.”"""
    shifts = [
        float(np.nanmedian(measures.displacement_m(r.before.poses, r.after.poses)))
        for r in case.select(method)
    ]
    return graded(
        [m < 0.05 * room.LENGTH for m in shifts],
        f"A point 2 m ahead moves by {_cm(shifts)} (median), "
        f"{_median(shifts) / room.LENGTH:.0%} of the room's length.",
    )


@_states("room-closer", "5.2", "room")
def _closer_together(case: CaseResult, method: str) -> Finding:
    """“The cameras have been moved a little closer to each other in the optimized case.”"""
    before, after = _both(case.select(method), lambda e: _scatter(e.poses)[0])
    return graded(
        _lowered(before, after),
        f"Cameras are {_cm(before)} from their middle before and {_cm(after)} after (rms; true: "
        "0).",
    )


@_states("room-first-centred", "5.2", "room")
def _first_in_middle(case: CaseResult, method: str) -> Finding:
    """“The first camera is now more to the center of the heap of cameras.”"""
    before, after = _both(case.select(method), lambda e: _scatter(e.poses)[1])
    return graded(
        _lowered(before, after),
        f"The first camera is {_cm(before)} from the middle before and {_cm(after)} after.",
    )


def _scatter(poses: Float64) -> tuple[float, float]:
    """RMS distance of the cameras from their centroid, and distance of the first one."""
    positions = poses[np.isfinite(poses[:, 0, 0]), :3, 3]
    distances = np.linalg.norm(positions - positions.mean(0), axis=1)
    return float(np.sqrt(np.mean(distances**2))), float(distances[0])


@_states("room-axes", "5.2", "room")
def _z_unchanged(case: CaseResult, method: str) -> Finding:
    """“The translational error is kept about the same in the z-direction, but is lowered in the
    x and y-directions.”
    """
    before, after = _axes_rms(case.select(method))
    return graded(
        [
            _fraction_true(a[0] < b[0], a[1] < b[1], abs(a[2] / b[2] - 1) < 0.2)
            for b, a in zip(before, after, strict=True)
        ],
        _before_after(before, after, (0, 1, 2)),
    )


# 5.3, the empty room


@_states("empty-flat-walls", "5.3", "empty-room")
def _flat_walls(case: CaseResult, method: str) -> Finding:
    """“ICP has major problems when facing flat walls.”"""
    pairs = []
    for run in case.select(method):
        found, true = measures.motions(run.before.poses), measures.motions(run.truth)
        errors = measures.displacement_m(found, true)
        corner = _corner_steps(case, run)
        pairs.append((_rms(errors[~corner]), _rms(errors[corner])))
    wall, corner_error = zip(*pairs, strict=True)
    return graded(
        [1.0 if w > 1.5 * c else 0.5 if w > c else 0.0 for w, c in pairs],
        f"Error of one motion 2 m ahead, rms: {_cm(wall)} facing a wall, {_cm(corner_error)} "
        "with a corner in view.",
    )


@_states("empty-corner", "5.3", "empty-room")
def _picks_up(case: CaseResult, method: str) -> Finding:
    """“When the corner finally appears …, the registration picks up momentum. Hence a small
    piece of the room turns out well.”
    """
    pairs = []
    for run in case.select(method):
        corner = _corner_steps(case, run)
        turn, true = (
            np.diff(measures.unwrapped_angle_deg(p, Y_DOWN)) for p in (run.before.poses, run.truth)
        )
        pairs.append(
            (turn[~corner].sum() / true[~corner].sum(), turn[corner].sum() / true[corner].sum())
        )
    wall, corner_part = zip(*pairs, strict=True)
    return graded(
        [_fraction_true(abs(c - 1) < abs(w - 1), abs(c - 1) < 0.2) for w, c in pairs],
        f"Share of the turn that is found: {_median(wall):.0%} facing a wall, "
        f"{_median(corner_part):.0%} with a corner in view.",
    )


def _corner_steps(case: CaseResult, run: Run) -> Bool:
    """(N - 1,) mask of the motions between two frames with a visible corner."""
    visible: Bool = case.facts["corners"][run.stride]
    return visible[1:] & visible[:-1]


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@_states("empty-closes", "5.3", "empty-room")
def _closes_loop(case: CaseResult, method: str) -> Finding:
    """“The optimization algorithm closes the loop …”"""
    before, after = _both(case.select(method), lambda e: (e.score.end_m, e.score.end_deg))
    return graded(
        [
            _fraction_true(*(a < 0.25 * b for b, a in zip(*ends, strict=True)))
            for ends in zip(before, after, strict=True)
        ],
        f"The last camera is off by {_cm(m for m, _ in before)} and "
        f"{_deg(deg for _, deg in before)} before, {_cm(m for m, _ in after)} and "
        f"{_deg(deg for _, deg in after)} after.",
    )


@_states("empty-shape", "5.3", "empty-room")
def _no_proper_shape(case: CaseResult, method: str) -> Finding:
    """“… but it is not sufficient to give the room its proper shape.”"""
    sizes = [r.after.model.sizes for r in case.select(method)]
    return graded(
        [not all(_near_size(s)) for s in sizes],
        f"{_room_size(sizes)} instead of {room.LENGTH:.1f} x {room.WIDTH:.1f} m, and the model is "
        f"{_cm(s['surface_error_m'] for s in sizes)} from the true surface (median).",
    )


@_states("empty-objects", "5.3", "room", "empty-room")
def _objects_matter(furnished: CaseResult, empty: CaseResult, method: str) -> Finding:
    """“This shows the importance of having reference objects.”"""
    full, bare = (
        [r.after.model.sizes["surface_error_m"] for r in case.select(method)]
        for case in (furnished, empty)
    )
    return graded(
        _lowered(bare, full),
        f"Median distance of the optimised model from the true surface: {_cm(full)} with "
        f"chairs, {_cm(bare)} without.",
    )


# 5.4, the torso


def _overlap_deg(case: CaseResult, run: Run) -> tuple[float, float]:
    """Excess of the cameras' total rotation over the truth, before and after, degrees."""
    axis = case.T_truth_world[:3, :3].T @ np.array([0.0, 0.0, 1.0])
    end = [
        float(measures.unwrapped_angle_deg(p, axis)[-1])
        for p in (run.before.poses, run.after.poses, run.truth)
    ]
    sign = np.sign(end[2]) or 1.0
    return float(sign * (end[0] - end[2])), float(sign * (end[1] - end[2]))


@_states("torso-overlap", "5.4", "torso")
def _slight_overlap(case: CaseResult, method: str) -> Finding:
    """“The camera positions seem to orbit the torso in a nice-looking way, though, there is a
    slight overlap.”
    """
    excess = [_overlap_deg(case, r)[0] for r in case.select(method)]
    return graded(
        [_fraction_true(o > 0, abs(o) < 45) for o in excess],
        f"The cameras go {abs(_median(excess)):.1f}° "
        f"{'further' if _median(excess) > 0 else 'less far'} round than they should "
        f"({min(excess):+.0f}° to {max(excess):+.0f}°).",
    )


@_states("torso-overlap-removed", "5.4", "torso")
def _overlap_removed(case: CaseResult, method: str) -> Finding:
    """“The optimization algorithm removes this overlap.”"""
    pairs = [_overlap_deg(case, r) for r in case.select(method)]
    before, after = zip(*pairs, strict=True)
    return graded(
        [abs(a) < 0.25 * abs(b) for b, a in pairs],
        f"Over or short of the turn by {_deg(map(abs, before))} before and "
        f"{_deg(map(abs, after))} after.",
    )


@_states("torso-pushed-out", "5.4", "torso")
def _pushed_out(case: CaseResult, method: str) -> Finding:
    """“The camera positions seem to have been pushed out, away from the torso.”"""
    runs = case.select(method)
    before, after = _both(runs, lambda e: measures.circle_radius_m(e.poses[:, :3, 3]))
    short = _median(_overlap_deg(case, r)[0] for r in runs) < 0
    return graded(
        _lowered(after, before),
        f"Radius of the circle through the cameras: {_median(before):.2f} m before, "
        f"{_median(after):.2f} m after (true: {torso.DISTANCE:.2f} m)."
        + (" The chain falls short of a turn, and closing a gap pulls in." if short else ""),
    )


@_states("torso-weight", "5.4", "torso")
def _gained_weight(case: CaseResult, method: str) -> Finding:
    """“The model … looks like he has gained some weight.”"""
    before, after = _both(case.select(method), lambda e: e.model.sizes["girth_m"])
    perfect = case.perfect.sizes["girth_m"]
    return graded(
        [_fraction_true(a > b, a > 1.02 * perfect) for b, a in zip(before, after, strict=True)],
        f"Girth of the chest with the upper arms: {_cm(before)} before, {_cm(after)} after; by "
        f"the true poses {100 * perfect:.1f} cm (true: {100 * case.facts['girth_m']:.1f} cm).",
    )


# 5.5, the box


@_states("box-angles-of-view", "5.5", "box")
def _angles_corrected(case: CaseResult, method: str) -> Finding:
    """“The viewing angles of the cameras seem to have been corrected for after the
    optimization.”
    """
    before, after = _both(case.select(method), lambda e: e.score.rotation_deg)
    return graded(
        _lowered(before, after),
        f"Orientations are off by {_deg(before)} before and {_deg(after)} after (rms).",
    )


@_states("box-right-angles", "5.5", "box")
def _right_angles(case: CaseResult, method: str) -> Finding:
    """“The angles of the box are very close to accurate.”"""
    worst = [r.after.model.sizes["worst_angle_deg"] for r in case.select(method)]
    return graded(
        [1.0 if w < 2 else 0.5 if w < 5 else 0.0 for w in worst],
        f"The worst of the four angles is {_deg(worst)} from 90° "
        f"({case.perfect.sizes['worst_angle_deg']:.1f}° by the true poses).",
    )


@_states("box-expanded", "5.5", "box")
def _expanded(case: CaseResult, method: str) -> Finding:
    """“The box has expanded in every direction.”"""
    sizes = [r.after.model.sizes for r in case.select(method)]
    true = {"width_a_m": box.WIDTH, "width_b_m": box.DEPTH, "height_m": box.HEIGHT}
    return graded(
        [_fraction_true(*(s[name] > length for name, length in true.items())) for s in sizes],
        f"{_box_size(sizes)} ({_box_size([case.perfect.sizes])} by the true poses).",
    )


def _box_size(sizes: Sequence[Mapping[str, float]]) -> str:
    names = ("width_a_m", "width_b_m", "height_m")
    return " x ".join(f"{1000 * _median(s[n] for s in sizes):.0f}" for n in names) + " mm"


@_states("box-white-middle", "5.5", "box")
def _white_middle(case: CaseResult, method: str) -> Finding:
    """“The white area in the middle of the box contains almost no points since the camera was
    aiming at the box from the side.”
    """
    run = case.select(method)[0]
    fit = run.after.model.box
    if fit is None:
        return Finding("disagrees", "There is no model.")
    distances = np.abs(run.after.model.points[:, :2] - fit.corners.mean(0)).max(1)
    half = fit.widths_m.mean() / 2
    centre_density = (distances < 0.5 * half).sum() / (0.5 * half) ** 2
    wall_density = (
        ((distances > 0.8 * half) & (distances < 1.2 * half)).sum() / half**2 / (1.2**2 - 0.8**2)
    )
    ratio = centre_density / max(wall_density, 1e-9)
    return graded(
        [1.0 if ratio < 0.1 else 0.5 if ratio < 0.3 else 0.0],
        f"From above the middle is {ratio:.0%} as dense as the walls, though the camera "
        "here sees the top face as well.",
    )


# 5.6, the synthetic data


@_states("peaks-first", "5.6", "peaks")
def _first_is_worst(sweep: PeaksSweep) -> Finding:
    """“The first transformation is not estimated very well … The remaining relative
    transformations are more accurately estimated.”
    """
    pairs = []
    for run in sweep.example:
        error = se3.inverse(measures.motions(run.truth)) @ measures.motions(run.poses_sequential)
        errors = np.linalg.norm(error[:, :3, 3], axis=1)
        pairs.append((errors[0], float(np.median(errors[1:]))))
    first, others = zip(*pairs, strict=True)
    return graded(
        [f > 2 * o for f, o in pairs],
        f"Error of the first motion {_median(first):.2f} m, of the others {_median(others):.2f} m "
        "(medians, sigma 0.09).",
        "seed",
    )


@_states("peaks-inwards", "5.6", "peaks")
def _pushed_inwards(sweep: PeaksSweep) -> Finding:
    """“The optimized camera positions have been pushed inwards, mainly at the far side.”"""
    near_far = []
    for run in sweep.example:
        centre = np.array([0.0, 0.0, peaks.RADIUS_M])
        inwards = peaks.RADIUS_M - np.linalg.norm(run.poses_optimised[:, :3, 3] - centre, axis=1)
        far_side = np.linalg.norm(run.truth[:, :3, 3], axis=1) > peaks.RADIUS_M
        near_far.append((float(inwards[~far_side].mean()), float(inwards[far_side].mean())))
    near_means, far_means = zip(*near_far, strict=True)
    return graded(
        [_fraction_true(f > 0, f > n) for n, f in near_far],
        f"On the far side they are {_median(far_means):+.2f} m nearer to the middle than they "
        f"should be, on the near side {_median(near_means):+.2f} m (sigma 0.09).",
        "seed",
    )


@_states("peaks-reduced", "5.6", "peaks")
def _overall_reduced(sweep: PeaksSweep) -> Finding:
    """“The overall error has been reduced after the optimization.”"""
    runs = sweep.example
    before = [float(r.sequential.position.mean()) for r in runs]
    after = [float(r.optimised.position.mean()) for r in runs]
    return graded(
        _lowered(before, after),
        f"Mean error of the positions {_median(before):.2f} m before, {_median(after):.2f} m after "
        "(sigma 0.09).",
        "seed",
    )


@_states("peaks-threshold", "5.6", "peaks")
def _threshold(sweep: PeaksSweep) -> Finding:
    """“ICP does well on its own if the applied noise has a standard deviation below σ = 0.05
    meters.”
    """
    low = sweep.position[sweep.sigmas < 0.05 - 1e-9, 0]
    high = sweep.position[sweep.sigmas > 0.05 + 1e-9, 0]
    return graded(
        [_fraction_true(low.max() < 0.05 * peaks.RADIUS_M, high.min() > 0.05 * peaks.RADIUS_M)],
        f"Mean error of the chain: at most {low.max():.2f} m below sigma 0.05, at least "
        f"{high.min():.2f} m above.",
    )


@_states("peaks-improves", "5.6", "peaks")
def _improves_above(sweep: PeaksSweep) -> Finding:
    """“Above σ = 0.05, the optimization algorithm improves the camera positions and their
    rotation angles.”
    """
    above = sweep.sigmas > 0.05 + 1e-9
    position, rotation = sweep.position[above], sweep.rotation[above]
    ratios = [p[:, 1] / p[:, 0] for p in (position, rotation)]
    return graded(
        [_fraction_true(*(p[:, 1] < p[:, 0])) for p in (position, rotation)],
        f"Above 0.05 it leaves {ratios[0].min():.0%} to {ratios[0].max():.0%} of the error of "
        f"positions and {ratios[1].min():.0%} to {ratios[1].max():.0%} of that of rotations.",
        "measure",
    )


@_states("peaks-y", "5.6", "peaks")
def _y_unaltered(sweep: PeaksSweep) -> Finding:
    """“The cameras’ y-positions are not altered very much, as expected.”"""
    gain = _gain(sweep)[-1]
    return graded(
        [abs(gain[1]) < 0.25 * min(gain[0], gain[2])],
        f"At the highest noise x gains {gain[0]:.2f} m, y {gain[1]:.2f} m, z {gain[2]:.2f} m.",
    )


@_states("peaks-x-z", "5.6", "peaks")
def _x_z_similar(sweep: PeaksSweep) -> Finding:
    """“The x and z-positions are improved about the same.”"""
    above = _gain(sweep)[sweep.sigmas > 0.05 + 1e-9].mean(0)
    ratio = above[0] / above[2] if above[2] > 0 else np.inf
    return graded(
        [1.0 if 2 / 3 < ratio < 1.5 else 0.5 if 0.5 < ratio < 2 else 0.0],
        f"Above sigma 0.05 x gains {above[0]:.2f} m and z {above[2]:.2f} m (means).",
    )


@_states("peaks-more-noise", "5.6", "peaks")
def _gain_grows_with_noise(sweep: PeaksSweep) -> Finding:
    """“For every parameter the optimization seem to do more good in case of more applied
    noise.”
    """
    slopes = [float(np.polyfit(sweep.sigmas, g, 1)[0]) for g in _gain(sweep).T]
    rising = sum(s > 0 for s in slopes)
    return graded(
        [_fraction_true(*(s > 0 for s in slopes))],
        f"The gain grows with sigma for {rising} of the 6 parameters.",
    )


@_states("peaks-yaw", "5.6", "peaks")
def _yaw_most(sweep: PeaksSweep) -> Finding:
    """“The yaw-angle is most improved.”"""
    gain = np.degrees(_gain(sweep)[-1, 3:])
    return graded(
        [gain[0] > max(gain[1], gain[2])],
        f"At the highest noise yaw gains {gain[0]:.1f}°, pitch {gain[1]:.1f}°, "
        f"roll {gain[2]:.1f}°.",
    )


@_states("peaks-pitch-roll", "5.6", "peaks")
def _pitch_roll_late(sweep: PeaksSweep) -> Finding:
    """“The pitch and roll-angles are only improved significantly in the cases with high amounts
    of applied noise.”
    """
    gain = np.degrees(_gain(sweep))
    low = gain[sweep.sigmas < 0.05 - 1e-9, 4:].max()
    high = gain[-1, 4:]
    return graded(
        [_fraction_true(low < 0.2, high.min() > 0.2)],
        f"Pitch and roll gain at most {low:.2f}° below sigma 0.05, {high[0]:.2f}° and "
        f"{high[1]:.2f}° at the highest noise.",
    )


def _gain(sweep: PeaksSweep) -> Float64:
    """(S, 6) decrease of the mean error of each parameter by the optimisation."""
    return sweep.axes[:, 0] - sweep.axes[:, 1]


# 6 and 7

_SCENES = ("rail", "room", "empty-room", "torso", "box")


@_states("guess", "6", *_SCENES)
def _previous_is_better(*cases: CaseResult, method: str) -> Finding:
    """The previous motion as guess “improved the attractiveness of the registrations quite a
    bit.”
    """
    better, texts = [], []
    for case in cases:
        runs = {g: case.select(method, g) for g in ("identity", "previous")}
        error = {
            g: _median(r.before.model.sizes["surface_error_m"] for r in case_runs)
            for g, case_runs in runs.items()
        }
        posed = {g: _median(r.posed for r in case_runs) for g, case_runs in runs.items()}
        # Models omit lost frames, which favours the guess that lost many.
        better.append(
            posed["previous"] > 1.1 * posed["identity"]
            or (
                error["previous"] < error["identity"]
                and posed["previous"] > 0.9 * posed["identity"]
            )
        )
        texts.append(
            f"{case.case.scene} {100 * error['identity']:.1f} to {100 * error['previous']:.1f} "
            f"({posed['identity']:.0f} to {posed['previous']:.0f} frames with a pose)"
        )
    return graded(
        better,
        "Median distance of the model from the true surface, cm, identity to previous: "
        f"{', '.join(texts)}.",
        "case",
    )


@_states("worsened", "7", *_SCENES)
def _worsened(*cases: CaseResult, method: str) -> Finding:
    """“Already well determined camera transformations are often worsened.”"""
    fractions = []
    for case in cases:
        for run in case.select(method):
            truth = measures.motions(run.truth)
            before, after = (
                measures.displacement_m(measures.motions(e.poses), truth)
                for e in (run.before, run.after)
            )
            better_half = before <= np.nanmedian(before)
            fractions.append(float(np.mean(after[better_half] > before[better_half])))
    return graded(
        [1.0 if s > 0.4 else 0.5 if s > 0.2 else 0.0 for s in fractions],
        f"Of the better half of the motions {_median(fractions):.0%} are worse after optimisation.",
        "run",
    )


@dataclass(frozen=True)
class JudgedStatement:
    """A statement with its outcome for each method; peaks has only one method."""

    statement: Statement
    findings: Mapping[str, Finding]


def judge_all(results: Results, methods: Sequence[str]) -> tuple[JudgedStatement, ...]:
    """Judge every statement about the cases that were run."""
    judged = ((statement, statement.findings(results, methods)) for statement in STATEMENTS)
    return tuple(JudgedStatement(statement, found) for statement, found in judged if found)
