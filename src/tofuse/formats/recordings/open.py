"""Opening a recording, again as it was opened before, or a single view of it by name."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.bounds import Bounds
from tofuse.engine.errors import InputError, UnreadableFrameError, signals_as_themselves
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame, Recording, Source
from tofuse.engine.noise import NOISE_MODEL
from tofuse.engine.parts import check_number, discover, name_of, registered
from tofuse.formats.cameras import camera_file, read_noise
from tofuse.formats.files import reading
from tofuse.formats.geometry import is_surface, read_surface, surface_points
from tofuse.formats.poses import TimedPoses, read_poses
from tofuse.formats.recordings.archives import unzipped
from tofuse.formats.recordings.joined import JoinedSource, LimitedSource, ScaledSource
from tofuse.formats.recordings.still import average_still
from tofuse.formats.rigs import RigSource, read_rig, recordings_of, rig_file_in
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, inputs, organised

# Proprietary recordings: problem and remedy by suffix.
CLOSED = {
    ".rrf": (
        "contains raw phases of a pmd camera, whose layout and calibration aren't published",
        "play it by pmd's Royale and export its frames as PLY (sampleExportPLY), or record the "
        "camera's ROS topics, and use those",
    ),
    ".xef": (
        "is of Kinect Studio, whose layout isn't published",
        "play it by Kinect Studio and save its depth images, or record by iai_kinect2",
    ),
    **dict.fromkeys(
        (".svo", ".svo2"),
        (
            "is of ZED's SDK, which alone reads it",
            "export depth by it, and write that as .npz (docs/formats.md), or record ROS topics",
        ),
    ),
}

# What is exported instead of a recording: problem, remedy, and suffixes of files.
_NO_DEPTH = (
    (
        "is a model, not a recording",
        "export the depth images of which it was made (of phones: docs/iphone.md); `tofuse "
        "register` and `tofuse compare` take models",
        {".obj", ".mtl", ".stl", ".glb", ".gltf", ".usdz", ".usd", ".fbx", ".dae", ".off"},
    ),
    (
        "is a video, without depth",
        "export the recording with its depth images (of phones: docs/iphone.md)",
        {".mov", ".mp4", ".m4v", ".avi", ".webm"},
    ),
    (
        "is of photos, without depth",
        "export the depth images, too (of phones: docs/iphone.md)",
        {".jpg", ".jpeg", ".heic", ".dng", ".webp"},
    ),
)

_ARCHIVES = {".zip", ".tar", ".gz", ".tgz", ".7z", ".rar"}

# A single file of these, which contain a whole recording, is that of its folder.
_CONTAINERS = (".bag", ".db3", ".mcap", ".mkv", ".sens", ".r3d", ".npz", ".h5", ".e57")
# What to do with files that are not read, by suffix.
_REMEDIES = {
    **dict.fromkeys(
        (".txt", ".csv"),
        "if the lines are x y z of a cloud, rename the files to .xyz, or use --format xyz "
        "for a single one",
    ),
    ".npz": "name its arrays depth, K and, for whole numbers, depth_unit_m (docs/formats.md)",
    ".npy": "save depth and K by numpy.savez, or put a file for each image into depth/ beside a "
    "camera.json (docs/formats.md)",
}

# Of the unit of a file to m.
FACTORS = Bounds(1e-6, 1e6)

# A folder with these may contain depth images of an unknown camera.
_IMAGES = (".png", ".pgm", ".tif", ".tiff")


def readers() -> dict[str, Reader]:
    """Return the readers by name."""
    discover("tofuse.formats.readers")
    return {name: cls() for name, cls in registered("reader").items()}


@signals_as_themselves()
def open_recording(
    *paths: str | Path,
    format: str | None = None,  # noqa: A002
    camera: str | Path | None = None,
    topic: str | None = None,
    rig: str | Path | None = None,
    min_depth: float | None = None,
    max_depth: float | None = None,
    factor: float | None = None,
) -> Recording:
    """Open a recording; its format is detected from names and contents.

    Parameters
    ----------
    paths
        Files, folders or .zip files of these; several are joined in the order given. A folder of
        native or SR4000 recordings is joined in name order; if it contains a rig.json, its
        recordings are the cameras of a rig, one image of each in turn. A folder that
        contains a single recording or folder stands for it.
    format
        Name of a reader, instead of detection.
    camera
        A camera.json that replaces the recording's own camera.
    topic
        Topic of a bag with the depth images or clouds, instead of detection.
    rig
        A rig.json: the paths are the recordings of its cameras, in its order.
    min_depth, max_depth
        In m; nearer or farther points are dropped: by z in images, by distance in clouds.
    factor
        Multiplies the depth of images, or the points and poses of clouds, if they are read in
        another unit than m: 0.001 for mm.

    Raises
    ------
    InputError
        If the format is ambiguous (with the evidence, and the option to select it), or nothing can
        be read.
    """
    for path in paths:
        reading.path_of(path, "path", "pass a path, or several: tofuse.open(a, b)")
    if not paths:
        raise InputError("no recording was given", remedy="pass a path")
    for name, file in (("camera", camera), ("rig", rig)):
        if file is not None:
            reading.path_of(file, name, f"pass the path of a {name}.json")
    _check_depths(min_depth, max_depth)
    if factor is not None:
        check_number(factor, FACTORS, "--factor")
    again = partial(
        open_recording,
        *paths,
        format=format,
        camera=camera,
        topic=topic,
        rig=rig,
        min_depth=min_depth,
        max_depth=max_depth,
        factor=factor,
    )
    shown_path = " ".join(map(str, paths))
    for a, b in combinations(paths, 2):
        if Path(a).resolve() == Path(b).resolve():
            raise InputError("is given twice", where=b, remedy="pass each recording once")
    inner = [unzipped(path) for path in paths]
    options = ReaderOptions(None if camera is None else Path(camera), topic, factor)
    in_folder = rig_file_in(inner[0]) if rig is None and len(inner) == 1 else None
    if in_folder is not None:
        rig, inner = in_folder, list(recordings_of(in_folder).values())
    if rig is not None:
        cameras = _rig_source(Path(rig), inner, format, options)
        if (min_depth, max_depth, factor) != (None, None, None):
            given = "min_depth, max_depth, factor"
            raise InputError("do not apply to a rig", where=given, remedy="leave them out")
        return Recording.of(cameras, shown_path, "rig", again)
    for path in inner:
        _check_kind(path)
    located = [item for path in inner for item in _resolve(path, format, options)]
    sources = [_opened(item, options) for item in located]
    source: Source = sources[0]
    if len(sources) > 1:
        source = JoinedSource(sources, _short_names([item.path for item in located]))
    first_frame = _check_usable(source, paths[0])
    if options.camera is not None and (assumption := camera_file.assumption(options.camera)):
        source.warnings.append(assumption)
    if len(inner) == 1:
        _read_noise(source, inner[0])
    if factor is not None:
        source = ScaledSource(source, factor, poses=isinstance(first_frame, CloudFrame))
    if min_depth is not None or max_depth is not None:
        source = LimitedSource(
            source, min_depth or 0.0, float("inf") if max_depth is None else max_depth
        )
    names = dict.fromkeys(name_of(item.reader) for item in located)
    return Recording.of(source, shown_path, "+".join(names), again)


def _rig_source(
    rig_file: Path,
    paths: Sequence[Path],
    format: str | None,  # noqa: A002
    options: ReaderOptions,
) -> RigSource:
    """The recordings of a rig's cameras, in its order."""
    rig, recordings = read_rig(rig_file), []
    names = [camera.name for camera in rig.cameras]
    rig.check_count(len(paths), rig_file)
    for name, path in zip(names, paths, strict=True):
        if not path.exists():
            raise InputError(
                f"has no recording of the camera {name!r}",
                where=rig_file.parent,
                remedy=f"put it into {path}, or remove the camera from {rig_file.name}",
            )
        located = _resolve(path, format, options)
        if len(located) > 1:
            raise InputError("contains several recordings", where=path, remedy="leave one")
        source = _opened(located[0], options)
        _check_usable(source, path)
        recordings.append(Recording.of(source, path, name_of(located[0].reader)))
    return RigSource(rig, recordings)


