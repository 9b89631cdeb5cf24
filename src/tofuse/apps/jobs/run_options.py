"""The options of ``tofuse run``, and the configuration that they specify."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tofuse.apps.results import run_json
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.fusion import Fusion, Textured
from tofuse.engine.mapping import (
    MIN_MEMORY_MB,
    Config,
    ViewKind,
    adaptation,
    changed,
    from_method,
    texturing,
)
from tofuse.engine.parts import name_of
from tofuse.engine.progress import Progress
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import range_and_amplitude
from tofuse.engine.stopwatch import timing
from tofuse.formats.files import reading
from tofuse.formats.recordings import OpeningOptions

_SAMPLED = 8  # frames that are checked for the input of --unwrap
_NO_IMAGES = "needs depth images, and these are clouds"
_BACKGROUND_FILTERS = {"background", "foreground", "mask", "box"}


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Options of the model and of its verdict, of ``tofuse run`` and ``tofuse merge``.

    What is None is as in the configuration.

    Attributes
    ----------
    tolerance
        Accuracy required of a good model, m.
    texture
        Whether the surface gets a texture; None where colour images are fit for one.
    faces
        Maximum number of triangles.
    voxel
        Edge of a voxel, m.
    """

    tolerance: float | None = None
    texture: bool | None = None
    faces: int | None = None
    voxel: float | None = None

    def applied(self, config: Config) -> Config:
        """Return the configuration with these options."""
        texture = {None: None, False: 0, True: config.fusion.texture or Fusion.texture}[
            self.texture
        ]
        options: tuple[tuple[str, object, dict[str, Any]], ...] = (
            ("texture", texture, {"fusion": {"texture": texture}}),
            ("faces", self.faces, {"fusion": {"faces": self.faces}}),
            ("voxel", self.voxel, {"fusion": {"voxel_m": self.voxel}}),
            ("tolerance", self.tolerance, {"tolerance_m": self.tolerance}),
        )
        for option, value, changes in options:
            if value is not None:
                config = changed(config, changes, where=f"--{option}")
        return config

    @timing("texture")
    def make_texture(
        self,
        recording: Recording,
        result: Reconstruction,
        config: Config,
        threads: int | None,
        progress: Progress,
    ) -> Textured | None:
        """Make the texture unless none is wanted; with a note if one is required and impossible."""
        size, required = config.fusion.texture, bool(self.texture)
        texture = texturing.make_texture(
            recording, result, size, threads, progress, required=required
        )
        if texture is None and required:
            progress.note("no texture: there is no surface, or neither colour nor amplitude")
        return texture


@dataclass(frozen=True)
class Options(OpeningOptions, ModelOptions):
    """The options of ``tofuse run``; see its ``--help``."""

    out: Path
    method: str | None = None
    config: Path | None = None
    seed: int | None = None
    threads: int | None = None
    min_depth: float | None = None
    max_depth: float | None = None
    guess: Literal["identity", "previous", "odometry"] | None = None
    moving: Literal["exclude", "ignore"] | None = None
    prior: adaptation.Prior = "auto"
    loops: Path | None = None
    object: bool = False
    unwrap: bool = False
    memory: int | None = None
    overwrite: bool = False
    no_report: bool = False
    share: bool = False
    mirrors: bool = False


