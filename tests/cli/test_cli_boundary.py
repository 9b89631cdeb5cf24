"""The process in hostile environments: a result, or one line that states the reason."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from paths import BENCHMARKS
from tofuse.apps.cli import program as cli
from tofuse.apps.cli.program import main, run_command
from tofuse.apps.cli.streams import SafeStream, safe_streams
from tofuse.apps.results.folders import TRACKED
from tofuse.engine.compute import jit
from tofuse.engine.compute import thread_pool as cores
from tofuse.engine.errors import Ended
from tofuse.lab.simulation.record import simulate

sys.path.insert(0, str(BENCHMARKS))
from attacks.environments import ENVIRONMENTS, Environment, attempt

# One of each kind; `benchmarks/attack.py` runs all of them.
CHOSEN = (
    "512 MB of addresses",
    "12 file handles",
    "no threads",
    "files of 20 kB at most",
    "all closed",
    "JSON lines to a full disk",
    "a reader that leaves",
    "the output folder is read-only",
    "SIGINT at tracking",
)
# Others of a kind that is chosen already.
NIGHTLY = (
    "1024 MB of addresses", "1536 MB of addresses", "SIGTERM at moves", "SIGTERM at the end"
)  # fmt: skip
# These are independent of each other, so that one run is enough.
TOGETHER = (
    "stdin closed",
    "a name in ASCII streams",
    "a home that can't be written",
    "a clock that goes backwards",
)
# The report takes half of a run, and is drawn where fonts and caches may be missing: few file
# handles, and no home.
_WITH_REPORT = ("12 file handles", "together")

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs limits and paths of Linux")


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate("peaks", tmp_path_factory.mktemp("peaks") / "rec", frames=2)


def together(several: list[Environment]) -> Environment:
    """One environment with the properties of several, in all of which a run works."""
    assert {e.must for e in several} == {"work"}
    return Environment(
        "together",
        setup="".join(e.setup for e in several),
        shell=" ".join(e.shell for e in several),
        variables=tuple(v for e in several for v in e.variables),
        folder=next(e.folder for e in several if e.folder != "out"),
    )


@pytest.mark.nightly_part
@pytest.mark.parametrize(
    "name",
    [*CHOSEN, *(pytest.param(name, marks=pytest.mark.nightly) for name in ("together", *NIGHTLY))],
)
def test_hostile_environments_give_result_or_one_line_error(
    name: str, clouds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Kernels are not compiled anew where the home can't be written; see test_compute_jit.py.
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(Path(jit.cache_folder()).parent))
    known = {environment.name: environment for environment in ENVIRONMENTS}
    environment = together([known[n] for n in TOGETHER]) if name == "together" else known[name]
    more = () if name in _WITH_REPORT else ("--no-report",)
    outcome = attempt(environment, clouds, tmp_path, "--method", "thesis", *more)
    assert outcome.faults == (), outcome.stderr


def shell(script: str) -> tuple[int, str]:
    words = ["/bin/bash", "-c", script.replace("tofuse", f"{sys.executable} -m tofuse", 1)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.nightly_part
def test_unwritable_stdout_is_reported(clouds: Path) -> None:
    full = "tofuse: standard output: can't be written (no space left on device)\n"
    assert shell(f"tofuse inspect {clouds} > /dev/full") == (2, full)
    assert shell("tofuse --help > /dev/full")[0] == 2
    status, stderr = shell(f"tofuse inspect {clouds} | true; exit ${{PIPESTATUS[0]}}")
    assert status in (0, 141)  # it may be read before the reader ends
    assert "Traceback" not in stderr
    status, stderr = shell("{ sleep 1; tofuse --help; } | true; exit ${PIPESTATUS[0]}")
    assert (status, stderr) == (141, "")


class Broken:
    encoding = "ascii"

    def write(self, _text: str) -> int:
        raise BrokenPipeError

    def flush(self) -> None:
        raise BrokenPipeError


def test_safe_stream_never_raises(tmp_path: Path) -> None:
    out = SafeStream(Broken())  # type: ignore[arg-type]
    assert out.write("text") == 4
    out.writelines(["a", "b"])
    out.flush()
    assert isinstance(out.error, BrokenPipeError)
    assert out.encoding == "ascii"
    assert SafeStream(None).write("text") == 4
    with (tmp_path / "text").open("w", encoding="ascii") as file:
        safe = SafeStream(file)
        safe.write("s\xfcd\udcff")
        assert safe.error is None
    assert (tmp_path / "text").read_text() == "s\\xfcd\\udcff"
    before = sys.stdout
    with pytest.raises(KeyError), safe_streams():
        raise KeyError
    assert sys.stdout is before


def in_compiled_code(signal_error: BaseException) -> SystemError:
    """The error of a compiled function that was interrupted by a signal."""
    error = SystemError("returned a result with an exception set")
    error.__cause__ = signal_error
    return error


@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (RuntimeError("can't start new thread"), 2, "--threads 1"),
        (ImportError("libx.so: cannot map"), 2, "can't be loaded (libx.so"),
        (MemoryError(), 2, "out of memory"),
        (Ended(15), 143, "terminated"),
        (BrokenPipeError(32, "Broken pipe"), 2, "Broken pipe"),
        (in_compiled_code(KeyboardInterrupt()), 130, "interrupted"),
        (in_compiled_code(Ended(15)), 143, "terminated"),
    ],
)
def test_command_failures_are_reported_in_one_line(error, status, says, capfd) -> None:
    def fail() -> int:
        raise error

    assert run_command(fail) == status
    stderr = capfd.readouterr().err
    assert says in stderr
    assert stderr.count("\n") == 1


def test_interruption_states_what_repeating_does(tmp_path, monkeypatch, capfd) -> None:
    def interrupt(*_arguments: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tofuse.apps.jobs.running._open", interrupt)
    out = tmp_path / "out"
    words = ["run", str(tmp_path), "--out", str(out)]
    assert main(words) == 130
    assert capfd.readouterr().err.endswith("; the same command starts again from the beginning\n")
    out.mkdir()
    (out / TRACKED).touch()  # whether it is of this run is not known yet
    assert main(words) == 130
    assert "the same command" not in capfd.readouterr().err


def test_program_bug_is_one_line_unless_traceback_is_requested(capfd, monkeypatch) -> None:
    def fail() -> int:
        raise ZeroDivisionError("in\nsome depth")

    assert cli.report_bugs(fail) == 1
    assert capfd.readouterr().err.startswith("tofuse: bug in the program (ZeroDivisionError: ")
    monkeypatch.setenv("TOFUSE_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        cli.report_bugs(fail)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize(("name", "status"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_signal_in_destructor_is_not_lost(name: str, status: int) -> None:
    """Python discards exceptions raised there: Ctrl-C would have no effect."""
    script = (
        "import os, signal, sys, threading, time, weakref\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from tofuse.apps.cli import program as cli\n"
        "class Some: pass\n"
        "def dropped():\n"
        f"    os.kill(os.getpid(), signal.{name})\n"
        "    time.sleep(5)\n"
        "def command():\n"
        "    some = Some()\n"
        "    weakref.finalize(some, dropped)\n"
        "    del some\n"
        "    threading.Event().wait(20)\n"
        "    return 0\n"
        "cli.main = lambda: cli.run_command(command)\n"
        "sys.exit(cli.console())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode == status
    assert done.stderr.count(b"\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_interrupted_command_ends_though_a_thread_does_not() -> None:
    """One that waits for a lock of a library that the signal interrupted."""
    script = (
        "import os, signal, sys, threading, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from tofuse.apps.cli import program as cli\n"
        "cli._GRACE_S = 0.1\n"
        "lock = threading.Lock()\n"
        "lock.acquire()\n"
        "def command():\n"
        "    threading.Thread(target=lock.acquire).start()\n"
        "    os.kill(os.getpid(), signal.SIGINT)\n"
        "    time.sleep(5)\n"
        "cli.main = lambda: cli.run_command(command)\n"
        "sys.exit(cli.console())\n"
    )
    words = [sys.executable, "-c", script]
    done = subprocess.run(words, capture_output=True, check=False, timeout=20)
    assert done.returncode == 130
    assert done.stderr.count(b"\n") == 1


V2, V1 = "sys/fs/cgroup/{}cpu.max", "sys/fs/cgroup/cpu/{}cpu.cfs_{}_us"
CGROUPS: dict[str, tuple[str, dict[str, str], float | None]] = {
    "none": ("", {}, None),
    "all": ("0::/a\n", {V2.format("a/"): "max 100000\n"}, None),
    "half": ("0::/a\n", {V2.format("a/"): "50000 100000\n"}, 0.5),
    "of the one above": (
        "0::/a/b\n", {V2.format("a/"): "250000 100000\n", V2.format("a/b/"): "max 100000\n"}, 2.5,
    ),
    "of a container": ("0::/../../x\n", {V2.format(""): "300000 100000"}, 3.0),
    "version 1": (
        "7:memory:/d\n4:cpu,cpuacct:/d\n",
        {V1.format("d/", "quota"): "150000\n", V1.format("d/", "period"): "100000\n"}, 1.5,
    ),
    "version 1, all": (
        "4:cpu:/\n", {V1.format("", "quota"): "-1\n", V1.format("", "period"): "100000\n"}, None,
    ),
    "nonsense": ("0::/\n", {V2.format(""): "1 0 x\n"}, None),
}  # fmt: skip


@pytest.mark.parametrize("name", CGROUPS)
def test_container_quotas_limit_cores(name, tmp_path, monkeypatch) -> None:
    own, files, wanted = CGROUPS[name]
    files = files | ({"proc/self/cgroup": own} if own else {})
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    assert cores.quota(tmp_path) == wanted
    monkeypatch.setattr(cores, "quota", lambda: wanted)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: {0, 1, 2, 3}, raising=False)
    expected = {None: 4, 0.5: 1, 2.5: 3, 3.0: 3, 1.5: 2}[wanted]
    assert cores.usable_cores.__wrapped__() == expected


def test_second_run_into_same_folder_is_rejected(tmp_path: Path, capfd) -> None:
    from tofuse.apps.results.folders import OutputFolder

    with OutputFolder(tmp_path / "out"):
        assert main(["run", "no such recording", "--out", str(tmp_path / "out")]) == 2
    assert f"is being written by another process (pid {os.getpid()}" in capfd.readouterr().err
