"""Mutation fuzzing of all readers: small valid files of each format, with seeded damage.

A reader must return a recording, report an unreadable frame, or raise a TofuseError with a message
of one line, within limits of CPU time and memory. Each subject is read in a process of its own, so
that a crash is recorded and the other subjects continue.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

_TESTS = Path(__file__).parents[2] / "tests"  # which make the files
sys.path[:0] = [str(_TESTS / "helpers"), str(_TESTS / "readers")]
_CPU_SECONDS = 20  # for one file
_MAX_WALL_RATIO = 6  # of wall-clock time to CPU time, on a busy machine
_MORE_BYTES = 3 << 30  # of address space, beyond that of the loaded program
_DEEP = 100_000
# Each process is forked from one that has loaded all modules and has no threads yet.
_FORKED = multiprocessing.get_context("forkserver")
_FORKED.set_forkserver_preload(["attacks.loaded"])
_WORDS = (b"-1", b"nan", b"inf", b"1e999", b"99999999999", b"", b"x", b"\xff", b"1e-300", b"1e300",
          b"0", b"9" * 5000, b"[", b'{"a":', b"null")  # fmt: skip
_VALUES = (None, 3, -1, 1e308, 10**30, True, "", "x", "nan", [], [1], [[None]], {}, {"a": 1})
_CAMERA = {"schema": 1, "model": "brown", "width": 40, "height": 30, "fx": 40.0, "fy": 40.0,
           "cx": 19.5, "cy": 14.5, "distortion": [0.1, 0.01, 0, 0, 0], "depth_unit_m": 0.001,
           "depth_kind": "z", "frame_rate_hz": 30.0, "ambiguity_m": 7.5}  # fmt: skip


@dataclass(frozen=True)
class Subject:
    """Files of a format: `make` writes them into a folder, `read` reads them.

    `read` returns the name of the recording's format, or else None.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], str | None]


@cache
def subjects() -> dict[str, Subject]:
    """Return all subjects by name, except those whose optional packages are missing."""
    import made_exports
    import made_recordings
    from camera_files import MAKERS, OTHERS

    found = {}
    for name, (make, file, format_) in (MAKERS | OTHERS).items():
        inside = f"freiburg1/{file}" if file else "freiburg1"
        found[name] = Subject(_in(make, inside), _recording(inside, format_))
    found["redwood"] = Subject(_redwood, _recording("freiburg1", "redwood"))
    made = _in(made_recordings.make_bundlefusion, "original")
    found["bundlefusion"] = Subject(made, _recording("original", "7scenes"))
    found["tiff"] = _with_camera(made_exports.make_tiff3d, "original", "tiff")
    found["depth png"] = _with_camera(_depth_png, "original/a.png", "depth-png")
    for name in ("blaze", "royale"):
        make = getattr(made_exports, f"make_{name}")
        found[name] = Subject(_in(make, "original"), _recording("original", None))
    return found | _scans() | _bags() | _small() | _results()


def _redwood(folder: Path) -> None:
    """A recording with the optional intrinsics."""
    import made_recordings

    made_recordings.make_redwood(folder / "freiburg1")
    K = [525.0, 0, 0, 0, 525.0, 0, 319.5, 239.5, 1]
    camera = {"width": 640, "height": 480, "intrinsic_matrix": K}
    (folder / "freiburg1" / "camera.json").write_text(json.dumps(camera))


def _in(make: Callable[[Path], Any], inside: str) -> Callable[[Path], None]:
    def run(folder: Path) -> None:
        (folder / inside).parent.mkdir(parents=True, exist_ok=True)
        make(folder / inside)

    return run


def _with_camera(make: Callable[[Path], Any], inside: str, format_: str) -> Subject:
    """Images of 32 x 24 pixels without a camera, and a camera.json."""

    def made(folder: Path) -> None:
        _in(make, inside)(folder)
        camera = _CAMERA | {"width": 32, "height": 24, "cx": 15.5, "cy": 11.5}
        (folder / "camera.json").write_text(json.dumps(camera))

    return Subject(made, _recording(inside, format_, camera="camera.json"))


def _depth_png(path: Path) -> None:
    from tofuse.formats.images.images import png_bytes

    path.write_bytes(png_bytes(np.full((24, 32), 2000, np.uint16)))


