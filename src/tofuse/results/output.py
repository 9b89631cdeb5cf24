"""The output folder of a run: prepared first, staged beside, moved into place at the end."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse._version import __version__
from tofuse.errors import InputError, OutputError
from tofuse.files.atomic import write_text
from tofuse.files.glb import write_glb
from tofuse.files.images import png_bytes
from tofuse.files.obj import write_obj
from tofuse.files.ply import write_ply
from tofuse.files.trajectory import read_tum, write_tum
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.texture import Textured
from tofuse.fusion.upright import T_up_world, upright
from tofuse.kernels.threads import side_threads
from tofuse.posegraph.accuracy import Accuracy
from tofuse.posegraph.g2o import write_g2o
from tofuse.posegraph.refinement import Refinement
from tofuse.posegraph.suspicion import Suspicion
from tofuse.results.types import Component, Reason, Reconstruction, SelfCalibration

Float64 = NDArray[np.float64]

UNFINISHED = ".tofuse-"  # how names begin that are no result: a run that was killed left them
STAGING = f"{UNFINISHED}unfinished"
CHECKPOINT = f"{UNFINISHED}checkpoint"  # what a run has so far
_ASIDE, _FORWARD, _BACK = "replaced", "plan.json", "undo.json"  # in the staging folder
RECORDING = "recording"  # what `tofuse demo` puts beside its result

# Colours of surfaces that changed between sessions; people who are colour-blind tell them apart.
CHANGED = {"appeared": (230, 97, 0), "vanished": (93, 58, 155)}

# What `tofuse run` and `tofuse export` may write; of an earlier result nothing of it stays.
FILES = (
    "trajectory.txt",
    "pose_graph.g2o",
    "cloud.ply",
    "mesh.ply",
    "mesh.glb",
    "changes.ply",
    "mesh.obj",
    "mesh.mtl",
    "mesh.png",
    "report.html",
    "view.npz",
    "run.json",
    "judge.json",
    "cloud.pcd",
    "cloud.las",
    "cloud.e57",
    "mesh.gltf",
    "trajectory.kitti.txt",
    "trajectory.log",
)
# Components that have a model of their own have it in a folder, with the same files.
_COMPONENT = re.compile(r"component-[1-9]\d*")


class OutputFolder:
    """A folder that a run may write into.

    Making one checks everything that can be checked before hours of work: that the folder is
    ours or empty, and that it can be written.

    What a run puts into place are files, and folders `component-1` and so on, which are moved as a
    whole. Links are moved as what they are, and never followed.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        overwrite: bool = False,
        marker: str = "run.json",
        ours: Callable[[Path], bool] | None = None,
    ) -> None:
        """Check and create the folder.

        Parameters
        ----------
        marker
            The file that is moved into place last: where it is, everything else is.
        ours
            Says whether a folder holds an earlier result of the kind that will be written;
            `is_result` unless given.

        Raises
        ------
        OutputError
            If it holds something other than an earlier result, or a result and `overwrite` is
            not given, or can't be written.
        """
        self.path = Path(path)
        self._staging = self.path / STAGING
        self._marker = marker
        self._ours = ours or is_result
        self._made: list[Path] = []
        try:
            _recover(self.path)
            self._check(overwrite)
            self._made = [p for p in (self.path, *self.path.parents) if not p.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(self._staging, ignore_errors=True)
            self._staging.mkdir()
        except OSError as error:
            self.discard()
            raise _output_error(self.path, error) from error

    def _check(self, overwrite: bool) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise OutputError("is a file", where=self.path, remedy="give --out a folder")
        entries = {p.name for p in self.path.iterdir()} if self.path.exists() else set()
        entries -= {name for name in entries if name.startswith(UNFINISHED)}
        if not entries:
            return
        if not self._ours(self.path) and entries - {RECORDING}:
            raise OutputError(
                "is not empty and holds no earlier result of this command",
                where=self.path,
                remedy="give --out a new or empty folder",
            )
        if not overwrite:
            raise OutputError(
                "holds an earlier result" if self._marker in entries else "holds a recording",
                where=self.path,
                remedy="give --overwrite to replace it, or another --out",
            )
        for name in sorted(entries):
            self._check_replaceable(name)

    def _check_replaceable(self, name: str) -> None:
        """Refuse to replace the folder of a component that somebody has put something into."""
        if _COMPONENT.fullmatch(name) and not _is_component(self.path / name):
            raise OutputError(
                "holds something other than the files of an earlier result",
                where=self.path / name,
                remedy="move it away, or give another --out",
            )

    @contextmanager
    def staging(self, *, instead_of: Sequence[str] = ()) -> Iterator[Path]:
        """Give a folder to write into; on success all of it is moved into place, else nothing.

        What has the names `instead_of` is gone afterwards, written anew or not.
        """
        try:
            yield self._staging
            files = sorted(p.name for p in self._staging.iterdir())
            files.sort(key=lambda name: name == self._marker)
            gone = {name for name in (*files, *instead_of) if os.path.lexists(self.path / name)}
            for name in sorted(gone):
                self._check_replaceable(name)
            old = sorted(gone, key=lambda name: (name != self._marker, name))
            _move_all(_Plan(tuple(files), tuple(old)), self._staging, self.path)
        except OutputError as error:
            # Named as it would have been called in the end.
            where = self._final(error.where or "")
            raise OutputError(error.problem, where=where, remedy=error.remedy) from error
        except OSError as error:
            raise _output_error(self.path, error) from error
        finally:
            self.discard()

    def _final(self, staged: str) -> Path:
        path = Path(staged)
        if path.is_relative_to(self._staging):
            return self.path / path.relative_to(self._staging)
        return path if path.is_relative_to(self.path) else self.path / path.name

    def discard(self) -> None:
        """Remove what is unfinished, and the folders made for it if nothing else is in them."""
        if not any((self._staging / name).exists() for name in (_FORWARD, _BACK)):
            shutil.rmtree(self._staging, ignore_errors=True)
        with contextlib.suppress(OSError):
            for folder in self._made:
                folder.rmdir()


@dataclass(frozen=True)
class _Plan:
    """What of a staging folder is moved into place, and what is moved away before.

    It lies in the staging folder meanwhile, so that the next run can finish what a killed one
    began. The marker goes away first and comes last: where it is, everything is of one run.
    """

    files: tuple[str, ...]
    old: tuple[str, ...]

    def carry_out(self, staging: Path, folder: Path) -> None:
        """Move, or go on with it."""
        for name in self.old:
            if not os.path.lexists(staging / _ASIDE / name):
                os.replace(folder / name, staging / _ASIDE / name)
        for name in self.files:
            if os.path.lexists(staging / name):
                os.replace(staging / name, folder / name)

    def undo(self, staging: Path, folder: Path) -> None:
        """Move back, or go on with it."""
        for name in reversed(self.files):
            if not os.path.lexists(staging / name):
                os.replace(folder / name, staging / name)
        for name in reversed(self.old):
            if os.path.lexists(staging / _ASIDE / name):
                os.replace(staging / _ASIDE / name, folder / name)


def _move_all(plan: _Plan, staging: Path, folder: Path) -> None:
    """Move files into a folder: all of them, or none, with what was there put back."""
    (staging / _ASIDE).mkdir()
    write_text(staging / _FORWARD, json.dumps(asdict(plan)))
    try:
        plan.carry_out(staging, folder)
    except BaseException:
        os.replace(staging / _FORWARD, staging / _BACK)
        plan.undo(staging, folder)
        (staging / _BACK).unlink()
        raise
    (staging / _FORWARD).unlink()


def _recover(folder: Path) -> None:
    """Finish the moves of a run that was killed at them."""
    staging = folder / STAGING
    for name, way in ((_FORWARD, _Plan.carry_out), (_BACK, _Plan.undo)):
        try:
            found = json.loads((staging / name).read_text(encoding="utf-8"))
        except (FileNotFoundError, NotADirectoryError):
            continue
        names = {key: tuple(Path(each).name for each in found[key]) for key in ("files", "old")}
        way(_Plan(**names), staging, folder)
        (staging / name).unlink()


def _output_error(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"can't be written ({error.strerror or error})",
        where=path,
        remedy="check the permissions and the free space, or give another --out",
    )


def is_result(folder: Path) -> bool:
    """Say whether a folder holds the result of an earlier run."""
    try:
        data = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(data, dict) and {"schema", "version", "verdict"} <= set(data)


def _is_component(folder: Path) -> bool:
    """Say whether a folder holds nothing but files that a run or an export makes."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    return all(p.name in FILES and p.is_file() and not p.is_symlink() for p in folder.iterdir())


def component_folders(folder: Path) -> tuple[str, ...]:
    """Return the names of the folders of an earlier result's components, that may be removed."""
    names = (p.name for p in folder.iterdir() if _COMPONENT.fullmatch(p.name))
    return tuple(sorted(name for name in names if _is_component(folder / name)))


def component_name(number: int) -> str:
    """Return the name of the folder of a component that has a model of its own."""
    return f"component-{number}"


def component_number(folder: Path) -> int | None:
    """Return the number of the component that a folder is named after; None for any other name."""
    return int(folder.name.split("-")[1]) if _COMPONENT.fullmatch(folder.name) else None


def write_result(
    result: Reconstruction,
    folder: OutputFolder,
    report: Callable[[Reconstruction, Path], None] | None = None,
    texture: Textured | None = None,
) -> None:
    """Write every file of the contract; `report` writes what is for people into the folder it gets.

    Components that are not connected to the main one, and have a model of their own, are written
    into `component-1` and so on, by their numbers. With a `texture`, the `mesh.glb` of the main
    model has it, and so has `mesh.obj`, which is written then.

    Raises
    ------
    OutputError
        If a file can't be written; then nothing that was there before has changed.
    """
    replaced = (*FILES, *component_folders(folder.path))
    with folder.staging(instead_of=replaced) as staging:
        for number, component in enumerate(result.components):
            if component.result is not None and not component.connected:
                own = staging / component_name(number)
                own.mkdir()
                _write_files(component.result, own, report, None)
        _write_files(result, staging, report, texture)


def _write_files(
    result: Reconstruction,
    folder: Path,
    report: Callable[[Reconstruction, Path], None] | None,
    texture: Textured | None,
) -> None:
    # Much of either is copying and drawing in which the other can go on.
    with side_threads(1, "tofuse-writer") as beside:
        model = beside.submit(_write_model, result, folder, texture)
        posed = result.has_pose
        write_tum(folder / "trajectory.txt", result.timestamps[posed], result.trajectory[posed])
        write_g2o(folder / "pose_graph.g2o", result.graph)
        if report is not None:
            report(result, folder)
        model.result()
        text = json.dumps(run_json(result), indent=1, allow_nan=False)
        (folder / "run.json").write_text(text + "\n", encoding="utf-8")


def _write_model(result: Reconstruction, folder: Path, texture: Textured | None) -> None:
    cloud = result.cloud
    write_ply(
        folder / "cloud.ply",
        cloud.points,
        normals=cloud.normals,
        color=cloud.color,
        scalars={"views": cloud.views} | ({} if cloud.sigma is None else {"sigma": cloud.sigma}),
    )
    if result.mesh is not None:
        _write_mesh(result.mesh, result, folder, texture)
    if result.changes:
        _write_changes(result, folder / "changes.ply")


def _write_changes(result: Reconstruction, path: Path) -> None:
    """Write the surfaces that changed between sessions, in the colours of `CHANGED`."""
    found = [c.change for c in result.changes]
    counts = [len(change.points) for change in found]
    colors = np.array([CHANGED[change.kind] for change in found], np.uint8)
    write_ply(
        path,
        np.concatenate([change.points for change in found]).astype(np.float32),
        color=np.repeat(colors, counts, axis=0),
        scalars={"change": np.repeat(np.arange(len(found), dtype=np.int32), counts)},
    )


def _write_mesh(mesh: Mesh, result: Reconstruction, folder: Path, texture: Textured | None) -> None:
    """Write `mesh.ply`, in the world frame, and `mesh.glb`, which stands upright."""
    write_ply(
        folder / "mesh.ply",
        mesh.vertices,
        normals=mesh.normals,
        color=mesh.color,
        scalars={"views": mesh.views, "sigma": mesh.sigma},
        faces=mesh.faces,
    )
    R = upright(mesh, result.trajectory)
    generator = f"tofuse {__version__}"
    if texture is None:
        write_glb(
            folder / "mesh.glb",
            mesh.vertices @ R.T,
            mesh.faces,
            normals=mesh.normals @ R.T,
            color=mesh.color,
            generator=generator,
        )
        return
    atlas, image = texture.atlas, png_bytes(texture.image)
    points, normals = (
        values[atlas.vertices] @ R.T for values in (texture.mesh.vertices, texture.mesh.normals)
    )
    write_glb(
        folder / "mesh.glb",
        points,
        atlas.faces,
        normals=normals,
        uv=atlas.uv,
        texture=image,
        generator=generator,
    )
    write_obj(folder / "mesh.obj", points, atlas.faces, normals=normals, uv=atlas.uv, texture=image)


def run_json(result: Reconstruction) -> dict[str, Any]:
    """Return the content of `run.json`, schema 1: SI units and radians, no NaN (null instead)."""
    d = result.diagnostics
    return plain(
        {
            "schema": 1,
            "version": __version__,
            "input": {
                **{key: result.recording[key] for key in ("path", "format", "frames")},
                "opening": result.recording.get("opening"),
            },
            "warnings": result.recording.get("warnings", []),
            "findings": result.recording.get("findings", []),
            "seed": result.seed,
            "threads": result.threads,
            "config": result.config,
            "seconds": {k: round(v, 4) for k, v in d.seconds.items()},
            "verdict": d.verdict,
            "accuracy": accuracy_json(d.accuracy),
            "self_calibration": _calibration(d.calibrated),
            "reasons": reasons_json(d.reasons),
            "frames": [
                {
                    "index": f.index,
                    "timestamp": f.timestamp,
                    "status": f.status,
                    "reason": f.reason,
                    "valid_share": f.valid_share,
                    "inlier_share": f.inlier_share,
                    "rms_m": f.rms_m,
                    "covariance": None if f.covariance is None else f.covariance.ravel(),
                    "unobservable": f.unobservable,
                    "component": f.component,
                    "session": _session_of(f.index, result),
                }
                for f in d.frames
            ],
            "T_up_world": T_up_world(result.mesh, result.trajectory),
            "components": [_component(c) for c in result.components],
            "sessions": [
                {
                    "name": s.name,
                    "result": s.result,
                    "opening": s.opening,
                    "config": s.config,
                    "first": s.first,
                    "count": s.count,
                    "T_main_session": s.T_main_session,
                }
                for s in result.sessions
            ],
            "session_pairs": [asdict(pair) for pair in result.session_pairs],
            "changes": [
                {
                    "a": c.a,
                    "b": c.b,
                    "kind": c.change.kind,
                    "centre_m": c.change.centre,
                    "size_m": c.change.size,
                    "volume_m3": c.change.volume_m3,
                }
                for c in result.changes
            ],
            "loops": [
                {
                    "i": p.i,
                    "j": p.j,
                    "accepted": p.accepted,
                    "reason": p.reason,
                    "overlap": p.overlap,
                    "rms_m": p.rms_m,
                    "free_space_violation": p.free_space_violation,
                    "margin": p.margin,
                }
                for p in d.loops
            ],
            "optimiser": [
                {
                    "first": p.first,
                    "vertices": p.vertices,
                    "edges": p.edges,
                    "before": p.before,
                    "after": p.after,
                    "improved": p.improved,
                    "converged": p.converged,
                }
                for p in d.parts
            ],
            "outside": [
                {
                    "sensor": s.sensor,
                    "measured": s.measured,
                    "used": s.used,
                    "scale": s.scale,
                    "text": s.text,
                }
                for s in d.outside
            ],
            "refinement": _refinement(d.refinement),
            "filters": {name: {"removed": share} for name, share in d.removed.items()},
        }
    )


def _session_of(index: int, result: Reconstruction) -> int | None:
    """Number of the session that a frame is of; None where there is only one."""
    return next((k for k, session in enumerate(result.sessions) if session.has(index)), None)


def clock_of(folder: Path) -> tuple[Float64, NDArray[np.intp]] | None:
    """(N,) times in s and (N,) numbers of the frames of a result; None where `folder` is none."""
    if not is_result(folder):
        return None
    frames = read_run_json(folder / "run.json").get("frames", [])
    try:
        times = np.array([frame["timestamp"] for frame in frames], float)
        return times, np.array([frame["index"] for frame in frames], np.intp)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError("has no times of frames", where=folder / "run.json") from error


def accuracy_json(a: Accuracy) -> dict[str, Any]:
    """Return the accuracy as in `run.json`, but for numbers that are inf."""
    worst = None
    if a.worst is not None:
        w = a.worst
        worst = {"frame": w.frame, "position_m": w.position_m, "rotation_rad": w.rotation_rad}
    return {
        "position_m": a.position_m,
        "rotation_rad": a.rotation_rad,
        "relative": a.relative,
        "assessed": a.assessed,
        "worst": worst,
        "unbounded": list(a.unbounded),
    }


def reasons_json(reasons: Sequence[Reason]) -> list[dict[str, Any]]:
    """Return the reasons as `run.json` has them."""
    return [
        {
            "code": r.code,
            "frames": list(r.frames),
            "ranges": [list(each) for each in r.ranges],
            "text": r.text,
        }
        for r in reasons
    ]


def _component(c: Component) -> dict[str, Any]:
    return {
        "frames": [list(each) for each in c.frames],
        "T_main_component": c.T_main_component,
        "joined": c.joined,
    }


def _refinement(r: Refinement | None) -> dict[str, Any] | None:
    """What became of the refinement; None where no views took part."""
    if r is None or not r.views:
        return None
    return {
        "kept": r.kept,
        "views": r.views,
        "pairs": r.pairs,
        "moved_m": r.moved_m,
        "moved_rad": r.moved_rad,
        "support_before": r.support[0],
        "support_after": r.support[1],
        "camera": r.errors,
        "suspicion": _suspicion(r.suspicion),
    }


def _calibration(found: SelfCalibration | None) -> dict[str, Any] | None:
    """How the camera was corrected; None where it was not."""
    if found is None:
        return None
    return {
        "focal": found.focal,
        "offset_m": found.offset_m,
        "sigma": dict(found.sigmas),
        "stated_bound_m": found.bound_m[0],
        "corrected_bound_m": found.bound_m[1],
    }


def _suspicion(s: Suspicion | None) -> dict[str, Any] | None:
    """What the views say of their camera; None where they were not asked."""
    if s is None:
        return None
    gap = s.gap
    return {
        "alarm": s.alarm,
        "camera": s.errors,
        "sigma": s.sigmas,
        "support": s.support,
        "loop": None
        if gap is None
        else {
            "i": gap.i,
            "j": gap.j,
            "gap_m": gap.before[0],
            "gap_rad": gap.before[1],
            "calibrated_gap_m": gap.after[0],
            "calibrated_gap_rad": gap.after[1],
        },
    }


def plain(value: Any) -> Any:
    """Turn arrays and NumPy numbers into JSON values; NaN and infinity become null."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        whole = value.dtype.kind in "iub" or (value.dtype.kind == "f" and np.isfinite(value).all())
        return value.tolist() if whole else plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def read_run_json(path: str | Path) -> dict[str, Any]:
    """Read a `run.json`.

    Raises
    ------
    InputError
        If it can't be read or is not one of ours.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"can't be read ({error.strerror})", where=path) from error
    except ValueError as error:
        raise InputError(f"is not JSON ({error})", where=path) from error
    if not isinstance(data, dict) or data.get("schema") != 1:
        raise InputError("is not a run.json of schema 1", where=path)
    return data


def main_poses(folder: Path, run: dict[str, Any]) -> tuple[list[int], Float64]:
    """Return the frame indices and poses (N, 4, 4) T_world_camera of the main model of a folder.

    Raises
    ------
    InputError
        If its `run.json`, read before, and its `trajectory.txt` are of different runs.
    """
    indices = [int(frame["index"]) for frame in frames_in_main_model(run)]
    _, poses = read_tum(folder / "trajectory.txt")
    if len(indices) != len(poses):
        raise InputError(
            f"says that {len(indices)} frames have a pose, and trajectory.txt holds {len(poses)}",
            where=folder / "run.json",
            remedy="copy the whole folder, or run again",
        )
    return indices, poses


def frames_in_main_model(run: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what a `run.json` says of the frames with a line in `trajectory.txt`, in order.

    Those of version 0.1 know no components: there every pose is in the one model.
    """
    connected = [c["T_main_component"] is not None for c in run.get("components", ())]
    return [
        frame
        for frame in run["frames"]
        if frame["status"] in ("tracked", "predicted")
        and (frame.get("component") is None or connected[frame["component"]])
    ]
