"""``tofuse.compare``: a result against a CAD model, a mesh, a cloud or another result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from tofuse._version import __version__
from tofuse.apps.compare.deviations import COVERAGE, DeviationMap, Places, fitted, mapped
from tofuse.apps.compare.nearest import Reach, Reference, measured_points
from tofuse.apps.compare.surface import (
    UNITS_M,
    Comparable,
    Surface,
    in_metres,
    spacing_of,
    surface_of,
)
from tofuse.apps.pairs import PairResult, pair_words, register
from tofuse.apps.report import scene
from tofuse.apps.results import run_json
from tofuse.engine import quantities
from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.bounds import Bounds
from tofuse.engine.clouds import AnyPair
from tofuse.engine.errors import InputError, RegistrationError, signals_as_themselves
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.normal import OF_95_PERCENT
from tofuse.engine.parts import check_number
from tofuse.formats.geometry import surface_points
from tofuse.formats.recordings import SingleView

Verdict = Literal["pass", "fail", "undecided", "not seen"]
_VERDICTS = "undecided", "pass", "fail"  # of a place, by its number: 0, 1, -1
WORST = 5  # places that are listed of each region
_MAX_POINTS = 100_000  # that are registered
# A reference is symmetric if this fraction of it, moved, lies within this fraction of its diagonal.
_SYMMETRIC_SHARE, _SYMMETRIC_DISTANCE, _SYMMETRIC_POINTS = 0.9, 2e-3, 4000
# Fraction of the points facing the other way from which a reference is turned. Near thin sheets,
# whose two sides are within the noise, it is a half.
_TURNED_SHARE = 0.8
_NEARER = 0.5  # distance from the guess to a pose, relative to that to a rival which it excludes
_MAX_RIVAL = 0.9  # fraction of the points of a pose that a rival may explain, to be excluded
_MAX_FITTED = 0.3  # by which a fit changes a symmetry, as a fraction of it
_NAMED = 0.005  # fraction of a surface from which it is said that it is not compared
_TURNED_NAMED = 0.05  # the same for faces that point the other way, as those of thin parts may
_SLIDE = 0.02  # along a direction that is not determined, as a fraction of the diagonal


@dataclass(frozen=True)
class Region:
    """A face of the reference, or a part of its surface.

    Attributes
    ----------
    name
        For display.
    area_m2, seen
        Its area, and the fraction of it that was measured.
    verdict
        "pass" or "fail" as ISO 14253-1 defines them, "undecided", as always without a tolerance, or
        "not seen".
    places, outside, changed
        Number of places, of those outside the tolerance, and of significant deviations.
    mean_m, mean_sigma_m
        Mean deviation, and its standard deviation, m.
    worst_m, worst_sigma_m
        Largest deviation of a place, and its standard deviation, m.
    detectable_m
        A deviation of this size is significant with a probability of 95 % at any of its places, m.
    """

    name: str
    area_m2: float
    seen: float
    verdict: Verdict
    places: int = 0
    outside: int = 0
    changed: int = 0
    mean_m: float = np.nan
    mean_sigma_m: float = np.nan
    worst_m: float = np.nan
    worst_sigma_m: float = np.nan
    detectable_m: float = np.nan


@dataclass(frozen=True, eq=False)
class Comparison:
    """A result compared with a reference.

    Attributes
    ----------
    verdict
        Of all that was seen: "pass", "fail" or "undecided"; None without a tolerance.
    tolerance_m
        Largest deviation allowed, to either side, m; None for none.
    regions
        The largest first.
    deviations
        Deviations of points and places.
    registration
        The initial registration; None if the surfaces were given in the same coordinates.
    given
        What the pose takes for granted by symmetries and free motions, in words; may be empty.
    reason
        Why nothing can be decided; empty otherwise.
    shared_m
        Standard deviation of the errors that neighbouring places share, m; inf if not bounded.
    warnings
        What was assumed, in sentences.
    measured, reference
        Both surfaces, in m.
    """

    verdict: Verdict | None
    tolerance_m: float | None
    regions: tuple[Region, ...]
    deviations: DeviationMap
    registration: Registration | None
    given: str
    reason: str
    shared_m: float
    warnings: tuple[str, ...]
    measured: Surface
    reference: Reference

    def __repr__(self) -> str:
        return f"{type(self).__name__}: {self.sentence}"

    @property
    def seen(self) -> float:
        """Fraction of the reference's area that was measured."""
        area = self.reference.area
        return float(area[self.deviations.seen].sum() / area.sum())

    @property
    def changed(self) -> int:
        """Number of places with a significant deviation."""
        return sum(region.changed for region in self.regions)

    @cached_property
    def worst(self) -> list[dict[str, Any]]:
        """The places that deviate most, of each region."""
        places = self.deviations.places
        verdicts = _verdicts(places, self.tolerance_m, decided=not self.reason)
        rows: list[dict[str, Any]] = []
        for k, region in enumerate(self.regions):
            of = np.flatnonzero(places.region == k)
            order = np.argsort(-np.abs(places.deviation[of]), kind="stable")
            rows += [
                {
                    "region": region.name,
                    **dict(zip("xyz", places.centres[i].tolist(), strict=True)),
                    "deviation_m": float(places.deviation[i]),
                    "sigma_m": float(places.sigma[i]),
                    "expanded_m": COVERAGE * float(places.sigma[i]),
                    "uneven_m": float(places.uneven[i]),
                    "slope_m": float(places.slope[i]),
                    "points": int(places.points[i]),
                    "verdict": _VERDICTS[verdicts[i]] if self.tolerance_m else "",
                }
                for i in of[order][:WORST].tolist()
            ]
        return rows

    @property
    def sentence(self) -> str:
        """What was found, in a few sentences."""
        places = self.deviations.places
        limit_m = self.tolerance_m
        certain = places.changed if limit_m is None else places.verdicts(limit_m) < 0
        # Where any is certain, an uncertain one is not the largest.
        worst = int((np.abs(places.deviation) * (certain | ~certain.any())).argmax())
        at = ", ".join(f"{1e3 * v:z.0f}" for v in places.centres[worst])
        largest = (
            f"{millimetres(places.deviation[worst])} \N{PLUS-MINUS SIGN} "
            f"{millimetres(COVERAGE * places.sigma[worst])} mm at ({at}) mm"
        )
        if self.reason:
            found = f"Undecided: {self.reason}"
        elif self.tolerance_m is None:
            count = self.changed
            found = f"{count} of {len(places.deviation)} places differ significantly"
            found = found if count else "No place differs significantly"
            found += f"; the largest deviation is {largest}"
        else:
            limit = f"{1e3 * self.tolerance_m:g} mm"
            counts = places.verdicts(self.tolerance_m)
            near = counts == 0
            undecided = f"{_places(near)} too close to {limit} for "
            undecided += f"{'its' if near.sum() == 1 else 'their'} uncertainty"
            if not near.any():
                undecided = "not all of the surface has a counterpart"
            head = {
                "pass": f"Pass: every place seen is within {limit}",
                "fail": f"Fail: {_places(counts < 0)} outside {limit}",
                "undecided": f"Undecided: {undecided}",
            }
            found = f"{head[str(self.verdict)]}; the largest deviation is {largest}"
        if self.given:
            found += f" ({self.given})"
        found += (
            f". {quantities.percent(1 - self.seen)} of the reference was not seen, and of what was "
            f"measured {quantities.percent(self.deviations.beyond)} has no counterpart in it."
        )
        if not self.deviations.unmatched:
            return found
        first = self.deviations.unmatched[0]
        at = ", ".join(f"{1e3 * v:z.0f}" for v in first.centre_m)
        area = 1e4 * sum(each.area_m2 for each in self.deviations.unmatched)
        return (
            f"{found} The reference lacks {area:.0f} cm\N{SUPERSCRIPT TWO} of what was measured, "
            f"most of it around ({at}) mm, up to {quantities.length(first.distance_m)} away: "
            "a feature is missing, additional or elsewhere, or something touches the part."
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `compare.json`: SI units, null where unknown."""
        places, found = self.deviations.places, self.registration
        return run_json.plain(
            {
                "schema": 1,
                "version": __version__,
                "verdict": self.verdict,
                "sentence": self.sentence,
                "reason": self.reason,
                "result": {"name": self.measured.name, "unit": self.measured.unit},
                "reference": {
                    "name": self.reference.surface.name,
                    "unit": self.reference.surface.unit,
                    "seen": self.seen,
                },
                "tolerance_m": self.tolerance_m,
                "coverage_factor": COVERAGE,
                "coverage_factor_of_all": places.coverage_of_all,
                "T_reference_result": self.deviations.T_reference_measured,
                "believed": None if found is None else found.believed,
                "given": self.given,
                "undetermined_motions": self.deviations.free,
                "shared_sigma_m": self.shared_m,
                "noise_scale": self.deviations.noise_scale,
                "place_size_m": places.size,
                "left_out_at_edges_m": self.deviations.left_out,
                "places": len(places.deviation),
                "changed": self.changed,
                "without_counterpart": self.deviations.beyond,
                "unmatched": [vars(each) for each in self.deviations.unmatched],
                "regions": [vars(region) for region in self.regions],
                "worst": self.worst,
                "warnings": self.warnings,
            }
        )


def _places(chosen: Bool) -> str:
    count = int(chosen.sum())
    return f"{count} of {len(chosen)} places {'is' if count == 1 else 'are'}"


def _verdicts(places: Places, tolerance_m: float | None, *, decided: bool) -> Intp:
    """The verdicts of places; 0, undecided, without a tolerance or if nothing can be decided."""
    if tolerance_m is None or not decided:
        return np.zeros(len(places.deviation), np.intp)
    return places.verdicts(tolerance_m)


def millimetres(metres: float) -> str:
    """Return a length in mm as text, to a hundredth below 10 mm."""
    mm = 1e3 * float(metres)
    return f"{mm:z.2f}" if abs(mm) < 9.995 else f"{mm:.1f}"


@signals_as_themselves()
def compare(
    result: Comparable,
    reference: Comparable,
    *,
    tolerance_m: float | None = None,
    guess: ArrayLike | None = None,
    accuracy_m: float | None = None,
    unit: Literal["mm", "cm", "m", "in"] | None = None,
) -> Comparison:
    """Compare a result with a CAD model, a mesh, a cloud or another result.

    Both are registered, without a guess unless one is given, and the pose is refined over all
    points. The deviation is the signed distance from the reference's triangles, positive outside,
    where the surface was seen, and has a standard deviation.

    Parameters
    ----------
    result
        A result, mesh or cloud, the path of one, or (N, 3) points in m.
    reference
        The same, such as a CAD model in STL.
    tolerance_m
        Largest deviation allowed, to either side, m; None for no verdict.
    guess
        (4, 4) T_reference_result to start from; searched unless given.
    accuracy_m
        95 % bound on errors that neighbouring points of the result share, m; what the result states
        unless given, and none for files.
    unit
        Of the reference's file; recognised unless given.

    Raises
    ------
    InputError
        If a file can't be used, or nothing overlaps.
    """
    start = None if guess is None else se3.check_pose(guess, where="guess")
    for value, where in ((tolerance_m, "tolerance_m"), (accuracy_m, "accuracy_m")):
        if value is not None:
            check_number(value, Bounds(0, exclusive=True), where)
    if unit is not None and (not isinstance(unit, str) or unit not in UNITS_M):
        raise InputError(f"is {unit!r}", where="unit", remedy=f"use one of {', '.join(UNITS_M)}")
    measured, nominal, said = in_metres(surface_of(result), surface_of(reference), unit)
    if accuracy_m is not None:
        measured = replace(measured, shared_m=accuracy_m / OF_95_PERCENT)
    return compared(measured, Reference.of(nominal), tolerance_m, start, said)


def compared(
    measured: Surface,
    reference: Reference,
    tolerance_m: float | None = None,
    guess: Float64 | None = None,
    said: str = "",
    searched: bool = True,
) -> Comparison:
    """Compare two surfaces in m; see `compare`. Without a search they are near the guess."""
    measured = measured_points(measured, reference)
    reach = Reach.of(reference, spacing_of(measured.points), tolerance_m)
    registration, given, reason = None, "", ""
    T = np.eye(4) if guess is None else guess
    if searched:
        registration, given, reason = _registered(measured, reference, guess)
        T = registration.T_target_source
    reference = _facing_alike(measured, reference, T)
    T, free = fitted(measured, reference, T, reach, tolerance_m)
    shared_m = float(np.hypot(measured.shared_m or 0.0, reference.surface.shared_m or 0.0))
    deviations = mapped(measured, reference, T, reach, tolerance_m, shared_m, free)
    if not len(deviations.places.deviation):
        why = "; ".join(filter(None, (said, reason)))
        swapped = reference.surface.is_result and not measured.is_result
        raise InputError(
            f"has no surface within {quantities.length(reach.along)} of {reference.surface.name}"
            + (f" ({why})" if why else ""),
            where=measured.name,
            remedy="state the result first, then what it should be"
            if swapped
            else "check the units (--unit), or pass --guess",
        )
    warnings = [said] if said else []
    if measured.shared_m is None:
        warnings.append(
            f"{measured.name} states no accuracy: only noise is known, and errors that all of its "
            "points share are not (--accuracy)"
        )
    warnings += [
        f"only one view saw {quantities.percent(of.left_out)} of {of.name}: nothing confirms that, "
        "so it is not compared"
        for of in (measured, reference.surface)
        if of.left_out > _NAMED
    ]
    turned = _behind_faces(measured, reference, T, reach)
    if turned > _TURNED_NAMED:
        warnings.append(
            f"{quantities.percent(turned)} of what was measured lies on faces of "
            f"{reference.surface.name} that point the other way, so it has no counterpart: check "
            "the winding order of its triangles"
        )
    if not np.isfinite(shared_m):
        reason = reason or "the poses of the result are not bounded in some direction"
    regions = tuple(_regions(deviations, reference, tolerance_m, decided=not reason))
    verdict = None if tolerance_m is None else _of_all(regions, reason)
    if verdict == "pass" and deviations.unmatched:
        verdict = "undecided"
    return Comparison(
        verdict, tolerance_m, regions, deviations, registration, given, reason, shared_m,
        tuple(warnings), measured, reference,
    )  # fmt: skip


def _of_all(regions: tuple[Region, ...], reason: str) -> Verdict:
    verdicts = {region.verdict for region in regions}
    if reason or not verdicts & {"pass", "fail"}:
        return "undecided"
    return "fail" if "fail" in verdicts else "undecided" if "undecided" in verdicts else "pass"


def _registered(
    measured: Surface, reference: Reference, guess: Float64 | None
) -> tuple[Registration, str, str]:
    """Return the registration, what it takes for granted, and why it is not accepted."""
    points = measured.points[scene.random_subset(len(measured.points), _MAX_POINTS)]
    surface = reference.surface
    target = surface_points(GeometryRecord(surface.points, surface.faces), surface.name)
    target = target[scene.random_subset(len(target), _MAX_POINTS)]
    found, rival = _best_registration(measured, reference, points, target, guess)
    T = found.T_target_source
    names = []
    if rival is not None and (found.given_guess or not found.believed):
        motion = rival @ se3.inverse(T)
        if _is_symmetry(reference, motion):
            names.append(f"{_motion_words(motion)} it fits as well")
        elif found.given_guess and guess is not None:
            names.append("another pose fits nearly as well")
        elif found.given_guess:
            reason, remedy = "another pose fits as well", "a guess near this one"
            found = replace(found, believed=False, reason=reason, remedy=remedy)
    if _slides(reference, T, found.unobservable):
        frames = [
            SingleView(n, n, "", 0, CloudFrame.of(p)) for n, p in (("", points), ("", target))
        ]
        pair = PairResult(frames[0], frames[1], found)
        names.append(f"{pair_words.unobservable(pair)} is not determined")
    start = "this pose" if guess is None else "the guess"
    given = f"given {start}: {'; '.join(names)}" if names else ""
    if found.believed or given:
        return found, given, ""
    return found, "", f"the registration is not accepted: {pair_words.doubt(found)}"


def _best_registration(
    measured: Surface, reference: Reference, points: Float64, target: Float64, guess: Float64 | None
) -> tuple[Registration, Float64 | None]:
    """Return the registration of points to those of the target, and a pose that may fit as well."""
    try:
        found = register(points, target, guess=guess)
    except RegistrationError as error:
        raise InputError(
            f"can't be registered to {reference.surface.name} ({error})",
            where=measured.name,
            remedy="check the units (--unit), or pass --guess",
        ) from error
    if not found.believed and found.runner_up is not None:
        # All points tell poses apart that the registration, by fewer, can't.
        near = register(points, target, guess=found.T_target_source)
        worse = _explained(measured, reference, found.runner_up)
        if near.believed and worse < _MAX_RIVAL * _explained(
            measured, reference, near.T_target_source
        ):
            found = near
    T, rival = found.T_target_source, found.runner_up
    if (
        guess is not None
        and rival is not None
        and not found.believed
        and _distance(points, T, guess) < _NEARER * _distance(points, rival, guess)
    ):
        # Whoever states where the part lies excludes poses elsewhere.
        alone = register(points, target, guess=T, method=AnyPair(search=False))
        if alone.believed:
            found = alone
    return found, rival


def _distance(points: Float64, T: Float64, T_other: Float64) -> float:
    """Return the mean distance of points (N, 3) moved by two poses."""
    apart = se3.transform(T, points) - se3.transform(T_other, points)
    return float(np.linalg.norm(apart, axis=1).mean())


def _explained(measured: Surface, reference: Reference, T: Float64) -> float:
    """Return the fraction of points near the reference at a pose, after its fit."""
    reference = _facing_alike(measured, reference, T)
    reach = Reach.of(reference, spacing_of(measured.points))
    T, _ = fitted(measured, reference, T, reach, None)
    found = reference.distances(*_some_at(measured, T), reach, oriented=measured.oriented)
    return float((np.abs(found.signed) < _SYMMETRIC_DISTANCE * reference.diagonal).mean())


def _some_at(measured: Surface, T: Float64) -> tuple[Float64, Float64]:
    """Return a sample of the points (n, 3) and their normals (n, 3), moved by a pose (4, 4)."""
    chosen = scene.random_subset(len(measured.points), _SYMMETRIC_POINTS)
    return se3.transform(T, measured.points[chosen]), measured.normals[chosen] @ T[:3, :3].T


def _facing_alike(measured: Surface, reference: Reference, T: Float64) -> Reference:
    """Return the reference, turned if nearly all that was measured at a pose faces the other way.

    Rooms are closed and face inwards; not all files have the order of corners that formats demand.
    """
    if not (measured.oriented and reference.surface.oriented):
        return reference
    points, normals = _some_at(measured, T)
    reach = Reach.of(reference, spacing_of(measured.points))
    found = reference.distances(points, normals, reach, oriented=False)
    facing = (found.normals * normals).sum(1)[found.compared]
    is_turned = len(facing) > 0 and (facing < 0).mean() > _TURNED_SHARE
    return replace(reference, normals=-reference.normals) if is_turned else reference


def _behind_faces(measured: Surface, reference: Reference, T: Float64, reach: Reach) -> float:
    """Return the fraction of the points whose only counterpart faces the other way."""
    points, normals = _some_at(measured, T)
    facing, either = (
        reference.distances(points, normals, reach, oriented=oriented).compared
        for oriented in (measured.oriented, False)
    )
    return float((either & ~facing).mean())


def _is_symmetry(reference: Reference, motion: Float64, *, exact: bool = False) -> bool:
    """Whether the reference, moved, is nearly the same surface; an inexact motion is fitted."""
    chosen = scene.random_subset(len(reference.centres), _SYMMETRIC_POINTS)
    itself = Surface("", reference.centres[chosen], reference.normals[chosen])
    points = itself.points
    reach = Reach.of(reference, reference.size)
    T = motion if exact else fitted(itself, reference, motion, reach, None)[0]

    def apart(a: Float64, b: Float64) -> float:
        between = se3.transform(a, points) - se3.transform(b, points)
        return float(np.sqrt((between**2).sum(1).mean()))

    if apart(T, motion) > _MAX_FITTED * apart(motion, np.eye(4)):
        return False  # it is no motion of its own
    normals = itself.normals @ T[:3, :3].T
    found = reference.distances(se3.transform(T, points), normals, reach)
    close: Bool = np.abs(np.nan_to_num(found.signed, nan=np.inf)) < (
        _SYMMETRIC_DISTANCE * reference.diagonal
    )
    return float(close.mean()) >= _SYMMETRIC_SHARE


def _slides(reference: Reference, T: Float64, directions: Float64) -> bool:
    """Whether the reference slides along itself in all of the undetermined directions."""
    if not len(directions):
        return False
    size = reference.diagonal
    motions = [
        T
        @ se3.exp(
            _SLIDE * size * d / max(np.linalg.norm(d[:3]) + size * np.linalg.norm(d[3:]), 1e-9)
        )
        for d in directions
    ]
    return all(_is_symmetry(reference, m @ se3.inverse(T), exact=True) for m in motions)


def _motion_words(motion: Float64) -> str:
    angle = np.degrees(se3.angle(motion))
    if angle < 1:
        return f"moved by {quantities.length(float(np.linalg.norm(motion[:3, 3])))}"
    axis = se3.so3_log(motion[:3, :3])
    about = pair_words.vector(axis / np.linalg.norm(axis), 2)
    return f"turned by {angle:.0f}\N{DEGREE SIGN} about {about}"


def _regions(
    deviations: DeviationMap, reference: Reference, tolerance_m: float | None, *, decided: bool
) -> list[Region]:
    places, area = deviations.places, reference.area
    count = int(reference.region.max()) + 1
    areas = np.bincount(reference.region, area)
    seen = np.bincount(reference.region, area * deviations.seen) / areas
    facing = [np.bincount(reference.region, area * reference.normals[:, k]) for k in range(3)]
    verdicts = _verdicts(places, tolerance_m, decided=decided)
    changed = places.changed & decided
    name: Callable[[int], str] = _namer(np.stack(facing, 1) / areas[:, None], reference.has_faces)
    regions = []
    for k in range(count):
        chosen = places.region == k
        if not chosen.any():
            regions.append(Region(name(k), float(areas[k]), float(seen[k]), "not seen"))
            continue
        of = verdicts[chosen]
        verdict: Verdict = "fail" if (of < 0).any() else "pass" if (of > 0).all() else "undecided"
        worst = np.flatnonzero(chosen)[np.abs(places.deviation[chosen]).argmax()]
        regions.append(
            Region(
                name(k), float(areas[k]), float(seen[k]), verdict, len(of), int((of < 0).sum()),
                int(changed[chosen].sum()), *places.mean(chosen),
                float(places.deviation[worst]), float(places.sigma[worst]),
                float(places.detectable[chosen].max()),
            )
        )  # fmt: skip
    return regions


def _namer(facing: Float64, has_faces: bool) -> Callable[[int], str]:
    kind = "face" if has_faces else "region"

    def name(k: int) -> str:
        axis = int(np.abs(facing[k]).argmax())
        sign = "+" if facing[k, axis] > 0 else "\N{MINUS SIGN}"
        return f"{kind} {k + 1} ({sign}{'xyz'[axis]})"

    return name
