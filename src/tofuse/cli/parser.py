"""Which commands and options there are. Imports nothing heavy: ``--help`` is instant."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn

from tofuse._version import __version__

DEMO_SCENES = ("room", "empty-room", "rail", "torso", "box", "peaks")
EXPORTS = ("pcd", "las", "e57", "obj", "gltf", "kitti", "log")

_EXIT = """\
exit status:
  0  a result was written and every readable frame has a pose
  3  a result was written, but some readable frame has no pose
  2  nothing was written: one line on stderr says why
"""

_EXIT_BATCH = """\
LIST is a text of one path or glob a line, or a table (.csv, .toml) with a column `recording`
and options of `tofuse run` as further ones; see docs/batch.md. The same command goes on where
an earlier one was stopped.

exit status:
  0  every recording has a result, and every readable frame of them a pose
  3  there are results, but some recording has none, or some readable frame no pose
  2  there is no result: one line on stderr says why
"""
_VIEWS = """\
A view is a file with one view (PLY, PCD, LAS, LAZ, E57, ...), or REC#12: frame 12 of
a recording, counted from 0.

"""
_EXIT_CALIBRATE = """\
exit status:
  0  every camera is placed
  3  the file was written, but some camera could not be placed
  2  nothing was written: one line on stderr says why
"""
_EXIT_CHECK = """\
exit status:
  0  no camera was moved
  3  some camera was moved, or cannot be checked
  2  nothing could be checked: one line on stderr says why
"""
_EXIT_REGISTER = """\
exit status:
  0  the pose is believed
  3  the pose is not believed, or cannot be verified; it is still printed and written
  2  nothing was written: one line on stderr says why
"""


_SESSIONS = """\
A RESULT is the --out of `tofuse run` or `tofuse merge`; its recording must be where it
was. The first one's world stays. What can't be joined is kept apart, and named.

"""
_EXIT_MERGE = """\
exit status:
  0  a result was written and every readable frame is in one map
  3  a result was written, but a session or a frame could not be joined
  2  nothing was written: one line on stderr says why
"""


class Parser(argparse.ArgumentParser):
    """An argument parser that says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2."""
        sys.stderr.write(f"{self.prog}: {message}; see `{self.prog} --help`\n")
        sys.exit(2)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse; the command itself says which of its words it does not know."""
        found, unknown = self.parse_known_args(args, namespace)
        if unknown:
            command: Parser = getattr(found, "parser", self)
            command.refuse(unknown)
        return found

    def refuse(self, unknown: Sequence[str]) -> NoReturn:
        """Say what is not known, and which option is nearest to it."""
        word = unknown[0].partition("=")[0]
        near = get_close_matches(word, self._option_string_actions, 1)
        self.error(f"{word} is not known" + (f", {near[0]} is" if near else ""))