def _recording(
    inside: str, format_: str | None, camera: str | None = None
) -> Callable[[Path], str]:
    from tofuse.engine.errors import TofuseError
    from tofuse.formats.recordings.open import open_recording

    def read(folder: Path) -> str:
        about = None if camera is None else folder / camera
        recording = open_recording(folder / inside, format=format_, camera=about)
        for item in recording.read_all():
            if isinstance(item, TofuseError):
                _check_line(item)
            elif not np.isfinite(item.points).all():
                raise AssertionError("a point is not finite")
        return recording.format

    return read


def _scans() -> dict[str, Subject]:
    from tofuse.engine.fusion.geometry_record import GeometryRecord
    from tofuse.formats.geometry.e57 import write_e57
    from tofuse.formats.geometry.las import write_las

    points = np.random.default_rng(5).normal(size=(60, 3))

    def laz(path: Path) -> None:
        import laspy

        header = laspy.LasHeader(version="1.2", point_format=2)
        header.scales = np.full(3, 1e-4)
        data = laspy.LasData(header)
        data.x, data.y, data.z = points.T
        data.write(path)

    makers: dict[str, Callable[[Path], Any]] = {
        "las": lambda path: write_las(path, GeometryRecord(points)),
        "laz": laz,
        "e57": lambda path: write_e57(path, GeometryRecord(points)),
    }
    return _possible(makers, lambda name: f"original/a.{name}")


def _bags() -> dict[str, Subject]:
    def make(kind: str) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            import test_readers_ros as bags

            path.mkdir()
            bag = bags.Bag(path, kind)
            bag.depth(count=3)
            bag.info("/camera/color/camera_info", D=(), lens=bags.RGB_LENS)
            for part, T in (("depth", bags.T_RIG_DEPTH), ("color", bags.T_RIG_COLOR)):
                bag.tf("/tf_static", 9.0, "rig", part, T)
            for k, T in enumerate(bags.T_WORLD_RIG):
                bag.tf("/tf", 9.95 + 0.1 * k, "map", "rig", T)
                image = bags.color_at(k)
                bag.image(bags.COLOR_TOPIC, 10 + 0.1 * k, image, "rgb8", frame="color", width=32)
            bag.close()

        return write

    def real_sense(kind: str) -> Callable[[Path], None]:
        def write(path: Path) -> None:
            path.mkdir()
            bags.real_sense(path, kind, "None", name="Intel RealSense L515", color="rgb8")

        return write

    def orbbec(path: Path) -> None:
        path.mkdir()
        bags.orbbec(path, (0.0,) * 8, color="jpeg", R=bags.T_COLOR[:3, :3])

    try:
        import test_readers_ros as bags

        kinds = {f"rosbag {kind}": make(kind) for kind in bags.KINDS}
        kinds |= {f"realsense {kind}": real_sense(kind) for kind in ("ros1", "ros2")}
        kinds["orbbec"] = orbbec
    except ImportError:
        return {}
    found = _possible(kinds, lambda name: f"original/{name}")
    return {
        name: Subject(subject.make, lambda folder, name=name: _bag(folder, name.split()[0]))
        for name, subject in found.items()
    }


def _bag(folder: Path, maker: str) -> str:
    """Read each entry of the folder: a bag is a file or a folder."""
    format_ = "ros" if maker == "rosbag" else f"{maker}-bag"
    (inside,) = (folder / "original").iterdir()
    for path in sorted(inside.iterdir()):
        _recording(str(path.relative_to(folder)), format_)(folder)
    return format_


def _possible(
    makers: dict[str, Callable[[Path], Any]], inside: Callable[[str], str]
) -> dict[str, Subject]:
    from tofuse.engine.errors import TofuseError

    found = {}
    for name, make in makers.items():
        subject = Subject(_in(make, inside(name)), _recording(inside(name), None))
        with tempfile.TemporaryDirectory() as folder:
            try:
                subject.make(Path(folder))
            except (ImportError, TofuseError):  # a package is missing
                continue
        found[name] = subject
    return found