def resolve(options: Options, kind: ViewKind = "range") -> Config:
    """Return the configuration that the options specify, for a kind of view."""
    changes: dict[str, Any] = read_changes(options.config) if options.config else {}
    for name in ("mirrors", "unwrap"):
        if kind == "cloud" and getattr(options, name):
            raise InputError(_NO_IMAGES, where=f"--{name}", remedy="leave it out")
    method = options.method or changes.get("method") or "default"
    if not isinstance(method, str):
        raise InputError(f"is {method!r}", where=f"{options.config}: method")
    # A run.json states every option, so that nothing of another method would be left.
    if options.config and options.config.suffix == ".json" and method != changes.get("method"):
        raise InputError(
            f"is {method}, and {options.config} states all options of {changes.get('method')}",
            where="--method",
            remedy="leave one out, or write the options that differ to a .toml",
        )
    config = from_method(
        method, kind, where="--method" if options.method else f"{options.config}: method"
    )
    config = changed(config, {**changes, "method": method}, where=str(options.config or "--config"))
    for name in ("guess", "moving"):
        value = getattr(options, name)
        if value and not hasattr(config.odometry, name):
            raise InputError(
                f"does not apply to the odometry {name_of(config.odometry)!r}",
                where=f"--{name}",
                remedy="leave it out, or use the method default for images",
            )
        if value:
            config = changed(config, {"odometry": {name: value}}, where=f"--{name}")
    config = options.applied(config)
    if options.memory is not None:
        megabytes = options.memory // 1_000_000
        if megabytes < MIN_MEMORY_MB:
            raise InputError(
                f"is less than {MIN_MEMORY_MB} MB",
                where="--memory",
                remedy="allow more, e.g. --memory 2GB",
            )
        config = changed(config, {"memory_mb": megabytes}, where="--memory")
    current = config.to_dict()
    filters, corrections = _depth_limits(options), list(current["corrections"])
    names = [item["part"] for item in corrections]
    if options.object:
        cuts = {item["part"] for item in current["filters"]} & _BACKGROUND_FILTERS
        if options.max_depth is None and not cuts:
            if kind == "cloud":
                remedy = "cut the background off with --max-depth as well"
                raise InputError(_NO_IMAGES, where="--object", remedy=remedy)
            filters.append({"part": "background"})
        # Scattered light of the background is fixed to the image, and drags the object along.
        if "multipath" in names and "scattering" not in names:
            corrections.insert(names.index("multipath"), {"part": "scattering"})
        # Neither gravity nor the camera's odometry applies to the coordinate frame of the object.
        config = changed(config, {"priors": []}, where="--object")
    if options.unwrap and "unwrap" not in names:
        corrections.insert(0, {"part": "unwrap"})
    if filters or corrections != current["corrections"]:
        lists = {"filters": [*filters, *current["filters"]], "corrections": corrections}
        config = changed(config, lists, where="--object" if options.object else "--max-depth")
    return config


def _depth_limits(options: Options) -> list[dict[str, Any]]:
    """Return the filter that the limits of depth specify, if there are any."""
    low, high = options.min_depth, options.max_depth
    if high is not None and high <= (low or 0.0):
        raise InputError(
            f"is {high} m and the minimum depth {low or 0.0} m",
            where="--max-depth",
            remedy="use a larger one",
        )
    if low is None and high is None:
        return []
    return [{"part": "distance", "minimum": low or 0.0, "maximum": high}]


def check_unwrap(recording: Recording) -> None:
    """Raise InputError if the recording can't be unwrapped."""
    frames = list(recording.readable(_SAMPLED))
    if not any(range_and_amplitude(frame, None) for frame in frames):
        known = {f.ambiguity_m for f in frames if isinstance(f, RangeFrame) and f.ambiguity_m}
        if any(range_and_amplitude(frame, min(known)) for frame in frames if known):
            raise InputError(
                f"the recording can't be unwrapped: its ambiguity range of {min(known):.3g} m is "
                "that of several modulation frequencies, or its amplitude is an infrared image",
                where="--unwrap",
                remedy="omit it",
            )
        raise InputError(
            "the recording can't be unwrapped: that needs its amplitude, and the ambiguity range "
            "of its camera",
            where="--unwrap",
            remedy='set "ambiguity_m" in a camera.json passed with --camera, or omit --unwrap',
        )


def seed_of(options: Options) -> int:
    """Return the seed: the option, or that of a `run.json` used as configuration; else 0."""
    if options.seed is not None:
        return options.seed
    if options.config is not None and options.config.suffix == ".json":
        seed = run_json.read_run_json(options.config).get("seed", 0)
        if isinstance(seed, int) and seed >= 0:
            return seed
    return 0


def check_guess(options: Options, recording: Recording) -> None:
    """Raise InputError if the recording lacks the odometry to start from."""
    if options.guess == "odometry" and recording.odometry is None:
        raise InputError(
            "is odometry, and the recording has none",
            where="--guess",
            remedy="put an odometry.txt next to the images, or use --guess previous",
        )


def read_changes(path: str | Path) -> dict[str, Any]:
    """Read the options in a TOML file, or the `config` of a `run.json`.

    Raises
    ------
    InputError
        If the file can't be read or is neither.
    """
    path = Path(path)
    if path.suffix == ".json":
        config = run_json.read_run_json(path).get("config")
        if not isinstance(config, dict):
            raise InputError("contains no config", where=path, remedy="pass a run.json of tofuse")
        return config
    return reading.parse_toml(reading.read_text(path), where=path)
