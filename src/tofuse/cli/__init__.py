"""The command line.

Exit status: 0, a result was written and every readable frame has a pose; 3, a result was written
but some readable frame has none; 2, nothing was written: one line on stderr says why. Of
`register`: 0, the pose is believed; 3, it is not, or cannot be verified. A command that is asked to
end by a signal has the status of that (130, 143), one that only prints and is not read, 141, and 1
is a fault of the program.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

_NOT_READ = 128 + 13  # what a process has that a broken pipe ended
_WHOLE = "existing files are unchanged, or the new result is complete"
_INTERRUPTED = f"interrupted; {_WHOLE}"
_MEMORY = "out of memory; use --every, --max-depth or a larger voxel_m"


def console() -> int:
    """Run the command of this process, which ends with it, and return its exit status."""
    try:
        prepare_process()
        with ended_by_signals():
            status = faults_told(main)
        # Else all that is left is looked through for cycles once more, which takes half a second.
        gc.freeze()
    except KeyboardInterrupt:  # before the command began, or after it ended
        _say(_INTERRUPTED)
        return 130
    return status


def prepare_process() -> None:
    """Set what libraries look at when they are loaded."""
    # Our threads do the work, and BLAS is held to one anyway; the memory that it sets aside for
    # others is more than all else, and without enough of it they wait for ever.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Let what asks this process to end be an exception, so that all is put in order first."""
    from tofuse.errors import Ended

    def end(number: int, _frame: object) -> None:
        raise Ended(number)

    names = ("SIGTERM", "SIGHUP", "SIGBREAK")  # which of them there are depends on the system
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    here = threading.current_thread() is threading.main_thread()
    # What is ignored (by nohup) stays so. Only the first thread may change any of it.
    wanted = [n for n in numbers if here and signal.getsignal(n) == signal.SIG_DFL]
    before = {number: signal.signal(number, end) for number in wanted}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def faults_told(command: Callable[[], int]) -> int:
    """Return the exit status of a command; a fault of the program is said in a line as well."""
    try:
        return command()
    except Exception as error:
        if os.environ.get("TOFUSE_TRACEBACK"):
            raise
        _say(
            f"a fault of the program ({type(error).__name__}: {error}); please report it, with "
            "what it says when TOFUSE_TRACEBACK=1 is set"
        )
        return 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""

    def command() -> int:
        from tofuse.cli.machine import check_machine
        from tofuse.cli.parser import make_parser

        try:
            arguments = make_parser().parse_args(argv)
        except SystemExit as stop:  # it has said what was asked for, or what is wrong
            raise SystemExit(_delivered(int(stop.code or 0), None)) from None
        check_machine(getattr(arguments, "threads", None))
        status: int = arguments.command(arguments)
        return _delivered(status, getattr(arguments, "out", None))

    return told(command)


def _delivered(status: int, out: object) -> int:
    """The status of a command that ended, if all that it printed could be written."""
    sys.stdout.flush()
    error = getattr(sys.stdout, "error", None)
    if error is None:
        return status
    if out is not None:
        _say(f"not all could be printed ({_why(error)}); what was asked for is in {out}")
        return status
    if isinstance(error, BrokenPipeError):
        return _NOT_READ
    _say(f"standard output: can't be written ({_why(error)})")
    return 2


def _why(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()


def _say(text: str) -> None:
    print("tofuse: " + " ".join(text.split()), file=sys.stderr)


def told(command: Callable[[], int]) -> int:
    """Return the exit status of a command; what stops it is said in a line."""
    from tofuse.cli.streams import outlets
    from tofuse.errors import Ended, TofuseError

    with outlets():
        try:
            return command()
        except TofuseError as error:
            _say(str(error))
            return 2
        except KeyboardInterrupt:
            _say(_INTERRUPTED)
            return 130
        except Ended as error:
            _say(f"asked to end; {_WHOLE}")
            return 128 + error.number
        except OSError as error:
            # What the rooms have not turned into a message of their own.
            where = f"{error.filename}: " if error.filename else ""
            _say(f"{where}{error.strerror or error}")
            return 2
        except MemoryError:
            _say(_MEMORY)
            return 2
        except RecursionError:
            _say("something that was given is nested too deeply to be understood; check the files")
            return 2
        except RuntimeError as error:
            if "start new thread" not in str(error):
                raise
            _say("no more threads can be started; use --threads 1, or allow more (ulimit -u)")
            return 2
        except ImportError as error:
            _say(
                f"a part of the program can't be loaded ({error}); is it installed whole, and is "
                "there enough memory, and enough file handles (ulimit -n)?"
            )
            return 2