def _small() -> dict[str, Subject]:
    """Single files: graphs, poses, cameras, configurations, meshes, tracked frames."""
    from tofuse.apps.batch.jobs import read_jobs
    from tofuse.apps.cli.batching import run_arguments
    from tofuse.apps.jobs import tracked_file
    from tofuse.apps.jobs.run_options import read_changes
    from tofuse.apps.jobs.tracked_file import TrackedFile
    from tofuse.engine.mapping.config import changed
    from tofuse.engine.mapping.frame_log import FrameLog
    from tofuse.engine.mapping.methods import from_method
    from tofuse.engine.noise.model import NoiseModel, RangeLaw
    from tofuse.engine.results.types import FrameRecord
    from tofuse.engine.tracking.base import Step, Tracker
    from tofuse.formats.cameras.calibration_files import read_noise
    from tofuse.formats.cameras.camera_file import read_camera_file, read_lens_file
    from tofuse.formats.files.tables import read_columns
    from tofuse.formats.poses.g2o import read_g2o
    from tofuse.formats.poses.pose import read_loops, read_pose
    from tofuse.formats.poses.trajectory_formats import read_poses
    from tofuse.formats.recordings.open import read_reference
    from tofuse.formats.rigs.rig_file import read_rig

    pose = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    still = np.eye(4).tolist()
    noise = NoiseModel("a camera", RangeLaw(0.002, 0.001)).to_dict()
    vertices = [f"VERTEX_SE3:QUAT {k} {k} 0 0 0 0 0 1" for k in range(3)]
    information = " ".join("100" if a == b else "0" for a in range(6) for b in range(a, 6))
    edges = [f"EDGE_SE3:QUAT {k} {k + 1} 1 0 0 0 0 0 1 {information}" for k in range(2)]
    tum = "".join(f"{k} {k} 0 0 0 0 0 1\n" for k in range(4))
    lens = {
        "image_width": 40,
        "image_height": 30,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [40.0, 0, 19.5, 0, 40, 14.5, 0, 0, 1]},
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0.01, 0, 0, 0]},
    }
    rig = {"schema": 1, "cameras": [
        {"name": name, "recording": "", "T_rig_camera": still, "covariance": [0.0] * 36,
         "time_offset_s": 0.0, "depth_offset_m": 0.0} for name in ("a", "b")],
        "disagreement": [{"a": "a", "b": "b", "median_m": 0.01, "pixels": 9}]}  # fmt: skip
    toml = "method = 'default'\ntolerance_m = 0.03\n[fusion]\nvoxel_m = 0.01\n"
    toml += "[[filters]]\npart = 'distance'\nminimum = 0.1\nmaximum = 4.0\n"
    jobs = 'recording,every,seed\noriginal,2,1\n"other",3,\n'

    def configure(path: Path) -> None:
        changed(from_method("default"), read_changes(path), where=str(path))

    def replay(path: Path) -> tuple[TrackedFile, Tracker]:
        file = TrackedFile(path, "key", lambda _note: None)
        return file, file.tracker(from_method("default").odometry.start(0))

    def track(path: Path) -> None:
        (file, tracker), log = replay(path), FrameLog()
        for k in range(3):
            log.add(FrameRecord(k, 0.1 * k, "tracked"), Step("tracked", "", np.eye(4)))
        tracked_file._MIN_TRACKING_S = 0.0
        file.finish(tracker, log)

    texts: dict[str, tuple[str, str, Callable[[Path], object]]] = {
        "g2o": ("a.g2o", "\n".join([*vertices, *edges]) + "\n", read_g2o),
        "tum poses": ("a.txt", tum, read_reference),
        "pose": ("a.txt", "\n".join(" ".join(map(str, row)) for row in pose), read_pose),
        "pose in json": ("a.json", json.dumps({"T_target_source": pose}), read_pose),
        "transforms.json": ("transforms.json", json.dumps({"frames": [
            {"file_path": f"{k}.png", "transform_matrix": pose} for k in range(3)]}), read_poses),
        "camera.json": ("camera.json", json.dumps(_CAMERA), read_camera_file),
        "a lens": ("a.json", json.dumps(lens), read_lens_file),
        "rig.json": ("rig.json", json.dumps(rig), read_rig),
        "loops": ("loops.txt", "0 3 0 0 0 0 0 0 1\n1 2\n", read_loops),
        "columns": ("imu.csv", "t,ax,ay\n" + "0.1,1,2\n" * 5, read_columns),
        "config": ("a.toml", toml, configure),
        "jobs": ("a.csv", jobs, lambda path: read_jobs([path], run_arguments)),
        "noise.json": ("noise.json", json.dumps(noise), read_noise),
    }  # fmt: skip
    found = {}
    for name, (file, text, read) in texts.items():
        found[name] = _file(file, lambda path, text=text: path.write_text(text), read)
    return found | {
        "tracked frames": _file("a.npz", track, replay),
    }


def _file(name: str, make: Callable[[Path], object], read: Callable[[Path], object]) -> Subject:
    """A file that is not a recording."""

    def made(folder: Path) -> None:
        make(folder / name)

    def parsed(folder: Path) -> None:
        read(folder / name)

    return Subject(made, parsed)


