"""`tofuse repeat`: how well results of the same place agree, and whether their bounds hold.

All results are registered to the first one and compared with it at the same places of its surface.
A nested analysis of variance, as in a gauge R&R study (AIAG 2010), separates the variance within
sessions (repeatability) from that between them (reproducibility). Results in the same folder are
of one session.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from tofuse._version import __version__
from tofuse.apps.compare.comparing import compared
from tofuse.apps.compare.deviations import Places, mapped
from tofuse.apps.compare.nearest import Reach, Reference, measured_points
from tofuse.apps.compare.surface import Surface, spacing_of, surface_of
from tofuse.apps.report import scene
from tofuse.apps.results import folders, load_result, reopening, run_json
from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.normal import OF_95_PERCENT
from tofuse.engine.progress import Progress
from tofuse.engine.results import Reconstruction

# Points of a place in every result.
_MIN_POINTS = 6
# Trajectories are repeated ones if the median distance is below this fraction of the diagonal, and
# the median angle below this, rad: a camera that turns on the spot has positions of any other one.
_SAME_PATH, _SAME_TURN = 0.05, 0.1
# Dimensions: distances between parallel places, of at least this fraction of the diagonal.
_PARALLEL, _MIN_LENGTH, _MAX_DIMENSIONS = 0.95, 0.2, 500
# Errors of places closer than this fraction of the diagonal count as one.
_INDEPENDENT = 0.15


@dataclass(frozen=True, eq=False)
class Session:
    """A result among its repetitions.

    Attributes
    ----------
    name, session
        Its name, and that of its session: its folder, or the path of it if others have that name.
    result
        The result; None where only a surface is known.
    surface
        Its surface.
    """

    name: str
    session: str
    result: Reconstruction | None
    surface: Surface


@dataclass(frozen=True)
class Component:
    """Variance components of one kind of quantity, as standard deviations.

    Attributes
    ----------
    name, unit
        Of the quantity: "surface", "dimension", "position" (m) or "rotation" (rad).
    quantities
        Number of places, dimensions, or coordinates of poses that are pooled.
    repeatability
        Within sessions; None without repetitions in a session.
    reproducibility
        Between sessions, without the variance within them unless that is unknown; None if there is
        one session.
    total
        Of both.
    within, between
        Degrees of freedom for each quantity.
    """

    name: str
    unit: str
    quantities: int
    repeatability: float | None
    reproducibility: float | None
    total: float
    within: int
    between: int


@dataclass(frozen=True)
class Held:
    """How many differences are within the combined 95 % bounds of two results.

    Attributes
    ----------
    name
        "surface" or "poses".
    share, low, high
        Fraction, and its 95 % interval (Clopper and Pearson 1934) by independent differences.
    differences, independent
        Number of differences, and of those that count as independent.
    """

    name: str
    share: float
    low: float
    high: float
    differences: int
    independent: int


@dataclass(frozen=True, eq=False)
class Repetition:
    """Results of the same place, compared.

    Attributes
    ----------
    sessions
        The results; the first one is the reference.
    components, held
        What was found.
    common
        Fraction of the places of the first result that all others saw.
    warnings
        What was not compared, in sentences.
    """

    sessions: tuple[Session, ...]
    components: tuple[Component, ...]
    held: tuple[Held, ...]
    common: float
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `repeat.json`: SI units and radians, null where unknown."""
        return run_json.plain(
            {
                "schema": 1,
                "version": __version__,
                "results": [{"name": s.name, "session": s.session} for s in self.sessions],
                "common": self.common,
                "components": [vars(c) for c in self.components],
                "bounds": [vars(h) for h in self.held],
                "warnings": self.warnings,
            }
        )


def loaded_sessions(paths: Sequence[Path], progress: Progress) -> list[Session]:
    """Read results; those in the same folder are of one session.

    Raises
    ------
    InputError
        If there are fewer than two, one can't be read, or two are of the same frames.
    """
    if len(paths) < 2:
        raise InputError("is a single result", where="RESULT", remedy="pass two or more")
    sessions = []
    for path in paths:
        folders.check_result(path)
    reopening.check_different(paths)
    parents = [path.resolve().parent for path in paths]
    names = Counter(folder.name for folder in set(parents))
    for path, parent in zip(paths, parents, strict=True):
        result = load_result(path)
        surface = surface_of(result, str(path))
        session = parent.name if names[parent.name] == 1 else str(parent)
        sessions.append(Session(str(path), session, result, surface))
        progress.advance()
    return sessions


def repeated(sessions: Sequence[Session], *, searched: bool = True) -> Repetition:
    """Compare results of the same place; without a search they are in the same coordinates.

    Raises
    ------
    InputError
        If a result can't be registered to the first one.
    """
    first = sessions[0].surface
    reference = Reference.of(first)
    reach = Reach.of(reference, spacing_of(first.points))
    places = mapped(measured_points(first, reference), reference, np.eye(4), reach).places
    poses, deviation, sigma, seen = [], [], [], []
    for k, session in enumerate(sessions):
        T = np.eye(4)
        if k:
            comparison = compared(session.surface, reference, searched=searched)
            registration = comparison.registration
            if registration is not None and not (registration.believed or comparison.given):
                raise InputError(comparison.reason, where=session.name, remedy="leave it out")
            T = comparison.deviations.T_reference_measured
        shared = session.surface.shared_m or 0.0
        measured = measured_points(session.surface, reference)
        at = mapped(measured, reference, T, reach, shared_m=shared, centres=places).places
        poses.append(T)
        deviation.append(at.deviation)
        sigma.append(at.sigma)
        seen.append(at.points >= _MIN_POINTS)
    common: Bool = np.all(seen, axis=0)
    if common.sum() < 2:
        raise InputError("have no surface in common", where="the results")
    y, s = np.stack(deviation, 1)[common], np.stack(sigma, 1)[common]
    _, group = np.unique([session.session for session in sessions], return_inverse=True)
    found = [components("surface", "m", y, group)]
    if (lengths := _dimensions(places, common, y, reference.diagonal)) is not None:
        found.append(components("dimension", "m", lengths, group))
    held = [_held_surface(places.centres[common], y, s, reference.diagonal)]
    warnings = []
    motions = _pose_differences(sessions, poses, reference.diagonal)
    if isinstance(motions, str):
        warnings.append(motions)
    else:
        found.append(components("position", "m", motions[:, :3].reshape(-1, len(sessions)), group))
        found.append(
            components("rotation", "rad", motions[:, 3:].reshape(-1, len(sessions)), group)
        )
        held += _held_poses(sessions, motions)
    if group.max() == 0:
        warnings.append(
            "all results are of one session: put those of each session into a folder of its own"
        )
    return Repetition(
        tuple(sessions), tuple(found), tuple(held), float(common.mean()), tuple(warnings)
    )


