"""The commands and their options. Imports nothing heavy, so that ``--help`` is instant."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from tofuse._version import __version__
from tofuse.engine.bounds import Bounds

_Number = TypeVar("_Number", int, float)

# Home of the commands of the laboratory, imported by name when one runs.
_LAB = "tofuse.lab.commands"
DEMO_SCENES = ("room", "empty-room", "rail", "torso", "box", "peaks")
EXPORTS = (
    *("pcd", "las", "laz", "e57", "glb", "gltf", "obj", "stl"),
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
    home: str = "tofuse.apps.cli.commands",
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )

    def call(arguments: argparse.Namespace) -> int:
        run: Callable[[argparse.Namespace], int] = getattr(import_module(home), function or name)
        if not reconstructs:
            return run(arguments)
        from tofuse.engine.compute import compiling_in_background

        with compiling_in_background():
            return run(arguments)

    parser.set_defaults(command=call, parser=parser)
    return parser


# `p` is a parser or a group of its options.


def _value(p: Any, usage: str, kind: Callable[[str], Any], text: str, **settings: Any) -> None:
    """Add an option or argument with a value: its name, and the placeholder of the value."""
    name, metavar = usage.split()
    p.add_argument(name, type=kind, metavar=metavar, help=text, **settings)


def _choice(p: Any, name: str, choices: Sequence[str], text: str, **settings: Any) -> None:
    """Add an option or argument whose value is one of a few words."""
    p.add_argument(name, choices=choices, help=text, **settings)


def _flag(p: Any, name: str, text: str) -> None:
    """Add an option without a value."""
    p.add_argument(name, action="store_true", help=text)


def _run(commands: Any) -> None:
    p = _command(commands, "run", "reconstruct a recording", epilog=_EXIT, reconstructs=True)
    _inputs(p)
    _value(p, "--out DIR", Path, "folder for the result", required=True)
    _overwrite(p)
    _json(p, "progress and result as JSON lines")
    _value(
        p,
        "--into RESULT",
        Path,
        "merge the recording into the map of an existing result, if they overlap",
    )
    _flag(p, "--no-report", "don't draw report.html, which takes up to half of a short run")
    _flag(p, "--texture", "texture the surface, in mesh.glb and mesh.obj")
    _faces(p, "default: all")
    _voxel(p, "from the camera's resolution")
    _value(
        p,
        "--memory SIZE",
        _bytes,
        "approximate memory limit, e.g. 4GB; the rest goes to disk (2GB)",
    )
    _value(
        p,
        "--rig FILE",
        Path,
        "a rig.json or cameraconfig.json; each INPUT is one of its cameras, in the same order",
    )
    _processing(p)
    g = p.add_argument_group("live view in the browser")
    _flag(g, "--view", "show the reconstruction live, and then the result")
    _page(g)
    g = p.add_argument_group("input")
    _source(g)
    _selection(g)
    _flag(g, "--average-still", "average static segments into one frame each")
    _value(g, "--min-depth M", _depth, "discard points closer than this")
    _value(g, "--max-depth M", _depth, "discard points farther than this")


def _source(p: Any) -> None:
    _value(p, "--format F", str, "input format, if not recognised")
    _value(p, "--camera FILE", Path, "use this camera.json instead of the recording's own")
    _value(p, "--topic T", str, "topic of a ROS bag, if the default is wrong")


def _selection(p: Any) -> None:
    _value(p, "--start I", _integer, "first frame (0)", default=0)
    _value(p, "--end I", _integer, "stop before this frame")
    _value(p, "--every N", _count, "use every N-th frame", default=1)


def _processing(p: argparse.ArgumentParser) -> None:
    g = p.add_argument_group("reconstruction")
    _method(g)
    _value(
        g,
        "--config FILE",
        Path,
        "options from a .toml file, or from the run.json of an earlier result",
    )
    _choice(
        g, "--guess", ("identity", "previous", "odometry"), "initial guess of each registration"
    )
    _choice(
        g,
        "--prior",
        ("auto", "none", "device"),
        "priors in addition to the images, as far as they agree: gravity and a phone's own "
        "poses (auto, the default), none, or odometry as well (device)",
        default="auto",
    )
    _value(g, "--loops FILE", Path, "known loop closures, one `i j` per line")
    _flag(g, "--object", "turntable mode: an object turns in front of a static camera")
    _flag(g, "--unwrap", "unwrap phase beyond the camera's ambiguity range")
    _tolerance(g, 'a "good" result')
    _seed(g)
    _threads(g)


# Options that several commands have.


def _inputs(p: Any) -> None:
    _value(p, "inputs INPUT", str, "recordings, joined in this order", nargs="+")


def _json(p: Any, purpose: str = "print the result as JSON") -> None:
    _flag(p, "--json", purpose)


def _overwrite(p: Any, purpose: str = "an existing result in --out") -> None:
    _flag(p, "--overwrite", f"replace {purpose}")


def _threads(p: Any) -> None:
    _value(p, "--threads N", _count, "threads (default: all cores)")


def _seed(p: Any) -> None:
    _value(p, "--seed N", _non_negative, "random seed (0)")


def _method(p: Any) -> None:
    _value(p, "--method NAME", str, "default, thesis (default: default)")


def _tolerance(p: Any, purpose: str, default: str = "0.5 %% of the model, at least 10mm") -> None:
    text = f"accuracy required of {purpose}, e.g. 30mm ({default})"
    _value(p, "--tolerance LENGTH", _length, text)


def _faces(p: Any, default: str) -> None:
    _value(p, "--faces N", _count, f"maximum number of triangles ({default})")


def _voxel(p: Any, default: str) -> None:
    text = f"resolution of the model, e.g. 5mm (default: {default})"
    _value(p, "--voxel LENGTH", _length, text)


def _batch(commands: Any) -> None:
    p = _command(
        commands, "batch", "reconstruct many recordings, each as a separate job", epilog=_BATCH
    )
    _value(p, "recordings LIST", Path, "a list of recordings, a recording, or a glob", nargs="+")
    _value(p, "--out DIR", Path, "folder for the results", required=True)
    _overwrite(p, "results made with other options; up-to-date results are kept")
    _json(p, "jobs and outcome as JSON lines")
    _value(p, "--only NAME", str, "run only this job; may be repeated", action="append")
    _flag(p, "--print-jobs", "only print one command per job")
    g = p.add_argument_group("workers")
    who = g.add_mutually_exclusive_group()
    _value(who, "--workers N", _count, "parallel jobs on this machine (1)")
    _value(
        who, "--scheduler ADDRESS", str, "Dask scheduler: tcp://HOST:8786, or its scheduler file"
    )
    _value(
        g,
        "--threads N",
        _count,
        "threads per job (default: all cores shared by the jobs; on Dask: 1)",
    )
    _value(g, "--memory SIZE", _bytes, "memory per job, e.g. 4GB (not limited)")
    _value(
        g, "--retries N", _non_negative, "how often a job whose process was killed is restarted (3)"
    )


def _register(commands: Any) -> None:
    p = _command(commands, "register", "register two files or frames", epilog=_REGISTER)
    _value(p, "source SOURCE", str, "the view to be transformed")
    _value(p, "target TARGET", str, "the view that stays fixed")
    _value(p, "--guess FILE", Path, "initial guess of T_target_source (none)")
    _value(p, "--out DIR", Path, "folder for the result (none)")
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
    _value(p, "recording RECORDING", str, "range images")
    _value(
        p,
        "trajectory TRAJECTORY",
        Path,
        "a trajectory in any supported format, a result, or a recording with poses",
    )
    _value(p, "--out DIR", Path, "folder for the refined result (none)")
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
    _value(
        p,
        "results RESULT",
        Path,
        "two or more results; the first one defines the world frame",
        nargs="+",
    )
    _value(p, "--out DIR", Path, "folder for the map", required=True)
    _overwrite(p)
    _json(p, "progress and result as JSON lines")
    _tolerance(p, 'a "good" map', "default: as the first result")
    _flag(p, "--texture", "texture the surface (default: as the first result)")
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
    _value(p, "inputs RECORDING", str, "one per camera", nargs="+")
    _value(p, "--out FILE", Path, "the rig.json to write", required=True)
    _overwrite(p, "an existing FILE")
    _rig_options(p)
    p = _command(
        commands,
        "check",
        "check whether a camera has moved since the rig was calibrated",
        epilog=_CHECK_RIG,
        function="rig_check",
    )
    _value(p, "rig RIG", Path, "a rig.json")
    _value(
        p, "inputs RECORDING", str, "new recordings of its cameras, in the same order", nargs="+"
    )
    _rig_options(p)


def _rig_options(p: argparse.ArgumentParser) -> None:
    _choice(
        p,
        "--motion",
        ("auto", "still", "moving"),
        "whether the cameras are static (default: detected from the images)",
        default="auto",
    )
    _json(p)
    _threads(p)
    _value(p, "--format F", str, "input format, if not recognised")


def _demo(commands: Any) -> None:
    p = _command(
        commands,
        "demo",
        "simulate a recording and reconstruct it",
        epilog="The recording is left in DIR/recording, the result in DIR.\n\n" + _EXIT,
        reconstructs=True,
        home=_LAB,
    )
    what = p.add_mutually_exclusive_group()
    _choice(what, "--scene", DEMO_SCENES, "what to simulate (room)", default="room")
    _flag(
        what,
        "--failure",
        "simulate a recording that can't be reconstructed, 1.5 m along a bare corridor: "
        "report.html shows how the failure is detected and explained",
    )
    _value(p, "--out DIR", Path, "output folder (tofuse-demo)", default=Path("tofuse-demo"))
    _overwrite(p, "an existing demo in DIR")
    _json(p, "progress and result as JSON lines")
    _method(p)
    _seed(p)
    _threads(p)


def _simulate(commands: Any) -> None:
    p = _command(commands, "simulate", "simulate a recording", home=_LAB)
    _value(p, "scene SCENE", str, ", ".join(DEMO_SCENES))
    _value(p, "--out DIR", Path, "output folder", required=True)
    _value(p, "--camera NAME", str, "camera model (sr4000)", default="sr4000")
    _value(p, "--every N", _count, "stride (default: the thesis's)")
    _value(p, "--frames N", _count, "stop after this many frames")
    _value(p, "--first K", _non_negative, "first raw frame (0)")
    _flag(p, "--uniform", "uniform albedo, no texture")
    passing = p.add_mutually_exclusive_group()
    for kind, does in (("person", "walks"), ("box", "slides")):
        _value(
            passing,
            f"--with-{kind} RATIO",
            _ratio,
            f"a {kind} {does} through the view, covering this fraction of it, 0 to 1",
        )
    _value(
        p,
        "--without EFFECTS",
        str,
        "sensor errors to disable, separated by commas, or `all`",
        default="",
    )
    _flag(p, "--no-correction", "omit the factory depth correction")
    _flag(p, "--imu", "simulate an accelerometer as well")
    _value(p, "--sigma M", _metres, "noise of the `peaks` scene (0.05)")
    _seed(p)
    _threads(p)


def _inspect(commands: Any) -> None:
    p = _command(commands, "inspect", "show a recording's properties and check it for faults")
    _inputs(p)
    _source(p)
    _value(p, "--sheet PNG", Path, "write a contact sheet of the frames")
    _flag(p, "--object", "an object turns in front of a static camera")
    _flag(p, "--quick", "only the checks that `tofuse run` makes first")
    _json(p)


def _convert(commands: Any) -> None:
    p = _command(commands, "convert", "write any recording as a native, TUM or Open3D folder")
    _inputs(p)
    _value(p, "--out DIR", Path, "a new folder", required=True)
    _choice(
        p,
        "--to",
        ("native", "tum", "open3d"),
        "layout of the folder (native; the others cannot store everything)",
        default="native",
    )
    _source(p)
    _selection(p)


def _record(commands: Any) -> None:
    p = _command(commands, "record", "record from a connected camera")
    _value(p, "device CAMERA", str, "camera name; omit to list available cameras", nargs="?")
    _value(p, "--out DIR", Path, "a new folder for the recording")
    _value(p, "--seconds S", _seconds, "stop after this time")
    _value(p, "--frames N", _count, "stop after this many frames")
    _value(
        p,
        "--set NAME=VALUE",
        str,
        "camera option, e.g. serial=1234; may be repeated",
        action="append",
        default=[],
    )


def _calibrate(commands: Any) -> None:
    p = _command(
        commands,
        "calibrate",
        "estimate intrinsics or depth errors of a camera, or import intrinsics",
        epilog="lens: from views of a checkerboard, writes a camera.json.\n"
        "depth: from views of planes, writes a correction.npz.\n"
        "import: from a file of OpenCV or ROS, writes a camera.json.\n",
    )
    _choice(p, "subject", ("lens", "depth", "import"), "what to calibrate")
    _value(p, "inputs INPUT", str, "recordings; import: one file", nargs="+")
    _value(p, "--out FILE", Path, "write the result")
    _overwrite(p, "an existing FILE")
    _json(p)
    g = p.add_argument_group("lens and depth")
    _value(g, "--board CxR:M", str, "inner corners and square size in metres, e.g. 8x6:0.1")
    _choice(
        g,
        "--image",
        ("amplitude", "color"),
        "image in which to detect the board (amplitude)",
        default="amplitude",
    )
    _source(g)
    _selection(g)
    g = p.add_argument_group("depth")
    _flag(g, "--wall", "the board is flat on a wall; use the whole wall")
    _value(g, "--planes N", _count, "without --board: maximum planes per view (4)", default=4)
    _seed(g)
    g = p.add_argument_group("lens")
    _choice(
        g,
        "--model",
        ("pinhole", "brown", "rational", "fisheye"),
        "distortion model (brown)",
        default="brown",
    )
    g = p.add_argument_group("import")
    _value(g, "--recording REC", str, "take depth unit and kind from this recording")


def _noise(commands: Any) -> None:
    p = _command(commands, "noise", "estimate a camera's noise from a static recording")
    _inputs(p)
    _value(p, "--out FILE", Path, "write the noise model, e.g. noise.json")
    _overwrite(p, "an existing FILE")
    _value(p, "--name NAME", str, "name of the camera")
    _source(p)
    _json(p)


def _evaluate(commands: Any) -> None:
    p = _command(commands, "evaluate", "compare a trajectory with a reference")
    _value(p, "estimate ESTIMATE", Path, "a trajectory or a result")
    _value(
        p,
        "reference REFERENCE",
        Path,
        "a trajectory, or a recording that comes with reference poses",
    )
    _value(p, "--recording REC", Path, "also measure the map consistency of its images")
    _value(
        p,
        "--reference-error LENGTH",
        _length,
        "rms error of the reference itself, e.g. 20mm; prints an interval for the ATE",
    )
    _json(p)


def _optimize(commands: Any) -> None:
    p = _command(commands, "optimize", "optimise a pose graph")
    _value(p, "input IN.g2o", Path, "the pose graph")
    _value(p, "--out OUT.g2o", Path, "the optimised pose graph", required=True)
    _value(
        p,
        "--optimiser NAME",
        str,
        "levenberg-marquardt (the default), castellani, lu-milios, elch or stochastic",
    )
    _overwrite(p, "an existing OUT.g2o")


def _export(commands: Any) -> None:
    p = _command(commands, "export", "write a result in other formats")
    _value(p, "result DIR", Path, "a result: the --out of `tofuse run`")
    _value(p, "formats FORMAT", str, ", ".join(EXPORTS), nargs="+")
    _value(p, "--out DIR", Path, "folder for the files (default: that of the result)")
    _faces(p, "60000; STL: all")
    _value(p, "--every N", _count, "every N-th image (nerfstudio, colmap)", default=1)
    _flag(p, "--pinhole", "images without distortion (nerfstudio, colmap)")
    _overwrite(p, "existing files")


def _experiments(commands: Any) -> None:
    p = _command(commands, "experiments", "reproduce the experiments of the 2010 thesis", home=_LAB)
    _value(p, "--out DIR", Path, "folder for the report", required=True)
    _overwrite(p, "existing experiments in DIR")
    _value(p, "--cases NAMES", str, "run only these, separated by commas", default="")
    _value(p, "--seeds N", _count, "noise seeds (20)", default=20)
    _seed(p)
    _threads(p)


def _view(commands: Any) -> None:
    p = _command(commands, "view", "show a result in the browser")
    _value(p, "result DIR", Path, "a result: the --out of `tofuse run`")
    _page(p)


def _page(p: Any) -> None:
    _value(p, "--port N", _port, "port (8080, or the next free one)")
    _flag(p, "--no-open", "do not open the browser")


def _bytes(text: str) -> int:
    from tofuse.apps.batch import parse_bytes

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