def _results() -> dict[str, Subject]:
    """Output folders."""
    return {
        "a mesh": _file("mesh.ply", _mesh, _read_mesh),
        "a textured mesh": _file("mesh.glb", _textured_mesh, _read_textured_mesh),
        "a result": _file("out", _result, _load),
        "a result with images": _file("all", _with_images, _export),
        "a session": _file("out", _session, _load_session),
    }


def _tetrahedron(**more: Any) -> Any:
    from tofuse.engine.fusion import GeometryRecord

    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    return GeometryRecord(corners, faces, **more)


def _mesh(path: Path) -> None:
    from tofuse.formats.geometry import write_ply

    write_ply(path, _tetrahedron())


def _textured_mesh(path: Path) -> None:
    from tofuse.formats.geometry import write_glb
    from tofuse.formats.images import jpeg_bytes

    image = jpeg_bytes(np.full((8, 8, 3), 90, np.uint8), 90)
    uv = np.zeros((4, 2), np.float32)
    record = _tetrahedron(normals=np.eye(4, 3, dtype=np.float32), uv=uv, texture=image)
    write_glb(path, record, generator="attack", T_scene_node=np.eye(4))


def _read_textured_mesh(path: Path) -> None:
    from tofuse.formats.geometry import read_textured_glb

    read_textured_glb(path)


def _read_mesh(path: Path) -> None:
    from tofuse.formats.geometry import read_surface

    read_surface(path)


def _result(out: Path) -> None:
    import made_results
    from tofuse.apps.results.folders import OutputFolder
    from tofuse.apps.results.output import write_result

    write_result(made_results.torn(), OutputFolder(out))


def _load(out: Path) -> None:
    from tofuse.apps.results.loading import load_result

    load_result(out)


def _with_images(folder: Path) -> None:
    """A recording, and a result with the poses of its images."""
    import posed_results

    folder.mkdir()
    posed_results.made_result(folder, posed_results.BROWN)


def _export(folder: Path) -> None:
    from tofuse.apps.export.exporting import export

    export(folder / "result", ["log", "nerfstudio"], folder / "exported", overwrite=True)


def _session(out: Path) -> None:
    import made_sessions

    made_sessions.made_result(out, made_sessions.HERE[:3], number=1)


def _load_session(out: Path) -> None:
    from tofuse.apps.jobs.sessions import read_sessions
    from tofuse.engine.errors import InputError
    from tofuse.engine.progress import Silent

    try:
        read_sessions([out], 1, Silent())
    except InputError as error:  # if there is nothing else to complain about
        if "is a single session" not in str(error):
            raise


def damage(folder: Path, rng: np.random.Generator) -> None:
    """Damage a random file of a folder, in a random way."""
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())
    if not files:
        return
    path = files[rng.integers(len(files))]
    data = bytearray(path.read_bytes())
    size = max(1, len(data))
    if path.suffix == ".json" and rng.integers(2):
        path.write_bytes(_with_changed_value(bytes(data), rng))
        return

    def at(limit: int = size) -> int:
        return int(rng.integers(max(1, min(size, limit))))

    match int(rng.integers(14)):
        case 0:
            del data[at() :]
        case 1:
            for _ in range(1 + int(rng.integers(8))):
                if data:
                    data[at()] ^= 1 << int(rng.integers(8))
        case 2:  # within the header
            for _ in range(3):
                if data:
                    data[at(300)] = int(rng.integers(256))
        case 3:  # a length or a count
            where, width = at(600), int(rng.choice([1, 2, 4, 8]))
            value = int(rng.choice([0, 1, 2**7, 2**15, 2**31 - 1, 2**31, 2**63 - 1, 2**64 - 1]))
            order = "little" if rng.integers(2) else "big"
            data[where : where + width] = (value % 256**width).to_bytes(width, order)
        case 4:  # a number in a text
            digits = [k for k, c in enumerate(data[:4000]) if 48 <= c < 58]
            if digits:
                k = digits[rng.integers(len(digits))]
                data[k : k + 1] = _WORDS[rng.integers(len(_WORDS))]
        case 5:  # a section is removed or duplicated
            a, b = sorted((at(), at()))
            data[a:b] = data[a:b] * int(rng.integers(3))
        case 6:  # a section of another file
            other = files[rng.integers(len(files))].read_bytes()
            a = at()
            data[a : a + 50] = other[:50]
        case 7:
            data[at() : at()] = bytes([int(rng.choice([0, 10, 34, 255]))]) * int(rng.integers(2000))
        case 8:  # nested
            k, bracket = at(), (b"[", b'{"a":', b"(", b"a.")[int(rng.integers(4))]
            data[k:k] = bracket * _DEEP
        case 9:
            path.unlink()
            _odd(path, rng)
            return
        case 10:
            (path.parent / f"{rng.integers(99)}{path.suffix}").write_bytes(data[: at()])
        case 11:
            _odd(path.parent / f"stray-{rng.integers(99)}{path.suffix}", rng)
        case 12:  # the content of another file
            data[:] = files[rng.integers(len(files))].read_bytes()
        case _:
            data[:] = rng.bytes(int(rng.integers(3000)))
    path.write_bytes(data)