def components(name: str, unit: str, values: Float64, group: Intp) -> Component:
    """Return the variance components of quantities (Q, R) in R results of sessions `group` (R,)."""
    count = np.bincount(group)
    total, sessions = len(group), len(count)
    means = np.stack([values[:, group == k].mean(1) for k in range(sessions)], 1)
    within, between = total - sessions, sessions - 1
    inside = ((values - means[:, group]) ** 2).sum() / len(values)
    outside = (count * (means - values.mean(1, keepdims=True)) ** 2).sum() / len(values)
    v_within = inside / within if within else 0.0
    v_between = 0.0
    if between:
        size = (total - (count**2).sum() / total) / between
        v_between = max(outside / between - v_within, 0.0) / size
    return Component(
        name,
        unit,
        len(values),
        float(np.sqrt(v_within)) if within else None,
        float(np.sqrt(v_between)) if between else None,
        float(np.sqrt(v_within + v_between)),
        within,
        between,
    )


def _dimensions(places: Places, common: Bool, y: Float64, diagonal: float) -> Float64 | None:
    """Return changes of distances (Q, R) between parallel places; None without any."""
    p, n = places.centres[common], places.normals[common]
    a, b = np.triu_indices(len(p), 1)
    offset = p[b] - p[a]
    length = np.linalg.norm(offset, axis=1)
    axis = offset / np.maximum(length, 1e-12)[:, None]
    along_a, along_b = (n[a] * axis).sum(1), (n[b] * axis).sum(1)
    kept = (np.abs(along_a) > _PARALLEL) & (np.abs(along_b) > _PARALLEL)
    kept &= length > _MIN_LENGTH * diagonal
    if not kept.any():
        return None
    chosen = np.flatnonzero(kept)
    chosen = chosen[scene.random_subset(len(chosen), _MAX_DIMENSIONS)]
    return np.asarray(
        along_b[chosen, None] * y[b[chosen]] - along_a[chosen, None] * y[a[chosen]], np.float64
    )


def _pose_differences(
    sessions: Sequence[Session], poses: Sequence[Float64], diagonal: float
) -> Float64 | str:
    """Return differences (F, 6, R) of the poses from the first result's, or why there are none."""
    results = [session.result for session in sessions]
    trajectories = [se3.translation(r.shift) @ r.trajectory for r in results if r is not None]
    if len(trajectories) < len(results) or len({len(t) for t in trajectories}) > 1:
        return "poses are not compared: the results have different numbers of frames"
    finite = np.isfinite(np.stack(trajectories)).all((0, 2, 3))
    other_path = "poses are not compared: the camera did not repeat its path"
    if not finite.any():
        return other_path
    in_first = [T @ t[finite] for T, t in zip(poses, trajectories, strict=True)]
    back = se3.inverse(in_first[0])
    motions = np.stack([se3.log(back @ t) for t in in_first], axis=2)
    apart = [np.median(np.linalg.norm(part, axis=1), 0) for part in np.split(motions, 2, axis=1)]
    is_same = apart[0].max() <= _SAME_PATH * diagonal and apart[1].max() <= _SAME_TURN
    return motions if is_same else other_path


def _held_surface(centres: Float64, y: Float64, s: Float64, diagonal: float) -> Held:
    pairs = list(combinations(range(y.shape[1]), 2))
    inside = [
        np.abs(y[:, a] - y[:, b]) <= OF_95_PERCENT * np.hypot(s[:, a], s[:, b]) for a, b in pairs
    ]
    cells = np.unique(np.floor(centres / (_INDEPENDENT * diagonal)), axis=0)
    independent = min(len(cells) * (y.shape[1] - 1), y.shape[0] * len(pairs))
    return _held("surface", float(np.mean(inside)), y.shape[0] * len(pairs), independent)


def _held_poses(sessions: Sequence[Session], motions: Float64) -> list[Held]:
    bounds = [s.result.diagnostics.accuracy.position_m for s in sessions if s.result is not None]
    pairs = list(combinations(range(len(bounds)), 2))
    inside = [
        float(np.sqrt(((motions[:, :3, a] - motions[:, :3, b]) ** 2).sum(1).mean()))
        <= np.hypot(bounds[a], bounds[b])
        for a, b in pairs
    ]
    return [_held("poses", float(np.mean(inside)), len(pairs), len(bounds) - 1)]


def _held(name: str, share: float, differences: int, independent: int) -> Held:
    k = share * independent
    low = float(beta.ppf(0.025, k, independent - k + 1)) if k > 0 else 0.0
    high = float(beta.ppf(0.975, k + 1, independent - k)) if k < independent else 1.0
    return Held(name, share, low, high, differences, independent)
