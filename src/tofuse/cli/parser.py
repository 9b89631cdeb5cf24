"""The commands and their options. Imports nothing heavy, so that ``--help`` is instant."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from tofuse._version import __version__
from tofuse.bounds import Bounds

_Number = TypeVar("_Number", int, float)

DEMO_SCENES = ("room", "empty-room", "rail", "torso", "box", "peaks")
EXPORTS = (
    *("pcd", "las", "laz", "e57", "glb", "gltf", "obj", "usdz", "stl", "3dtiles"),
    *("kitti", "log", "nerfstudio", "colmap"),
)

_NOTHING = "nothing was written: one line on stderr states the reason"


def _exit_status(zero: str, three: str, two: str = _NOTHING) -> str:
    return f"exit status:\n  0  {zero}\n  3  {three}\n  2  {two}\n"


_EXIT = _exit_status(
    "a result was written and every readable frame has a pose",
    "a result was written, but some readable frame has no pose",
)
_BATCH = """\
A list is a text file with one path or glob per line, or a table (.csv, .toml) with a column
`recording` and further columns for options of `tofuse run`; see docs/batch.md. Run the same
command again to resume.

""" + _exit_status(
    "every recording has a result, and every readable frame has a pose",
    "some recording has no result, or some readable frame has no pose",
    "there is no result: one line on stderr states the reason",
)
_REGISTER = """\
A view is a file with a single view (PLY, PCD, LAS, LAZ, E57, ...), or REC#12: frame 12 of
a recording, counting from 0.

""" + _exit_status(
    "the pose is accepted",
    "the pose is rejected, or cannot be verified; it is still printed and written",
)
_JUDGE = _exit_status(
    "the poses were assessed",
    "the depth images contradict the poses",
    "nothing was assessed: one line on stderr states the reason",
)
_MERGE = """\
A RESULT is the --out of `tofuse run` or `tofuse merge`; its recording must still be where it
was. The first result defines the world frame. What cannot be joined stays a separate component.

""" + _exit_status(
    "a result was written and every readable frame is in one map",
    "a result was written, but a session or a frame could not be joined",
)
_CALIBRATE_RIG = """\
Pass one recording per camera, taken at the same time: a single image each, images of a
scene in which something moves, or a walk with the rig. The first camera defines the rig
frame.

""" + _exit_status(
    "the pose of every camera was found",
    "the file was written, but the pose of some camera could not be found",
)
_CHECK_RIG = _exit_status(
    "no camera has moved",
    "some camera has moved, or cannot be checked",
    "nothing could be checked: one line on stderr states the reason",
)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        sys.stderr.write(f"{self.prog}: {message}; see `{self.prog} --help`\n")
        sys.exit(2)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse; each command reports its own unknown options. No command at all is ``--help``."""
        arguments, unknown = self.parse_known_args(args, namespace)
        if not hasattr(arguments, "command") and not unknown:
            arguments.parser.print_help()
            sys.exit(0)
        if unknown:
            command: Parser = getattr(arguments, "parser", self)
            command.refuse(unknown)
        return arguments

    def refuse(self, unknown: Sequence[str]) -> NoReturn:
        """Report an unknown option, with the most similar known one."""
        word = unknown[0].partition("=")[0]
        self.error(f"unknown option {word}" + _suggestion(word, self._option_string_actions))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            name = action.metavar or "/".join(action.option_strings) or action.dest
            kind = "unknown command" if name == "COMMAND" else f"{name}: unknown value"
            hint = _suggestion(str(value), choices) or f" (one of {', '.join(choices)})"
            raise argparse.ArgumentError(None, f"{kind} {value!r}{hint}")


def _suggestion(word: str, candidates: Iterable[str]) -> str:
    suggestions = get_close_matches(word, list(candidates), 1)
    return f" (did you mean {suggestions[0]}?)" if suggestions else ""