@dataclass(frozen=True)
class _Located:
    path: Path
    reader: Reader


def _opened(item: _Located, options: ReaderOptions) -> Source:
    if options.topic is not None and not item.reader.has_topics:
        raise InputError(
            f"does not apply to the format {name_of(item.reader)!r}",
            where="--topic",
            remedy="leave it out",
        )
    source = item.reader.open(item.path, options)
    _read_noise(source, item.path)
    return source


def _read_noise(source: Source, folder: Path) -> None:
    """Read the noise.json of a folder, if it has one."""
    file = folder / "noise.json"
    if reading.is_folder(folder) and reading.is_file(file):
        source.metadata[NOISE_MODEL] = read_noise(file)


def _check_kind(path: Path) -> None:
    """Refuse special files such as pipes: reading them could block for ever."""
    try:
        special = path.exists() and not path.is_file() and not path.is_dir()
    except (OSError, ValueError):
        return  # reported when it is opened
    if special:
        raise InputError(
            "is neither a file nor a folder", where=path, remedy="pass a recording's path"
        )


def _resolve(
    path: Path,
    format: str | None,  # noqa: A002
    options: ReaderOptions,
) -> list[_Located]:
    """The recordings at a path, each with its reader."""
    try:
        path.stat()
    except OSError as error:
        raise reading.input_error(error, path) from error
    except ValueError as error:
        raise InputError(f"is not a path ({error})", where=repr(str(path))) from error
    children = reading.list_folder(path) if path.is_dir() else []
    if path.is_dir() and not children:
        raise InputError("is an empty folder", where=path, remedy="pass a recording")
    if format is not None:
        return _resolve_as(path, format)
    sniffs = _sniff(path, options)
    # A camera.json or names of one format outweigh a cloud in the same folder.
    best = max((sniff.confidence for sniff in sniffs.values()), default=0.0)
    confident = {
        n: sniff for n, sniff in sniffs.items() if sniff.confidence >= max(best, Sniff.CERTAIN)
    }
    if len(confident) == 1:
        name, sniff = next(iter(confident.items()))
        # Beside the frames, a model is no scan.
        inner = [p for p in _folders_in(path) if _is_sure(p)] if best <= Sniff.CERTAIN else []
        if inner:
            raise InputError(
                f"has {sniff.evidence}, and a recording in {inner[0].name}/",
                where=path,
                remedy=f"pass {inner[0]}, or use --format {name}",
            )
        return [_Located(path, readers()[name])]
    if len(confident) > 1:
        evidence = "; ".join(f"{name}: {sniff.evidence}" for name, sniff in confident.items())
        raise InputError(
            f"could be several formats ({evidence})",
            where=path,
            remedy=f"use --format {' or '.join(confident)}, or pass its files, which are joined",
        )
    if not sniffs and (parts := _recordings_in(path, options)):
        return parts
    if not sniffs and len(children) == 1 and reading.is_folder(children[0]):
        return _resolve(children[0], format, options)
    raise _refusal(path, sniffs, children)


