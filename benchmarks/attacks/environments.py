"""Runs of the program in hostile environments.

Each run must end with a result and its exit status, or without a result and with a line on standard
error that states the reason; without a traceback, and with all other files unchanged.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

LIMIT_S = 120.0
_MB = 1 << 20

# Runs in the child before any module of the program is loaded.
_BEGIN = """
import os, sys
sys.argv[0] = "tofuse"
{setup}
from tofuse.apps.cli import console
sys.exit(console())
"""


@dataclass(frozen=True)
class Environment:
    """An environment, and the required outcome of a run.

    Attributes
    ----------
    setup
        Python code that the child executes first.
    shell
        Redirection of its streams, in shell syntax.
    variables
        Changed environment variables.
    arguments
        Arguments appended to the command.
    must
        "work", "refuse", or "either".
    message
        Text required on standard error if it must refuse.
    leaves
        Whether hidden files may remain, for the next run to remove.
    """

    name: str
    setup: str = ""
    shell: str = ""
    variables: tuple[tuple[str, str], ...] = ()
    arguments: tuple[str, ...] = ()
    must: str = "work"
    message: str = ""
    leaves: bool = False
    folder: str = "out"


def _limit(what: str, soft: int, hard: int | None = None) -> str:
    return f"import resource; resource.setrlimit(resource.{what}, ({soft}, {hard or soft}))"


def _at(function: str, action: str, count: int = 1) -> str:
    """Code that executes `action` at the `count`-th call of a function, given as module:name."""
    module, name = function.split(":")
    return f"""
import importlib, signal
def begin(count=[0]):
    module = importlib.import_module({module!r})
    path = {name!r}.split(".")
    owner = module
    for part in path[:-1]:
        owner = getattr(owner, part)
    real = getattr(owner, path[-1])
    def call(*words, **options):
        count[0] += 1
        if count[0] == {count}:
            {action}
        return real(*words, **options)
    setattr(owner, path[-1], call)
begin()
"""


_NO_THREADS = """
import threading
def fail(*words, **options):
    raise RuntimeError("can't start new thread")