def _with_changed_value(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove or replace one value of a JSON document, at any depth."""
    try:
        document = parent = json.loads(data)
    except (ValueError, RecursionError):  # damaged before
        return data
    while isinstance(parent, dict | list) and parent:
        keys = list(parent) if isinstance(parent, dict) else range(len(parent))
        key = keys[rng.integers(len(keys))]
        child = parent[key]
        if isinstance(child, dict | list) and child and rng.integers(4):
            parent = child
        elif rng.integers(4):
            parent[key] = _VALUES[rng.integers(len(_VALUES))]
            break
        else:
            del parent[key]
            break
    return json.dumps(document).encode()


def _odd(path: Path, rng: np.random.Generator) -> None:
    """Make an entry that is not a regular file, or none."""
    if os.path.lexists(path):
        return
    match int(rng.integers(6)):
        case 0:
            path.mkdir()
        case 1:
            os.mkfifo(path)
        case 2:
            path.symlink_to("/dev/zero")
        case 3:
            path.symlink_to("nowhere")
        case 4:
            path.symlink_to(path.name)
        case _:
            pass


class _TooLong(BaseException):
    pass


def attack(name: str, subject: Subject, seed: int, folder: Path) -> str:
    """Read one damaged copy, and return "read", "rejected", or the fault."""
    from tofuse.engine.errors import TofuseError

    rng = np.random.default_rng([seed, *name.encode()])
    for _ in range(1 + int(rng.integers(2))):
        damage(folder, rng)

    def stop(_number: int, _frame: object) -> None:
        raise _TooLong

    signal.signal(signal.SIGALRM, stop)
    signal.signal(signal.SIGPROF, stop)
    signal.alarm(_MAX_WALL_RATIO * _CPU_SECONDS)
    signal.setitimer(signal.ITIMER_PROF, _CPU_SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            subject.read(folder)
    except TofuseError as error:
        try:
            _check_line(error)
        except AssertionError as fault:
            return f"{type(error).__name__}: {fault}"
        return "rejected"
    except _TooLong:
        return f"took more than {_CPU_SECONDS} s"
    except (Exception, RecursionError) as error:
        import traceback

        last = traceback.extract_tb(error.__traceback__)[-1]
        text = " ".join(str(error).split())[:150]
        return f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {text}"
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
    return "read"


def _check_line(error: Exception) -> None:
    text = str(error)
    if len(text.splitlines()) != 1 or len(text) > 2000:
        raise AssertionError(f"{len(text)} characters on {len(text.splitlines())} lines")


def _work(name: str, first: int, count: int, outcomes: Connection) -> None:
    """Attack one subject, and send seed and outcome of each attempt."""
    subject = subjects()[name]
    with tempfile.TemporaryDirectory(prefix="attack-") as base:
        original = Path(base) / "whole"
        original.mkdir()
        subject.make(original)
        subject.read(original)  # loads all modules
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + _MORE_BYTES,) * 2)
        for seed in range(first, first + count):
            copy = Path(base) / "copy"
            shutil.copytree(original, copy, symlinks=True)
            outcomes.send((seed, attack(name, subject, seed, copy)))
            shutil.rmtree(copy)


def run(name: str, count: int, first: int = 0) -> Iterator[tuple[int, str]]:
    """Attack one subject with `count` seeds, in a process of its own; yields seed and outcome.

    After a crash the remaining seeds are tried in a new process.
    """
    done, end = first, first + count
    while done < end:
        receiver, sender = _FORKED.Pipe(duplex=False)
        worker = _FORKED.Process(target=_work, args=(name, done, end - done, sender))
        worker.start()
        sender.close()
        with receiver, suppress(EOFError):
            while True:
                seed, outcome = receiver.recv()
                yield seed, outcome
                done = seed + 1
        worker.join()
        if worker.exitcode == 0:
            return
        yield done, f"its process ended with {worker.exitcode}"
        done += 1