def _refusal(path: Path, sniffs: dict[str, Sniff], children: list[Path]) -> InputError:
    """Why nothing is read at a path, by what is there."""
    suffixes = {p.suffix.lower() for p in (children or [path]) if p.is_file()}
    if suffixes and suffixes <= _ARCHIVES and not _folders_in(path):
        return InputError(
            "is an archive, or contains only that",
            where=path,
            remedy="pass a .zip itself, unpack any other",
        )
    for suffix in suffixes & CLOSED.keys():
        problem, remedy = CLOSED[suffix]
        return InputError(problem, where=path, remedy=remedy)
    alone = not (sniffs or _folders_in(path) or _is_sure(path.absolute().parent))
    exported = set[str]().union(*(kind for _, _, kind in _NO_DEPTH))
    if alone and suffixes and suffixes <= exported:
        problem, remedy = next((p, r) for p, r, kind in _NO_DEPTH if kind & suffixes)
        return InputError(problem, where=path, remedy=remedy)
    return _unidentified(path, sniffs, children)


def _resolve_as(path: Path, format: str) -> list[_Located]:  # noqa: A002
    choices = readers()
    if format not in choices:
        raise InputError(
            f"there is no format {format!r}",
            where="--format",
            remedy=f"use one of {', '.join(choices)}",
        )
    reader = choices[format]
    if path.is_dir() and _sniff_as(reader, path) is None:
        parts = [p for p in _folders_in(path) if _sniff_as(reader, p) is not None]
        if parts and (reader.joinable or len(parts) == 1):
            return [_Located(p, reader) for p in parts]
    return [_Located(path, reader)]


def _folders_in(path: Path) -> list[Path]:
    children = reading.list_folder(path) if reading.is_folder(path) else []
    return [child for child in children if reading.is_folder(child)]