class _Help(argparse.HelpFormatter):
    """Puts each command and what it does on one line."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog)
        # What argparse itself counts leaves out that commands are indented once more.
        self._action_max_length = 15


def make_parser(kind: type[Parser] = Parser) -> Parser:
    """Return the parser of the whole command line, of a kind that may deal with errors its way."""
    parser = kind(
        prog="tofuse",
        description="Turn recordings of Time-of-Flight cameras into one 3D model and the "
        "camera's trajectory, and say how far the result can be trusted.",
        epilog="To begin: `tofuse demo`. `tofuse COMMAND --help` tells more of each.",
        formatter_class=_Help,
    )
    parser.add_argument("--version", action="version", version=f"tofuse {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
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

        made: Callable[[argparse.Namespace], int] = getattr(functions, function or name)
        return made(arguments)

    parser.set_defaults(command=call, parser=parser)
    return parser


def _run(commands: Any) -> None:
    p = _command(commands, "run", "reconstruct a recording", epilog=_EXIT)
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings, joined in this order")
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the result")
    p.add_argument("--overwrite", action="store_true", help="replace an earlier result in --out")
    p.add_argument("--json", action="store_true", help="progress and result as JSON lines")
    p.add_argument(
        "--into",
        type=Path,
        metavar="RESULT",
        help="an earlier result that becomes a map of both, if they overlap (see `tofuse merge`)",
    )
    p.add_argument(
        "--texture", action="store_true", help="a texture on the surface, in mesh.glb and mesh.obj"
    )
    p.add_argument(
        "--faces", type=_count, metavar="N", help="at most so many triangles (default: all)"
    )
    p.add_argument(
        "--voxel",
        type=_length,
        metavar="LENGTH",
        help="resolution of the model, as 5mm (default: what the camera resolves)",
    )
    p.add_argument(
        "--rig",
        type=Path,
        metavar="FILE",
        help="a rig.json: each INPUT is one camera of it, in its order",
    )
    _processing(p)
    g = p.add_argument_group("watch it in the browser")
    g.add_argument(
        "--view", action="store_true", help="show the model while it grows, and then the result"
    )
    _page(g)
    g = p.add_argument_group("what to read")
    _source(g)
    _selection(g)
    g.add_argument(
        "--average-still",
        action="store_true",
        help="make one better frame of each stretch in which nothing moves",
    )
    g.add_argument("--min-depth", type=_metres, metavar="M", help="drop points nearer than this")
    g.add_argument("--max-depth", type=_metres, metavar="M", help="drop points beyond this")


def _source(p: Any) -> None:
    p.add_argument("--format", metavar="F", help="format of INPUT, if it can't be guessed")
    p.add_argument("--camera", type=Path, metavar="FILE", help="a camera.json to use instead")
    p.add_argument("--topic", metavar="T", help="topic of a bag, if the guess is wrong")


def _selection(p: Any) -> None:
    p.add_argument("--start", type=_whole, default=0, metavar="I", help="first frame (0)")
    p.add_argument("--end", type=_whole, metavar="I", help="stop before this frame")
    p.add_argument("--every", type=_count, default=1, metavar="N", help="use every N-th frame")


def _processing(p: argparse.ArgumentParser) -> None:
    g = p.add_argument_group("how to reconstruct")
    g.add_argument("--method", metavar="NAME", help="default, thesis (default: default)")
    g.add_argument(
        "--config", type=Path, metavar="FILE", help="options from a .toml, or an earlier run.json"
    )
    g.add_argument(
        "--guess",
        choices=("identity", "previous", "odometry"),
        help="where each registration starts",
    )
    g.add_argument(
        "--prior",
        choices=("auto", "none", "device"),
        default="auto",
        help="what counts beside the images, as far as it agrees with them: gravity and a phone's "
        "own poses (auto, the default), nothing (none), or also odometry (device)",
    )
    g.add_argument(
        "--loops", type=Path, metavar="FILE", help="loops known beforehand, one `i j` a line"
    )
    g.add_argument(
        "--object",
        action="store_true",
        help="a turned object before a still background, which is learnt unless cut off",
    )
    g.add_argument(
        "--unwrap",
        action="store_true",
        help="bring back what lies beyond the range after which the camera's phase repeats",
    )
    g.add_argument(
        "--tolerance",
        type=_length,
        metavar="LENGTH",
        help='accuracy of a "good" result, as 30mm (0.5 %% of the model, at least 10mm)',
    )
    _seed(g)
    g.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")


def _seed(p: Any) -> None:
    p.add_argument("--seed", type=_seed_number, metavar="N", help="seed of all randomness (0)")


def _batch(commands: Any) -> None:
    p = _command(
        commands, "batch", "reconstruct many recordings, as jobs of their own", epilog=_EXIT_BATCH
    )
    p.add_argument("list", type=Path, metavar="LIST", help="which recordings, and their options")
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the results")
    p.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results of other options; those of the same are kept all the same",
    )
    p.add_argument("--json", action="store_true", help="jobs and outcome as JSON lines")
    p.add_argument("--only", action="append", metavar="NAME", help="this job; may be repeated")
    p.add_argument(
        "--print-jobs", action="store_true", help="do nothing but print a command for each job"
    )
    g = p.add_argument_group("who works")
    who = g.add_mutually_exclusive_group()
    who.add_argument(
        "--workers", type=_count, metavar="N", help="jobs at a time, on this machine (1)"
    )
    who.add_argument(
        "--scheduler", metavar="ADDRESS", help="of a Dask cluster: tcp://HOST:8786, or its file"
    )
    g.add_argument(
        "--threads",
        type=_count,
        metavar="N",
        help="threads of each job (this machine: all cores, shared by the jobs; Dask: 1)",
    )
    g.add_argument(
        "--memory", type=_bytes, metavar="SIZE", help="what a job needs, as 4GB (not limited)"
    )
    g.add_argument(
        "--retries",
        type=_seed_number,
        metavar="N",
        help="begin a job again so often whose process was killed (3)",
    )


def _register(commands: Any) -> None:
    p = _command(
        commands, "register", "register two files or frames", epilog=_VIEWS + _EXIT_REGISTER
    )
    p.add_argument("source", metavar="SOURCE", help="the view that is moved")
    p.add_argument("target", metavar="TARGET", help="the view that stays")
    p.add_argument(
        "--guess", type=Path, metavar="FILE", help="T_target_source to start from (none)"
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="folder for the result (none)")
    p.add_argument("--overwrite", action="store_true", help="replace an earlier one in --out")
    p.add_argument("--json", action="store_true", help="as JSON")
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")
    g = p.add_argument_group("what to read")
    _source(g)


def _judge(commands: Any) -> None:
    p = _command(
        commands,
        "judge",
        "say how accurate poses from anywhere are, without a reference",
        epilog="exit status: 0, judged; 3, the depth images contradict the poses; 2, bad input",
    )
    p.add_argument("recording", metavar="RECORDING", help="images of a depth camera")
    p.add_argument(
        "trajectory",
        type=Path,
        metavar="TRAJECTORY",
        help="a trajectory of any known format, or a result",
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="folder for the refined result (none)")
    p.add_argument("--overwrite", action="store_true", help="replace an earlier result in --out")
    p.add_argument("--json", action="store_true", help="as JSON")
    p.add_argument(
        "--tolerance",
        type=_length,
        metavar="LENGTH",
        help="accuracy of good poses, as 30mm (0.5 %% of the model, at least 10mm)",
    )
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")
    g = p.add_argument_group("what to read")
    _source(g)
    _selection(g)


def _merge(commands: Any) -> None:
    p = _command(
        commands,
        "merge",
        "put the results of several recordings into one map",
        epilog=_SESSIONS + _EXIT_MERGE,
    )
    p.add_argument(
        "results",
        nargs="+",
        type=Path,
        metavar="RESULT",
        help="two or more; the world is the first one's",
    )
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the map")
    p.add_argument("--overwrite", action="store_true", help="replace an earlier result in --out")
    p.add_argument("--json", action="store_true", help="progress and result as JSON lines")
    p.add_argument(
        "--tolerance",
        type=_length,
        metavar="LENGTH",
        help='accuracy of a "good" map, as 30mm (default: that of the first result)',
    )
    p.add_argument(
        "--faces", type=_count, metavar="N", help="at most so many triangles (as the first result)"
    )
    p.add_argument(
        "--voxel", type=_length, metavar="LENGTH", help="resolution of the model, as 5mm (likewise)"
    )
    _seed(p)
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")


def _rig(commands: Any) -> None:
    p = commands.add_parser(
        "rig",
        help="calibrate a rig of several cameras, or check one",
        description="Several depth cameras that are fixed to each other.",
        formatter_class=_Help,
    )
    p.set_defaults(parser=p)
    commands = p.add_subparsers(title="commands", metavar="COMMAND", required=True)
    p = _command(
        commands,
        "calibrate",
        "say where the cameras of a rig are",
        epilog="Give one recording of each camera, of the same time: one image each, images of a "
        "scene in\nwhich something moves, or a walk with the rig. The first camera is the rig's "
        "frame.\n\n" + _EXIT_CALIBRATE,
        function="rig_calibrate",
    )
    p.add_argument("inputs", nargs="+", metavar="RECORDING", help="one for each camera")
    p.add_argument("--out", required=True, type=Path, metavar="FILE", help="the rig.json to write")
    p.add_argument("--overwrite", action="store_true", help="replace FILE if it is there")
    _rig_options(p)
    p = _command(
        commands,
        "check",
        "say whether a camera of a rig was moved since it was calibrated",
        epilog=_EXIT_CHECK,
        function="rig_check",
    )
    p.add_argument("rig", type=Path, metavar="RIG", help="a rig.json")
    p.add_argument(
        "inputs", nargs="+", metavar="RECORDING", help="new ones of its cameras, in its order"
    )
    _rig_options(p)


def _rig_options(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--motion",
        choices=("auto", "still", "moving"),
        default="auto",
        help="whether the cameras stood still (default: as their images say)",
    )
    p.add_argument("--json", action="store_true", help="as JSON")
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")
    p.add_argument("--format", metavar="F", help="format of the recordings, if not guessed")


def _demo(commands: Any) -> None:
    p = _command(
        commands,
        "demo",
        "simulate a recording and reconstruct it",
        epilog="The recording is left in DIR/recording, the result in DIR.\n\n" + _EXIT,
    )
    p.add_argument("--scene", choices=DEMO_SCENES, default="room", help="what to simulate (room)")
    p.add_argument(
        "--out",
        type=Path,
        default=Path("tofuse-demo"),
        metavar="DIR",
        help="folder for it (tofuse-demo)",
    )
    p.add_argument("--overwrite", action="store_true", help="replace an earlier demo in DIR")
    p.add_argument("--json", action="store_true", help="progress and result as JSON lines")
    p.add_argument("--method", metavar="NAME", help="default, thesis (default: default)")
    _seed(p)
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")


def _simulate(commands: Any) -> None:
    p = _command(commands, "simulate", "make a recording with a simulated camera")
    p.add_argument("scene", metavar="SCENE", help=", ".join(DEMO_SCENES))
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for it")
    p.add_argument("--camera", default="sr4000", metavar="NAME", help="which camera (sr4000)")
    p.add_argument("--every", type=_count, metavar="N", help="stride (default: the thesis's)")
    p.add_argument("--frames", type=_count, metavar="N", help="stop after this many frames")
    p.add_argument("--first", type=_seed_number, metavar="K", help="raw frame to begin with (0)")
    p.add_argument("--uniform", action="store_true", help="one albedo everywhere, no texture")
    passing = p.add_mutually_exclusive_group()
    for kind, does in (("person", "walks"), ("box", "slides")):
        passing.add_argument(
            f"--with-{kind}",
            type=_ratio,
            metavar="RATIO",
            help=f"a {kind} {does} through the view and covers this part of it, 0 to 1",
        )
    p.add_argument(
        "--without",
        default="",
        metavar="EFFECTS",
        help="errors to switch off, separated by commas (or: all)",
    )
    p.add_argument(
        "--no-correction", action="store_true", help="leave out the factory's depth correction"
    )
    p.add_argument("--imu", action="store_true", help="an accelerometer on the camera as well")
    p.add_argument("--sigma", type=_metres, metavar="M", help="noise of the peaks scene (0.05)")
    _seed(p)
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")


def _inspect(commands: Any) -> None:
    p = _command(commands, "inspect", "say what a recording is, and what is wrong with it")
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings, joined in this order")
    _source(p)
    p.add_argument("--sheet", type=Path, metavar="PNG", help="write a contact sheet of the frames")
    p.add_argument("--object", action="store_true", help="an object turns before a still camera")
    p.add_argument("--quick", action="store_true", help="only what a run does at its start")
    p.add_argument("--json", action="store_true", help="as JSON")


def _convert(commands: Any) -> None:
    p = _command(commands, "convert", "write any recording as a native, TUM or Open3D folder")
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings, joined in this order")
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="a new folder for it")
    p.add_argument(
        "--to",
        choices=("native", "tum", "open3d"),
        default="native",
        help="layout of the folder (native; the others lose what they have no place for)",
    )
    _source(p)
    _selection(p)


def _record(commands: Any) -> None:
    p = _command(commands, "record", "record from a camera that is plugged in")
    p.add_argument(
        "device", nargs="?", metavar="CAMERA", help="which; without, those that can be used"
    )
    p.add_argument("--out", type=Path, metavar="DIR", help="a new folder for the recording")
    p.add_argument("--seconds", type=_seconds, metavar="S", help="stop after this time")
    p.add_argument("--frames", type=_count, metavar="N", help="stop after so many frames")
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="an option of the camera, such as serial=1234; may be repeated",
    )


def _calibrate(commands: Any) -> None:
    p = _command(
        commands,
        "calibrate",
        "estimate a camera's lens or the errors of its depth, or import a lens",
        epilog="lens: from views of a checkerboard, writes a camera.json.\n"
        "depth: from views of planes, writes a correction.npz.\n"
        "import: from a file of Bouguet's toolbox, CalLab, OpenCV or ROS, writes a camera.json.\n",
    )
    p.add_argument("subject", choices=("lens", "depth", "import"), help="what to do")
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings; import: one file")
    p.add_argument("--out", type=Path, metavar="FILE", help="write the result")
    p.add_argument("--overwrite", action="store_true", help="replace FILE if it is there")
    p.add_argument("--json", action="store_true", help="what was found, as JSON")
    g = p.add_argument_group("lens and depth")
    g.add_argument(
        "--board", metavar="CxR:M", help="inner corners and metres of a square, such as 8x6:0.1"
    )
    g.add_argument(
        "--image",
        choices=("amplitude", "color"),
        default="amplitude",
        help="where the board is looked for (amplitude)",
    )
    _source(g)
    _selection(g)
    g = p.add_argument_group("depth")
    g.add_argument(
        "--wall", action="store_true", help="the board lies flat on a wall, all of which is used"
    )
    g.add_argument(
        "--planes",
        type=_count,
        default=4,
        metavar="N",
        help="without --board: planes of each view at most (4)",
    )
    _seed(g)
    g = p.add_argument_group("lens")
    g.add_argument(
        "--model",
        choices=("pinhole", "brown", "rational", "fisheye"),
        default="brown",
        help="kind of lens (brown)",
    )
    g = p.add_argument_group("import")
    g.add_argument("--recording", metavar="REC", help="keep depth unit and kind of this recording")
    g.add_argument("--index", type=_whole, metavar="N", help="which camera of a CalLab file")


def _noise(commands: Any) -> None:
    p = _command(commands, "noise", "estimate a camera's noise from a recording that stands still")
    p.add_argument("inputs", nargs="+", metavar="INPUT", help="recordings, joined in this order")
    p.add_argument("--out", type=Path, metavar="FILE", help="write the model, e.g. noise.json")
    p.add_argument("--overwrite", action="store_true", help="replace FILE if it is there")
    p.add_argument("--name", metavar="NAME", help="what to call the camera")
    _source(p)
    p.add_argument("--json", action="store_true", help="as JSON")


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
        "--recording", type=Path, metavar="REC", help="also measure how well its images agree"
    )
    p.add_argument(
        "--reference-error",
        type=_length,
        metavar="LENGTH",
        help="how far off the reference itself may be (rms), as 20mm: gives an interval of the ATE",
    )
    p.add_argument("--json", action="store_true", help="as JSON")


def _optimize(commands: Any) -> None:
    p = _command(commands, "optimize", "optimise a pose graph")
    p.add_argument("input", type=Path, metavar="IN.g2o")
    p.add_argument("--out", required=True, type=Path, metavar="OUT.g2o")
    p.add_argument(
        "--optimiser", metavar="NAME", help="how (default: levenberg-marquardt; castellani, ...)"
    )
    p.add_argument("--overwrite", action="store_true", help="replace OUT.g2o if it is there")


def _export(commands: Any) -> None:
    p = _command(commands, "export", "write a result in other formats")
    p.add_argument("result", type=Path, metavar="DIR", help="the --out of `tofuse run`")
    p.add_argument("formats", nargs="+", metavar="FORMAT", help=", ".join(EXPORTS))
    p.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the files (beside the result)"
    )
    p.add_argument("--overwrite", action="store_true", help="replace files that are there")


def _experiments(commands: Any) -> None:
    p = _command(commands, "experiments", "run chapters 4 and 5 of the thesis again")
    p.add_argument("--out", required=True, type=Path, metavar="DIR", help="folder for the page")
    p.add_argument("--overwrite", action="store_true", help="replace earlier experiments in DIR")
    p.add_argument("--cases", default="", metavar="NAMES", help="only these, separated by commas")
    p.add_argument("--seeds", type=_count, default=20, metavar="N", help="noise seeds (20)")
    _seed(p)
    p.add_argument("--threads", type=_count, metavar="N", help="threads (default: all cores)")


def _view(commands: Any) -> None:
    p = _command(commands, "view", "show a result in the browser")
    p.add_argument("result", type=Path, metavar="DIR", help="the --out of `tofuse run`")
    _page(p)


def _page(p: Any) -> None:
    p.add_argument("--port", type=_port, metavar="N", help="port of the page (8080 or the next)")
    p.add_argument("--no-open", action="store_true", help="do not open the browser")


def _port(text: str) -> int:
    value = _whole(text)
    if not 1 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"{text} is not a port from 1 to 65535")
    return value


def _bytes(text: str) -> int:
    from tofuse.batch.jobs import parse_bytes

    try:
        return parse_bytes(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from error


def _count(text: str) -> int:
    value = _whole(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not 1 or more")
    return value


def _seed_number(text: str) -> int:
    value = _whole(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _ratio(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not between 0 and 1")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time in seconds above 0")
    return value


_UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def _length(text: str) -> float:
    """A length above 0 in m, given as 30mm, 3cm, 0.03m or 0.03."""
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(mm|cm|m)?\s*", text)
    try:
        value = float(match[1]) * _UNITS_M[match[2] or "m"] if match else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length, such as 30mm or 0.03")
    return value


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a distance in metres")
    return value