class _Help(argparse.HelpFormatter):
    """Prints each command and its summary on one line."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog)
        # argparse does not count the extra indentation of commands.
        self._action_max_length = 15


def make_parser(kind: type[Parser] = Parser) -> Parser:
    """Return the parser of the command line.

    Parameters
    ----------
    kind
        Its class, which handles errors.
    """
    parser = kind(
        prog="tofuse",
        description="Reconstruct a 3D model and the camera trajectory from recordings of "
        "Time-of-Flight cameras, and state how accurate they are.",
        epilog="Start with `tofuse demo`. `tofuse COMMAND --help` describes each command.",
        formatter_class=_Help,
    )
    parser.add_argument("--version", action="version", version=f"tofuse {__version__}")
    parser.set_defaults(parser=parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    _run(commands)
    _batch(commands)
    _register(commands)
    _judge(commands)
    _merge(commands)
    _rig(commands)
    _demo(commands)
    _simulate(commands)
    _inspect(commands)
    _convert(commands)
    _record(commands)
    _calibrate(commands)
    _noise(commands)
    _evaluate(commands)
    _optimize(commands)
    _export(commands)
    _experiments(commands)
    _view(commands)
    return parser


def _command(
    commands: Any,
    name: str,
    summary: str,
    *,
    epilog: str | None = None,
    function: str | None = None,
    reconstructs: bool = False,
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    def call(arguments: argparse.Namespace) -> int:
        import tofuse.cli.commands as functions

        run: Callable[[argparse.Namespace], int] = getattr(functions, function or name)
        if not reconstructs:
            return run(arguments)
        from tofuse.kernels.ahead import compiling_in_background

        with compiling_in_background():
            return run(arguments)

    parser.set_defaults(command=call, parser=parser)
    return parser


def _run(commands: Any) -> None:
    p = _command(commands, "run", "reconstruct a recording", epilog=_EXIT, reconstructs=True)
    _inputs(p)
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the result")
    _overwrite(p)
    _json(p, "progress and result as JSON lines")
    p.add_argument(
        "--into",
        type=Path,
        metavar="RESULT",
        help="merge the recording into the map of an existing result, if they overlap",
    )
    p.add_argument(
        "--texture", action="store_true", help="texture the surface, in mesh.glb and mesh.obj"
    )
    _faces(p, "default: all")
    _voxel(p, "from the camera's resolution")
    p.add_argument(
        "--memory",
        type=_bytes,
        metavar="SIZE",
        help="approximate memory limit, e.g. 4GB; the rest goes to disk (2GB)",
    )
    p.add_argument(
        "--rig",
        type=Path,
        metavar="FILE",
        help="a rig.json or cameraconfig.json; each INPUT is one of its cameras, in the same order",
    )
    _processing(p)
    p.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="spread loop search and refinement of a long recording over the workers of a Dask "
        "scheduler: tcp://HOST:8786, or its scheduler file",
    )
    g = p.add_argument_group("live view in the browser")
    g.add_argument(
        "--view", action="store_true", help="show the reconstruction live, and then the result"
    )
    _page(g)
    g = p.add_argument_group("input")
    _source(g)
    _selection(g)
    g.add_argument(
        "--average-still",
        action="store_true",
        help="average static segments into one frame each",
    )
    g.add_argument("--min-depth", type=_depth, metavar="M", help="discard points closer than this")
    g.add_argument("--max-depth", type=_depth, metavar="M", help="discard points farther than this")


def _source(p: Any) -> None:
    p.add_argument("--format", metavar="F", help="input format, if not recognised")
    p.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="use this camera.json instead of the recording's own",
    )
    p.add_argument("--topic", metavar="T", help="topic of a ROS bag, if the default is wrong")


def _selection(p: Any) -> None:
    p.add_argument("--start", type=_integer, default=0, metavar="I", help="first frame (0)")
    p.add_argument("--end", type=_integer, metavar="I", help="stop before this frame")
    p.add_argument("--every", type=_count, default=1, metavar="N", help="use every N-th frame")


def _processing(p: argparse.ArgumentParser) -> None:
    g = p.add_argument_group("reconstruction")
    _method(g)
    g.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="options from a .toml file, or from the run.json of an earlier result",
    )
    g.add_argument(
        "--guess",
        choices=("identity", "previous", "odometry"),
        help="initial guess of each registration",
    )
    g.add_argument(
        "--prior",
        choices=("auto", "none", "device"),
        default="auto",
        help="priors in addition to the images, as far as they agree: gravity and a phone's own "
        "poses (auto, the default), none, or odometry as well (device)",
    )
    g.add_argument(
        "--loops", type=Path, metavar="FILE", help="known loop closures, one `i j` per line"
    )
    g.add_argument(
        "--object",
        action="store_true",
        help="turntable mode: an object turns in front of a static camera",
    )
    g.add_argument(
        "--unwrap",
        action="store_true",
        help="unwrap phase beyond the camera's ambiguity range",
    )
    _tolerance(g, 'a "good" result')
    _seed(g)
    _threads(g)


# Options that several commands have.


def _inputs(p: Any) -> None:
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings, joined in this order")


def _json(p: Any, purpose: str = "print the result as JSON") -> None:
    p.add_argument("--json", action="store_true", help=purpose)


def _overwrite(p: Any, purpose: str = "an existing result in --out") -> None:
    p.add_argument("--overwrite", action="store_true", help=f"replace {purpose}")


def _threads(p: Any) -> None:
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")


def _seed(p: Any) -> None:
    p.add_argument("--seed", type=_non_negative, metavar="N", help="random seed (0)")


def _method(p: Any) -> None:
    p.add_argument("--method", metavar="NAME", help="default, thesis (default: default)")


def _tolerance(p: Any, purpose: str, default: str = "0.5 %% of the model, at least 10mm") -> None:
    text = f"accuracy required of {purpose}, e.g. 30mm ({default})"
    p.add_argument("--tolerance", type=_length, metavar="LENGTH", help=text)


def _faces(p: Any, default: str) -> None:
    text = f"maximum number of triangles ({default})"
    p.add_argument("--faces", type=_count, metavar="N", help=text)


def _voxel(p: Any, default: str) -> None:
    text = f"resolution of the model, e.g. 5mm (default: {default})"
    p.add_argument("--voxel", type=_length, metavar="LENGTH", help=text)


def _batch(commands: Any) -> None:
    p = _command(
        commands, "batch", "reconstruct many recordings, each as a separate job", epilog=_BATCH
    )
    p.add_argument(
        "recordings",
        nargs="+",
        type=Path,
        metavar="LIST",
        help="a list of recordings, a recording, or a glob",
    )
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the results")
    _overwrite(p, "results made with other options; up-to-date results are kept")
    _json(p, "jobs and outcome as JSON lines")
    p.add_argument(
        "--only", action="append", metavar="NAME", help="run only this job; may be repeated"
    )
    p.add_argument("--print-jobs", action="store_true", help="only print one command per job")
    g = p.add_argument_group("workers")
    who = g.add_mutually_exclusive_group()
    who.add_argument(
        "--workers", type=_count, metavar="N", help="parallel jobs on this machine (1)"
    )
    who.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="Dask scheduler: tcp://HOST:8786, or its scheduler file",
    )
    g.add_argument(
        "--threads",
        type=_count,
        metavar="N",
        help="threads per job (default: all cores shared by the jobs; on Dask: 1)",
    )
    g.add_argument(
        "--memory", type=_bytes, metavar="SIZE", help="memory per job, e.g. 4GB (not limited)"
    )
    g.add_argument(
        "--retries",
        type=_non_negative,
        metavar="N",
        help="how often a job whose process was killed is restarted (3)",
    )


def _register(commands: Any) -> None:
    p = _command(commands, "register", "register two files or frames", epilog=_REGISTER)
    p.add_argument("source", metavar="SOURCE", help="the view to be transformed")
    p.add_argument("target", metavar="TARGET", help="the view that stays fixed")
    p.add_argument(
        "--guess", type=Path, metavar="FILE", help="initial guess of T_target_source (none)"
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="folder for the result (none)")
    _overwrite(p, "an existing one in --out")
    _json(p)
    _threads(p)
    g = p.add_argument_group("input")
    _source(g)


def _judge(commands: Any) -> None:
    p = _command(
        commands,
        "judge",
        "assess poses from any source, without a reference",
        epilog=_JUDGE,
        reconstructs=True,
    )
    p.add_argument("recording", metavar="RECORDING", help="range images")
    p.add_argument(
        "trajectory",
        type=Path,
        metavar="TRAJECTORY",
        help="a trajectory in any supported format, a result, or a recording with poses",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="folder for the refined result (none)")
    _overwrite(p)
    _json(p)
    _tolerance(p, "good poses")
    _threads(p)
    g = p.add_argument_group("input")
    _source(g)
    _selection(g)


def _merge(commands: Any) -> None:
    p = _command(
        commands,
        "merge",
        "merge the results of several recordings into one map",
        epilog=_MERGE,
        reconstructs=True,
    )
    p.add_argument(
        "results",
        nargs="+",
        type=Path,
        metavar="RESULT",
        help="two or more results; the first one defines the world frame",
    )
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the map")
    _overwrite(p)
    _json(p, "progress and result as JSON lines")
    _tolerance(p, 'a "good" map', "default: as the first result")
    p.add_argument(
        "--texture", action="store_true", help="texture the surface (default: as the first result)"
    )
    _faces(p, "default: as the first result")
    _voxel(p, "as the first result")
    _seed(p)
    _threads(p)


def _rig(commands: Any) -> None:
    p = commands.add_parser(
        "rig",
        help="calibrate or check a rig of several cameras",
        description="Several rigidly mounted depth cameras.",
        formatter_class=_Help,
    )
    p.set_defaults(parser=p)
    commands = p.add_subparsers(title="commands", metavar="COMMAND")
    p = _command(
        commands,
        "calibrate",
        "estimate the extrinsics of a rig",
        epilog=_CALIBRATE_RIG,
        function="rig_calibrate",
    )
    p.add_argument("inputs", nargs="+", metavar="RECORDING", help="one per camera")
    p.add_argument("--out", required=True, type=Path, metavar="FILE", help="the rig.json to write")
    _overwrite(p, "an existing FILE")
    _rig_options(p)
    p = _command(
        commands,
        "check",
        "check whether a camera has moved since the rig was calibrated",
        epilog=_CHECK_RIG,
        function="rig_check",
    )
    p.add_argument("rig", type=Path, metavar="RIG", help="a rig.json")
    p.add_argument(
        "inputs",
        nargs="+",
        metavar="RECORDING",
        help="new recordings of its cameras, in the same order",
    )
    _rig_options(p)


def _rig_options(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--motion",
        choices=("auto", "still", "moving"),
        default="auto",
        help="whether the cameras are static (default: detected from the images)",
    )
    _json(p)
    _threads(p)
    p.add_argument("--format", metavar="F", help="input format, if not recognised")


def _demo(commands: Any) -> None:
    p = _command(
        commands,
        "demo",
        "simulate a recording and reconstruct it",
        epilog="The recording is left in DIR/recording, the result in DIR.\n\n" + _EXIT,
        reconstructs=True,
    )
    what = p.add_mutually_exclusive_group()
    what.add_argument(
        "--scene", choices=DEMO_SCENES, default="room", help="what to simulate (room)"
    )
    what.add_argument(
        "--failure",
        action="store_true",
        help="simulate a recording that can't be reconstructed, 1.5 m along a bare corridor: "
        "report.html shows how the failure is detected and explained",
    )
    p.add_argument(
        "--out",
        type=Path,
        default=Path("tofuse-demo"),
        metavar="DIR",
        help="output folder (tofuse-demo)",
    )
    _overwrite(p, "an existing demo in DIR")
    _json(p, "progress and result as JSON lines")
    _method(p)
    _seed(p)
    _threads(p)


def _simulate(commands: Any) -> None:
    p = _command(commands, "simulate", "simulate a recording")
    p.add_argument("scene", metavar="SCENE", help=", ".join(DEMO_SCENES))
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="output folder")
    p.add_argument("--camera", default="sr4000", metavar="NAME", help="camera model (sr4000)")
    p.add_argument("--every", type=_count, metavar="N", help="stride (default: the thesis's)")
    p.add_argument("--frames", type=_count, metavar="N", help="stop after this many frames")
    p.add_argument("--first", type=_non_negative, metavar="K", help="first raw frame (0)")
    p.add_argument("--uniform", action="store_true", help="uniform albedo, no texture")
    passing = p.add_mutually_exclusive_group()
    for kind, does in (("person", "walks"), ("box", "slides")):
        passing.add_argument(
            f"--with-{kind}",
            type=_ratio,
            metavar="RATIO",
            help=f"a {kind} {does} through the view, covering this fraction of it, 0 to 1",
        )
    p.add_argument(
        "--without",
        default="",
        metavar="EFFECTS",
        help="sensor errors to disable, separated by commas, or `all`",
    )
    p.add_argument("--no-correction", action="store_true", help="omit the factory depth correction")
    p.add_argument("--imu", action="store_true", help="simulate an accelerometer as well")
    p.add_argument("--sigma", type=_metres, metavar="M", help="noise of the `peaks` scene (0.05)")
    _seed(p)
    _threads(p)


def _inspect(commands: Any) -> None:
    p = _command(commands, "inspect", "show a recording's properties and check it for faults")
    _inputs(p)
    _source(p)
    p.add_argument("--sheet", type=Path, metavar="PNG", help="write a contact sheet of the frames")
    p.add_argument(
        "--object", action="store_true", help="an object turns in front of a static camera"
    )
    p.add_argument(
        "--quick", action="store_true", help="only the checks that `tofuse run` makes first"
    )
    _json(p)


def _convert(commands: Any) -> None:
    p = _command(commands, "convert", "write any recording as a native, TUM or Open3D folder")
    _inputs(p)
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="a new folder")
    p.add_argument(
        "--to",
        choices=("native", "tum", "open3d"),
        default="native",
        help="layout of the folder (native; the others cannot store everything)",
    )
    _source(p)
    _selection(p)


def _record(commands: Any) -> None:
    p = _command(commands, "record", "record from a connected camera")
    p.add_argument(
        "device", nargs="?", metavar="CAMERA", help="camera name; omit to list available cameras"
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="a new folder for the recording")
    p.add_argument("--seconds", type=_seconds, metavar="S", help="stop after this time")
    p.add_argument("--frames", type=_count, metavar="N", help="stop after this many frames")
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="camera option, e.g. serial=1234; may be repeated",
    )


def _calibrate(commands: Any) -> None:
    p = _command(
        commands,
        "calibrate",
        "estimate intrinsics or depth errors of a camera, or import intrinsics",
        epilog="lens: from views of a checkerboard, writes a camera.json.\n"
        "depth: from views of planes, writes a correction.npz.\n"
        "import: from a file of Bouguet's toolbox, CalLab, OpenCV or ROS, writes a camera.json.\n",
    )
    p.add_argument("subject", choices=("lens", "depth", "import"), help="what to calibrate")
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings; import: one file")
    p.add_argument("--out", type=Path, metavar="FILE", help="write the result")
    _overwrite(p, "an existing FILE")
    _json(p)
    g = p.add_argument_group("lens and depth")
    g.add_argument(
        "--board", metavar="CxR:M", help="inner corners and square size in metres, e.g. 8x6:0.1"
    )
    g.add_argument(
        "--image",
        choices=("amplitude", "color"),
        default="amplitude",
        help="image in which to detect the board (amplitude)",
    )
    _source(g)
    _selection(g)
    g = p.add_argument_group("depth")
    g.add_argument(
        "--wall", action="store_true", help="the board is flat on a wall; use the whole wall"
    )
    g.add_argument(
        "--planes",
        type=_count,
        default=4,
        metavar="N",
        help="without --board: maximum planes per view (4)",
    )
    _seed(g)
    g = p.add_argument_group("lens")
    g.add_argument(
        "--model",
        choices=("pinhole", "brown", "rational", "fisheye"),
        default="brown",
        help="distortion model (brown)",
    )
    g = p.add_argument_group("import")
    g.add_argument(
        "--recording", metavar="REC", help="take depth unit and kind from this recording"
    )
    g.add_argument("--index", type=_integer, metavar="N", help="camera index in a CalLab file")


def _noise(commands: Any) -> None:
    p = _command(commands, "noise", "estimate a camera's noise from a static recording")
    _inputs(p)
    p.add_argument(
        "--out", type=Path, metavar="FILE", help="write the noise model, e.g. noise.json"
    )
    _overwrite(p, "an existing FILE")
    p.add_argument("--name", metavar="NAME", help="name of the camera")
    _source(p)
    _json(p)


def _evaluate(commands: Any) -> None:
    p = _command(commands, "evaluate", "compare a trajectory with a reference")
    p.add_argument("estimate", type=Path, metavar="ESTIMATE", help="a trajectory or a result")
    p.add_argument(
        "reference",
        type=Path,
        metavar="REFERENCE",
        help="a trajectory, or a recording that comes with reference poses",
    )
    p.add_argument(
        "--recording",
        type=Path,
        metavar="REC",
        help="also measure the map consistency of its images",
    )
    p.add_argument(
        "--reference-error",
        type=_length,
        metavar="LENGTH",
        help="rms error of the reference itself, e.g. 20mm; prints an interval for the ATE",
    )
    _json(p)


def _optimize(commands: Any) -> None:
    p = _command(commands, "optimize", "optimise a pose graph")
    p.add_argument("input", type=Path, metavar="IN.g2o", help="the pose graph")
    p.add_argument(
        "--out", required=True, type=Path, metavar="OUT.g2o", help="the optimised pose graph"
    )
    p.add_argument(
        "--optimiser",
        metavar="NAME",
        help="levenberg-marquardt (the default), castellani, lu-milios, elch or stochastic",
    )
    _overwrite(p, "an existing OUT.g2o")


def _export(commands: Any) -> None:
    p = _command(commands, "export", "write a result in other formats")
    p.add_argument("result", type=Path, metavar="DIR", help="a result: the --out of `tofuse run`")
    p.add_argument("formats", nargs="+", metavar="FORMAT", help=", ".join(EXPORTS))
    p.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the files (default: that of the result)"
    )
    _faces(p, "60000; STL: all")
    p.add_argument(
        "--every", type=_count, default=1, metavar="N", help="every N-th image (nerfstudio, colmap)"
    )
    p.add_argument(
        "--pinhole", action="store_true", help="images without distortion (nerfstudio, colmap)"
    )
    _overwrite(p, "existing files")


def _experiments(commands: Any) -> None:
    p = _command(commands, "experiments", "reproduce the experiments of the 2010 thesis")
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the report")
    _overwrite(p, "existing experiments in DIR")
    p.add_argument(
        "--cases", default="", metavar="NAMES", help="run only these, separated by commas"
    )
    p.add_argument("--seeds", type=_count, default=20, metavar="N", help="noise seeds (20)")
    _seed(p)
    _threads(p)


def _view(commands: Any) -> None:
    p = _command(commands, "view", "show a result in the browser")
    p.add_argument("result", type=Path, metavar="DIR", help="a result: the --out of `tofuse run`")
    _page(p)


def _page(p: Any) -> None:
    p.add_argument("--port", type=_port, metavar="N", help="port (8080, or the next free one)")
    p.add_argument("--no-open", action="store_true", help="do not open the browser")


def _bytes(text: str) -> int:
    from tofuse.batch.jobs import parse_bytes

    try:
        return parse_bytes(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error


def _number(text: str) -> float:
    """Parse a number; NaN if the text is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _within(bounds: Bounds, kind: Callable[[str], _Number]) -> Callable[[str], _Number]:
    """Return a function that reads a number and rejects one outside the bounds."""

    def read(text: str) -> _Number:
        value = kind(text)
        if value not in bounds:
            raise argparse.ArgumentTypeError(f"{text!r} is not {bounds}")
        return value

    return read


_port = _within(Bounds(1, 65535), _integer)
_count = _within(Bounds(1), _integer)
_non_negative = _within(Bounds(0), _integer)
_ratio = _within(Bounds(0, 1, exclusive=True), _number)
_seconds = _within(Bounds(0, exclusive=True), _number)
_metres = _within(Bounds(0), _number)
_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def _length(text: str) -> float:
    """A positive length in m, given as 30mm, 3cm, 0.03m or 0.03."""
    value = _depth(text)
    if value == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length, such as 30mm or 0.03")
    return value


def _depth(text: str) -> float:
    """A length in m of 0 or more, with a unit as in `_length`."""
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|m)?\s*", text)
    value = _number(match[1]) * _UNITS_M[match[2] or "m"] if match else math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length, such as 30mm or 0.03")
    return value