def _sniff_as(reader: Reader, path: Path) -> Sniff | None:
    """Detect a format; None also if what tells it can't be read."""
    try:
        return reader.sniff(path)
    except InputError:
        return None


def _sniff(path: Path, options: ReaderOptions | None = None) -> dict[str, Sniff]:
    found = {name: _sniff_as(reader, path) for name, reader in readers().items()}
    sniffs = {name: sniff for name, sniff in found.items() if sniff is not None}
    if options is None or options.camera is None:
        return sniffs
    return {name: sniff.with_camera() for name, sniff in sniffs.items()}


def _is_sure(path: Path) -> bool:
    """Whether a path has names and contents that only one format has, other than clouds."""
    return any(sniff.confidence > Sniff.CERTAIN for sniff in _sniff(path).values())


def is_recording(path: Path) -> bool:
    """Whether a reader recognises a file or folder as a recording of its format."""
    return any(sniff.confidence >= Sniff.CERTAIN for sniff in _sniff(path).values())


def _recordings_in(path: Path, options: ReaderOptions) -> list[_Located]:
    """The recordings in a folder, if any; InputError if there are several that can't be joined."""
    format_of: dict[Path, str] = {}
    best = 0.0
    for part in [*_folders_in(path), *inputs.files_at(path, *_CONTAINERS)]:
        sniffs = _sniff(part, options)
        confident = [name for name, s in sniffs.items() if s.confidence >= Sniff.CERTAIN]
        if confident:
            format_of[part] = max(confident, key=lambda name: sniffs[name].confidence)
            best = max(best, sniffs[format_of[part]].confidence)
    if not format_of:
        return []
    formats = sorted(set(format_of.values()))
    listed = ", ".join(f"{p.name} ({name})" for p, name in list(format_of.items())[:6])
    reader = readers()[formats[0]]
    if len(format_of) == 1 and not reader.joinable and best <= Sniff.CERTAIN:
        # A model, say, among folders of an unknown format.
        raise InputError(f"contains only {listed}", where=path, remedy="pass that, if you mean it")
    if len(format_of) > 1 and (len(formats) > 1 or not reader.joinable):
        raise InputError(
            f"contains several recordings: {listed}",
            where=path,
            remedy="pass one of them, or several in order (unpack an archive first)",
        )
    return [_Located(p, reader) for p in format_of]


def _unidentified(path: Path, sniffs: dict[str, Sniff], children: list[Path]) -> InputError:
    folder = path.absolute().parent
    whole = folder if _is_sure(folder) else None
    if sniffs:
        evidence = "; ".join(dict.fromkeys(sniff.evidence for sniff in sniffs.values()))
        remedies = [] if whole is None else [f"pass the recording's folder, {whole}"]
        remedies += [sniff.remedy or f"use --format {name}" for name, sniff in sniffs.items()]
        return InputError(
            f"could not be identified: it has {evidence}",
            where=path,
            remedy=", or ".join(dict.fromkeys(remedies)),
        )
    remedy = "check the path"
    if path.is_dir():
        kinds = Counter((p.suffix or "no suffix") if p.is_file() else "folders" for p in children)
        evidence = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(4))
        problem = f"is not a recording of a known format: it contains {evidence}"
        most = kinds.most_common(1)[0][0] if kinds else ""
        remedy = _REMEDIES.get(most.lower(), remedy)
        if any(kind.lower() in _IMAGES for kind in kinds):
            remedy = "if these are depth images, move them to depth/ in it and add a camera.json"
        for child in _folders_in(path):
            if any(sniff.needs_camera for sniff in _sniff(child).values()):
                remedy = f"if the depth images are in {child.name}/, use --camera camera.json "
                remedy += "(docs/formats.md), or a file of OpenCV or ROS"
                break
            if "depth" in child.name.lower() and inputs.files_at(child, ".npy", ".exr"):
                remedy = f"name {child.name}/ depth/, and add a camera.json (docs/formats.md)"
    elif path.stat().st_size == 0:
        return InputError("is empty", where=path, remedy="copy the file again")
    else:
        kind = f"a {path.suffix!r} file" if path.suffix else "a file without a suffix"
        problem = f"is not a recording of a known format, but {kind}"
        remedy = _REMEDIES.get(path.suffix.lower(), remedy)
    if whole is not None:
        return InputError(problem, where=path, remedy=f"pass the recording's folder, {whole}")
    return InputError(
        problem, where=path, remedy=f"{remedy}, or use --format ({', '.join(readers())})"
    )


