"""The configuration of a reconstruction: its parts and their options."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tofuse.engine import parts, quantities
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.errors import InputError
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.fusion import Fusion
from tofuse.engine.graph import Optimiser, external_sensors
from tofuse.engine.loops import Joining, LoopDetector
from tofuse.engine.refinement import NoRefinement, RefinementMethod
from tofuse.engine.search import SearchOptions
from tofuse.engine.sensor import Correction
from tofuse.engine.tracking import Odometry

# Fractions of the total. The remainder is for the program itself (about 400 MB), frames being
# processed, data computed from stored views, and the result.
_VOXELS, _VIEWS, _CHECKED = 0.3, 0.03, 0.005


def voxels_mb(memory_mb: int) -> int:
    """Return the memory of fusion for voxels, MB; see `Fusion.memory_mb`."""
    return max(1, int(_VOXELS * memory_mb))


def checked_bytes(memory_mb: int) -> int:
    """Return the memory for the images of the final comparison, bytes."""
    return int(_CHECKED * memory_mb * 1_000_000)


def views_bytes(memory_mb: int) -> int:
    """Return the memory for the prepared views of loops and refinement, bytes."""
    return int(_VIEWS * memory_mb * 1_000_000)


ViewKind = Literal["range", "cloud"]

MIN_MEMORY_MB = 500  # of a run


@dataclass(frozen=True)
class Config(Bounded):
    """Everything that determines a result, except the recording and the seed.

    Attributes
    ----------
    method
        Name of the configuration that it is based on, for display.
    filters
        Applied in this order to every frame.
    odometry
        Tracks the camera.
    loops
        Detects and verifies loops.
    optimiser
        Optimises the pose graph.
    fusion
        Makes the model.
    refinement
        Optimises all poses jointly, after loops are closed.
    corrections
        Applied in this order to every frame, before the filters.
    model_filters
        Applied after tracking, to the views of the model: the tracker weights each pixel by its
        noise and loses accuracy without noisy pixels, which a clean model must leave out.
    priors
        External sensors whose measurements are used.
    search
        Exhaustive searches for the pose of a view: of lost frames, loops and components.
    joining
        Connects components that were tracked separately.
    self_calibration
        Whether a recording is reconstructed again with a corrected calibration if it shows an
        error of its camera.
    tolerance_m
        A result is good if the 95 % bound of the poses' rms error is within it, m; None for 0.5 %
        of the model's diagonal, at least 1 cm.
    memory_mb
        Approximate memory of a run; data that does not fit is stored on disk.
    """

    method: str
    filters: tuple[Filter, ...]
    odometry: Odometry
    loops: LoopDetector
    optimiser: Optimiser
    fusion: Fusion
    refinement: RefinementMethod = NoRefinement()  # noqa: RUF009 - immutable
    corrections: tuple[Correction, ...] = ()
    model_filters: tuple[Filter, ...] = ()
    priors: tuple[external_sensors.ExternalSensor, ...] = ()
    search: SearchOptions = SearchOptions()  # noqa: RUF009 - immutable
    joining: Joining = Joining()  # noqa: RUF009 - immutable
    self_calibration: bool = True
    tolerance_m: Annotated[float | None, Bounds(0, exclusive=True)] = None
    memory_mb: Annotated[int, Bounds(MIN_MEMORY_MB, 10_000_000)] = 2000

    @property
    def window(self) -> int:
        """Number of frames that the filters use, the current one included."""
        return max([f.window for f in (*self.filters, *self.model_filters)], default=1)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as in `run.json`."""
        return dict(parts.to_dict(self))


def checked(config: Any) -> Config:
    """Return the configuration, or raise InputError if it is none."""
    if not isinstance(config, Config):
        raise InputError(
            f"is {quantities.one(type(config).__name__)}, not a configuration",
            where="config",
            remedy='pass the name of one, such as "default", or a dictionary of options',
        )
    return config


PACKAGES = (
    "tofuse.engine.filters",
    "tofuse.engine.sensor",
    "tofuse.engine.icp",
    "tofuse.engine.clouds",
    "tofuse.engine.tracking",
    "tofuse.engine.graph",
    "tofuse.engine.loops",
    "tofuse.engine.refinement",
    "tofuse.lab.methods",
)


def changed(config: Config, changes: Mapping[str, Any], *, where: str) -> Config:
    """Return the configuration with some options replaced.

    Parameters
    ----------
    changes
        Nested options as in a TOML file. Tables are merged; a table that names another part
        replaces it completely, and so does a list. `memory_mb` is divided: fusion gets its share,
        unless the same changes set that.
    where
        Names the file in errors.

    Raises
    ------
    InputError
        For an option or part that does not exist, or a value of the wrong type.
    """
    for package in PACKAGES:
        parts.discover(package)
    merged = _merge(config.to_dict(), _divided(changes))
    result: Config = parts.from_dict(Config, merged, where=where)
    return result


def _divided(changes: Mapping[str, Any]) -> Mapping[str, Any]:
    """Add fusion's share of the requested memory."""
    megabytes = changes.get("memory_mb")
    if type(megabytes) is not int:  # not requested, or rejected later
        return changes
    return dict(_merge({"fusion": {"memory_mb": voxels_mb(megabytes)}}, changes))


def _merge(base: Any, change: Any) -> Any:
    if not (isinstance(base, Mapping) and isinstance(change, Mapping)):
        return change
    if "part" in change and change["part"] != base.get("part"):
        return dict(change)
    return {**base, **{key: _merge(base.get(key), value) for key, value in change.items()}}


def kind_of(frame: Frame) -> ViewKind:
    """Return "range" for an image of a camera, "cloud" for a bare cloud."""
    return "range" if isinstance(frame, RangeFrame) else "cloud"


def check_views(config: Config, kind: ViewKind) -> None:
    """Raise InputError if a part of the configuration does not support that kind of view.

    Parameters
    ----------
    kind
        "range" for images of a camera, "cloud" for bare clouds.
    """
    chosen: tuple[Correction | Filter | Odometry, ...] = (
        *config.corrections,
        *config.filters,
        *config.model_filters,
        config.odometry,
    )
    for part in chosen:
        if kind not in part.takes:
            raise InputError(
                f"{part.part_kind} {parts.name_of(part)!r} takes {sorted(part.takes)} "
                f"views, and this recording holds {kind} views",
                where="configuration",
                remedy="leave that part out with --config, or use another --method",
            )