threading.Thread.start = fail
"""
_CLOCK = """
import time, itertools
passed = itertools.count()
time.time = lambda: 2e9 - 1000.0 * next(passed)
time.time_ns = lambda: int(1e9 * time.time())
"""
STAGES = (
    ("opening", "tofuse.engine.mapping.adaptation:adapted"),
    ("tracking", "tofuse.engine.mapping.reconstructing:push_frames"),
    ("a model", "tofuse.engine.mapping.backend:BackEnd.run"),
    ("writing", "tofuse.apps.results.output:_write_files"),
    ("moving", "tofuse.formats.files.staging:replace_folder"),
    ("moves", "tofuse.formats.files.staging:_move_into_place"),
    ("the end", "tofuse.apps.jobs.tracked_file:TrackedFile.remove"),
)
_SIGNALS = ("SIGINT", "SIGTERM")

ENVIRONMENTS: tuple[Environment, ...] = (
    Environment("ordinary"),
    *(
        Environment(f"{mb} MB of addresses", _limit("RLIMIT_AS", mb * _MB), must="refuse",
                    message="not enough memory")
        for mb in (512, 700, 1024, 1536)
    ),
    *(
        Environment(f"{mb} MB of addresses, one thread", _limit("RLIMIT_AS", mb * _MB),
                    arguments=("--threads", "1"), must="either")
        for mb in (1800, 2048, 4096)
    ),
    *(
        Environment(f"{count} file handles", _limit("RLIMIT_NOFILE", count), must="either",
                    leaves=True)
        for count in (7, 9, 12, 16, 24, 32, 64)
    ),
    Environment("no threads", _NO_THREADS, must="either", message=""),
    Environment("no threads, --threads 1", _NO_THREADS, arguments=("--threads", "1"),
                must="either"),
    Environment("files of 20 kB at most", _limit("RLIMIT_FSIZE", 20_000), must="refuse",
                message="can't be written"),
    Environment("stdout closed", shell=">&-"),
    Environment("stderr closed", shell="2>&-"),
    Environment("both closed", shell=">&- 2>&-"),
    Environment("stdin closed", shell="<&-"),
    Environment("all closed", shell="<&- >&- 2>&-"),
    Environment("stdout full", shell="> /dev/full"),
    Environment("stderr full", shell="2> /dev/full"),
    Environment("JSON lines to a full disk", shell="> /dev/full", arguments=("--json",)),
    Environment("a reader that leaves", shell="| head -c 1 > /dev/null", arguments=("--json",)),
    Environment("a reader that never reads", shell="| true", arguments=("--json",)),
    Environment("a reader of errors that leaves", shell="2>&1 | head -c 1 > /dev/null"),
    Environment("ASCII", variables=(("PYTHONIOENCODING", "ascii"), ("PYTHONUTF8", "0"))),
    Environment("Windows-1252", variables=(("PYTHONIOENCODING", "cp1252"), ("PYTHONUTF8", "0"))),
    Environment("the C locale", variables=(("LC_ALL", "C"), ("PYTHONCOERCECLOCALE", "0"),
                                           ("PYTHONUTF8", "0"))),
    Environment("a name that is no UTF-8", folder="o\udcffu\udce9t"),
    Environment("a name in ASCII streams", variables=(("PYTHONIOENCODING", "ascii"),),
                folder="süd\udcff☃"),
    Environment("a name with markup", folder="[red]<b>x '\"&{{7*7}}%s\n$(id)"),
    Environment("a home that can't be written", variables=(("HOME", "/proc"),
                                                           ("XDG_CACHE_HOME", "/proc/x"))),
    Environment("no home", variables=(("HOME", "/nonexistent"), ("XDG_CACHE_HOME", ""))),
    Environment("no folder for temporary files", variables=(("TMPDIR", "/nonexistent"),)),
    Environment("without assertions and docstrings", variables=(("PYTHONOPTIMIZE", "2"),)),
    Environment("another order of sets", variables=(("PYTHONHASHSEED", "4711"),)),
    Environment("64 threads of OpenMP and BLAS",
                variables=(("OMP_NUM_THREADS", "64"), ("OPENBLAS_NUM_THREADS", "64"))),
    Environment("files for the user alone", "os.umask(0o077)"),
    Environment("stacks of 1 MB", _limit("RLIMIT_STACK", _MB)),
    Environment("an unknown time zone", variables=(("TZ", "Nowhere/Land"),)),
    Environment("a clock that goes backwards", _CLOCK),
    Environment("one core", "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})"),
    Environment("the output folder is read-only", must="refuse", folder="/proc/out",
                message="can't be written"),
    *(
        Environment(f"{name} at {stage}",
                    _at(function, f"os.kill(os.getpid(), signal.{name})"), must="either")
        for stage, function in STAGES
        for name in _SIGNALS
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """Exit status and standard error of a run, whether there is a result, and the faults."""

    status: int | None
    stderr: str
    result: bool
    faults: tuple[str, ...]


def attempt(environment: Environment, recording: Path, where: Path, *arguments: str) -> Outcome:
    """Run the program on a recording in an environment, over an earlier result."""
    out = Path(environment.folder) if environment.folder[0] == "/" else where / environment.folder
    mine = None
    if out.is_relative_to(where):
        out.mkdir()
        mine = b'{"schema": 1, "version": "0", "verdict": "good"}'
        (out / "run.json").write_bytes(mine)
    command = [
        sys.executable,
        "-c",
        _BEGIN.format(setup=environment.setup),
        "run",
        str(recording),
        "--out",
        str(out),
        "--overwrite",
        *arguments,
        *environment.arguments,
    ]
    with tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as code:
        # The status of the program itself, not of the end of the pipe.
        script = f'{{ "$@"; echo $? >&{code.fileno()}; }} {environment.shell}'
        try:
            subprocess.run(
                ["/bin/bash", "-c", script, "bash", *command],
                stdout=subprocess.DEVNULL,
                stderr=err,
                pass_fds=(code.fileno(),),
                env={**os.environ, **dict(environment.variables)},
                timeout=LIMIT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return Outcome(None, "", False, (f"took more than {LIMIT_S:.0f} s",))
        err.seek(0)
        code.seek(0)
        stderr = err.read().decode(errors="replace")
        status = int(code.read() or b"-1")
    return _judged(environment, status, stderr, out, mine)


def _judged(
    environment: Environment, status: int, stderr: str, out: Path, mine: bytes | None
) -> Outcome:
    whole = {"run.json", "trajectory.txt", "cloud.ply", "pose_graph.g2o"}
    there = {p.name for p in out.iterdir()} if out.is_dir() else set()
    result = whole <= there
    old = mine is not None and (out / "run.json").read_bytes() == mine
    faults = []
    if "Traceback" in stderr or "Exception ignored" in stderr:
        faults.append("a traceback")
    if status in (0, 3) and not result:
        faults.append(f"status {status} without a result")
    if status == 1:
        faults.append("status 1")
    if status not in (0, 3) and not old and mine is not None and not result:
        faults.append("neither the old result nor a new one")
    if result and old:
        faults.append("a mixture of two results")
    hidden = sorted(name for name in there if name.startswith(".tofuse-"))
    if hidden and not environment.leaves and status >= 0 and status not in (134, 137, 139):
        faults.append(f"left {hidden}")
    if status in (134, 139):
        faults.append("crashed")
    lines = [line for line in stderr.splitlines() if line.startswith("tofuse: ")]
    if status not in (0, 3) and not lines and "2>" not in environment.shell:
        faults.append("no reason given")
    if environment.must == "work" and status not in (0, 3):
        faults.append(f"status {status}")
    if environment.must == "refuse" and status != 2:
        faults.append(f"status {status}, not 2")
    if environment.must == "refuse" and environment.message not in stderr:
        faults.append(f"message lacks {environment.message!r}")
    return Outcome(status, stderr, result, tuple(faults))