def _check_depths(min_depth: float | None, max_depth: float | None) -> None:
    for name, value in (("--min-depth", min_depth), ("--max-depth", max_depth)):
        if value is not None:
            check_number(value, Bounds(0), name)
    if min_depth is not None and max_depth is not None and min_depth >= max_depth:
        raise InputError(
            f"{min_depth} and {max_depth} leave no points",
            where="--min-depth, --max-depth",
            remedy="pass the smaller one first",
        )


def _check_usable(source: Source, path: str | Path) -> Frame:
    """Return the first readable frame; refuse a recording without one."""
    count = len(source.timestamps)
    nothing = InputError("has no frames", where=path, remedy="pass a recording")
    try:
        return reading.first_readable(range(count), source.read, nothing)
    except UnreadableFrameError as first:
        if count > 1:
            raise InputError(f"none of {count} frames can be read: {first}", where=path) from first
        raise InputError(first.problem, where=first.where, remedy=first.remedy) from first


def _short_names(paths: list[Path]) -> list[str]:
    """The last part of each path, or the full paths if these are not unique."""
    names = [p.name for p in paths]
    return names if len(set(names)) == len(names) else [str(p) for p in paths]


def read_reference(path: str | Path, *, or_odometry: bool = False) -> TimedPoses:
    """Read reference poses from a trajectory file, or from a recording of any format.

    Parameters
    ----------
    path
        A file or folder.
    or_odometry
        Whether the odometry of a recording without reference poses will do.

    Raises
    ------
    InputError
        If it can't be read, or the recording has no reference poses.
    """
    path = unzipped(path)
    poses_file = path / "groundtruth.txt" if path.is_dir() else path
    readers_of_poses: list[Callable[[], TimedPoses | Recording]]
    readers_of_poses = [lambda: read_poses(poses_file), lambda: open_recording(path)]
    if not poses_file.is_file():  # else the images are not needed
        readers_of_poses = [lambda: open_recording(path), lambda: read_poses(path)]
    nothing = InputError("has no poses", where=path)
    found = reading.first_readable(readers_of_poses, lambda read: read(), nothing)
    if isinstance(found, TimedPoses):
        return found
    return _reference_of(found, path, or_odometry=or_odometry)


def _reference_of(recording: Recording, path: Path, *, or_odometry: bool) -> TimedPoses:
    poses = recording.reference
    if poses is None and or_odometry:
        poses = recording.odometry
    if poses is None or not np.isfinite(poses).all((1, 2)).any():
        raise InputError(
            "has no reference poses",
            where=path,
            remedy="pass a trajectory, such as TUM's (timestamp tx ty tz qx qy qz qw)",
        )
    posed = np.isfinite(poses).all((1, 2))
    return TimedPoses(poses[posed], timestamps=recording.timestamps[posed])


@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """Options with which files are read; see `open_recording`."""

    format: str | None = None
    camera: Path | None = None
    topic: str | None = None
    factor: float | None = None


@dataclass(frozen=True, kw_only=True)
class OpeningOptions(ReadingOptions):
    """Options with which a recording is opened.

    Attributes
    ----------
    start, end, every
        The selected frames, see `Recording.select`.
    average_still
        Whether stationary intervals are averaged to one frame each.
    """

    start: int = 0
    end: int | None = None
    every: int = 1
    average_still: bool = False


@dataclass(frozen=True)
class Opening(OpeningOptions):
    """Arguments with which a recording was opened; see `open_recording` and `tofuse run`.

    Attributes
    ----------
    paths
        Files or folders.
    rig
        See `open_recording`.
    """

    paths: tuple[Path, ...]
    rig: Path | None = None

    @classmethod
    def of(cls, inputs: Iterable[str | Path], options: object) -> Opening:
        """Return the opening of files or folders with options named like the fields.

        Fields without an option keep their defaults.
        """
        names = [f.name for f in fields(cls) if hasattr(options, f.name)]
        paths = tuple(reading.path_of(path, "path", "pass a recording") for path in inputs)
        return cls(paths, **{name: getattr(options, name) for name in names})

    @property
    def source(self) -> tuple[object, ...]:
        """What the frames are from: with their index, it identifies them."""
        return (*(path.resolve() for path in self.paths), self.average_still)

    def open(self) -> Recording:
        """Open the recording; InputError if that fails."""
        recording = open_recording(
            *self.paths,
            format=self.format,
            camera=self.camera,
            topic=self.topic,
            rig=self.rig,
            factor=self.factor,
        ).select(self.start, self.end, self.every)
        return average_still(recording) if self.average_still else recording

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, with absolute paths."""
        options = {field.name: getattr(self, field.name) for field in fields(OpeningOptions)}
        files = {
            name: None if file is None else str(file.absolute())
            for name, file in (("camera", self.camera), ("rig", self.rig))
        }
        return {"paths": [str(path.absolute()) for path in self.paths]} | options | files

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], where: str | Path) -> Opening:
        """Return the inverse of `to_dict`; InputError naming `where` if the data is invalid."""
        try:
            paths = tuple(Path(str(path)) for path in data["paths"])
            camera, rig, end = data["camera"], data.get("rig"), data["end"]
            opening = cls(
                paths,
                None if rig is None else Path(str(rig)),
                format=data["format"],
                camera=None if camera is None else Path(str(camera)),
                topic=data["topic"],
                factor=data.get("factor"),
                start=int(data["start"]),
                end=None if end is None else int(end),
                every=int(data["every"]),
                average_still=bool(data["average_still"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise InputError("does not state how its recording was opened", where=where) from error
        if not paths:
            raise InputError("names no recording", where=where)
        return opening


MIN_POINTS = 10


@dataclass(frozen=True, eq=False)
class SingleView:
    """A frame and its origin.

    Attributes
    ----------
    name
        As the user wrote it.
    path, format, index
        The recording, its reader, and the index of the frame.
    frame
        The view.
    warnings
        Notes for the user on how it was read.
    recording
        That of the frame, if it has one.
    """

    name: str
    path: str
    format: str
    index: int
    frame: Frame
    warnings: tuple[str, ...] = ()
    recording: Recording | None = None


def open_view(
    name: str, options: ReadingOptions | None = None, *, file_axes: bool = False
) -> SingleView:
    """Read the view called `name`.

    Of a mesh (.ply, .obj, .stl, .glb; m) it is points spread evenly over its area. With `file_axes`
    clouds that the reader turned to the axes of a camera are clouds in those of their file.

    Raises
    ------
    InputError
        If there is no such frame, the recording has several and `name` doesn't state which, or the
        frame can't be read or has fewer than ten points.
    """
    o = options or ReadingOptions()
    path, index = split_name(name)
    if o.format is None and index is None and is_surface(Path(path)):
        points = surface_points(read_surface(Path(path)), path) * (o.factor or 1.0)
        return _checked(SingleView(name, path, "mesh", 0, CloudFrame.of(points)))
    recording = open_recording(
        path, format=o.format, camera=o.camera, topic=o.topic, factor=o.factor
    )
    count = len(recording)
    if index is None and count > 1:
        raise InputError(
            f"contains {quantities.count(count, 'frame')}",
            where=name,
            remedy=f"choose one: {name}#0 to {name}#{count - 1}",
        )
    index = index or 0
    if index >= count:
        available = "its only frame is 0" if count == 1 else f"its frames are 0 to {count - 1}"
        raise InputError(f"has no frame {index}", where=path, remedy=available)
    frame, warnings = recording[index], tuple(recording.warnings)
    if file_axes and "stored_axes" in recording.metadata and isinstance(frame, RangeFrame):
        frame, warnings = organised.stored_cloud(frame), ()
    return _checked(SingleView(name, path, recording.format, index, frame, warnings, recording))


def _checked(view: SingleView) -> SingleView:
    if len(view.frame) < MIN_POINTS:
        raise InputError(
            f"has {len(view.frame)} valid points",
            where=view.name,
            remedy=f"use a view with {MIN_POINTS} or more",
        )
    return view


def split_name(name: str) -> tuple[str, int | None]:
    """Return the path and the frame index in `name`; None if it has no index.

    An existing path is taken literally, with any # in it.
    """
    if "#" not in name or os.path.lexists(name):
        return name, None
    path, _, frame = name.rpartition("#")
    if not (frame.isascii() and frame.isdecimal()):
        raise InputError(
            f"has the frame index {frame!r}",
            where=name,
            remedy="write a whole number after the #, such as recording#12",
        )
    return path, int(frame)
