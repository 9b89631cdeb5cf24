"""The command line.

Exit status: 0, a result was written and every readable frame has a pose; 3, a result was written
but some readable frame has none; 2, nothing was written: one line on stderr states the reason. Of
`register`: 0, the pose is accepted; 3, it is rejected or cannot be verified. Terminated by a
signal: 130 or 143; output to a closed pipe: 141; a bug in the program: 1.
"""

from __future__ import annotations

import _thread
import gc
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    Unraisable = Callable[[sys.UnraisableHookArgs], object]

_BROKEN_PIPE = 128 + 13  # as if terminated by SIGPIPE
_UNCHANGED = "existing files are unchanged, or the new result is complete"
_INTERRUPTED, _TERMINATED = f"interrupted; {_UNCHANGED}", f"terminated; {_UNCHANGED}"
_ENDED = tuple(128 + number for number in (1, 2, 15, 21))  # by SIGHUP, SIGINT, SIGTERM, SIGBREAK
_GRACE_S = 5.0  # for threads, after the command has been interrupted
_MEMORY = "out of memory; use --every, --max-depth or a larger voxel_m"


def console() -> int:
    """Run the command of this process and return its exit status."""
    try:
        prepare_process()
        with ended_by_signals():
            status = report_bugs(main)
        if status in _ENDED:
            _end_at_last(status)
        # Avoids a last garbage collection at exit, which takes half a second.
        gc.freeze()
    except KeyboardInterrupt:  # before the command began, or after it ended
        _print_error(_INTERRUPTED)
        _end_at_last(130)
        return 130
    return status


def _end_at_last(status: int) -> None:
    """End this process soon, even if another thread never ends.

    Python waits for all threads. One of them may wait for a lock that the main thread had taken or
    released in a library, such as LLVM's, as the signal arrived.
    """

    def end() -> None:
        sleep(_GRACE_S)
        os._exit(status)

    _thread.start_new_thread(end, ())


def prepare_process() -> None:
    """Set how warnings are printed, and variables that libraries read when they are loaded."""
    warnings.formatwarning = _format_warning
    # BLAS is limited to one thread later, but reserves memory for more; if that fails, it hangs.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Otherwise it prints several lines for a damaged image, besides the message of this program.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")


def _format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
) -> str:
    """Format a warning of this package like its other messages, and others as Python does."""
    from tofuse.engine.errors import InputWarning, KernelCacheWarning

    if issubclass(category, (InputWarning, KernelCacheWarning)):
        return f"tofuse: {message}\n"
    return f"{filename}:{lineno}: {category.__name__}: {message}\n"


@contextmanager
def ended_by_signals() -> Iterator[None]:
    """Turn termination signals into exceptions, so that files are cleaned up."""
    from tofuse.engine.errors import Ended

    def end(number: int, _frame: object) -> None:
        raise Ended(number)

    names = ("SIGTERM", "SIGHUP", "SIGBREAK")  # as far as the system has them
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    is_main = threading.current_thread() is threading.main_thread()
    # Signals that are ignored (nohup) stay ignored. Only the main thread may set handlers.
    handled = [n for n in numbers if is_main and signal.getsignal(n) == signal.SIG_DFL]
    previous = {number: signal.signal(number, end) for number in handled}
    hook, sys.unraisablehook = sys.unraisablehook, _resending_hook(sys.unraisablehook)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for number, handler in previous.items():
            signal.signal(number, handler)


def _resending_hook(hook: Unraisable) -> Unraisable:
    """Return a hook that resends a signal if Python discards the exception of its handler.

    Exceptions in finalizers and weak reference callbacks are discarded, and those may run at any
    bytecode of the main thread.
    """
    from tofuse.engine.errors import Ended

    def resend(number: int) -> None:
        sleep(0.01)  # until the main thread has left the finalizer
        if hasattr(signal, "pthread_kill"):  # interrupts blocking calls of the main thread
            signal.pthread_kill(threading.main_thread().ident or 0, number)
        else:
            signal.raise_signal(number)

    def on_unraisable(error: sys.UnraisableHookArgs) -> None:
        if isinstance(error.exc_value, KeyboardInterrupt | Ended):
            number = getattr(error.exc_value, "number", int(signal.SIGINT))
            # `threading.Thread` takes locks that the main thread may hold at this point.
            _thread.start_new_thread(resend, (number,))
        else:
            hook(error)

    return on_unraisable


def report_bugs(command: Callable[[], int]) -> int:
    """Return the exit status of a command; a bug in the program is reported in one line."""
    try:
        return command()
    except Exception as error:
        if os.environ.get("TOFUSE_TRACEBACK"):
            raise
        _print_error(
            f"bug in the program ({type(error).__name__}: {error}); please report it, with the "
            "traceback that TOFUSE_TRACEBACK=1 prints"
        )
        return 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""

    def command() -> int:
        from tofuse.apps.cli.machine import check_machine
        from tofuse.apps.cli.parser import make_parser

        try:
            arguments = make_parser().parse_args(argv)
        except SystemExit as stop:  # help or an error has been printed
            raise SystemExit(_status_after_output(int(stop.code or 0), None)) from None
        check_machine(getattr(arguments, "threads", None))
        out = getattr(arguments, "out", None)
        with _edits_accepted(getattr(arguments, "edited", False)), _repeatable(out):
            status: int = arguments.command(arguments)
        return _status_after_output(status, out)

    return run_command(command)


def _edits_accepted(accepted: bool) -> AbstractContextManager[None]:
    if not accepted:
        return nullcontext()
    from tofuse.apps.results import integrity

    return integrity.accepting_edits()


@contextmanager
def _repeatable(out: Path | None) -> Iterator[None]:
    """Add to an interruption of a command with an output that repeating it starts again.

    Not where the command has added a note itself, nor where a run has left its tracked frames.
    """
    from tofuse.engine.errors import Ended

    try:
        yield
    except (KeyboardInterrupt, Ended) as error:
        from tofuse.apps.results import folders

        noted = bool(getattr(error, "__notes__", ()))
        if out is not None and not noted and not (out / folders.TRACKED).exists():
            error.add_note("the same command starts again from the beginning")
        raise


def _status_after_output(status: int, out: object) -> int:
    """The exit status of a finished command, after its output was flushed."""
    sys.stdout.flush()
    error = getattr(sys.stdout, "error", None)
    if error is None:
        return status
    if out is not None:
        _print_error(f"some output could not be printed ({_reason(error)}); the result is in {out}")
        return status
    if isinstance(error, BrokenPipeError):
        return _BROKEN_PIPE
    _print_error(f"standard output: can't be written ({_reason(error)})")
    return 2


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()


def _print_error(text: str) -> None:
    print("tofuse: " + " ".join(text.split()), file=sys.stderr)


def run_command(command: Callable[[], int]) -> int:
    """Return the exit status of a command; errors are printed in one line."""
    from tofuse.apps.cli.streams import safe_streams
    from tofuse.engine.errors import Ended, TofuseError, on_command_line, signals_as_themselves

    with safe_streams(), on_command_line():
        try:
            with signals_as_themselves():
                return command()
        except TofuseError as error:
            _print_error(str(error))
            return 2
        except KeyboardInterrupt as error:
            _print_error("; ".join([_INTERRUPTED, *getattr(error, "__notes__", ())]))
            return 130
        except Ended as error:
            _print_error("; ".join([_TERMINATED, *getattr(error, "__notes__", ())]))
            return 128 + error.number
        except OSError as error:
            # Not converted to a TofuseError where it occurred.
            where = f"{error.filename}: " if error.filename else ""
            _print_error(f"{where}{error.strerror or error}")
            return 2
        except MemoryError:
            _print_error(_MEMORY)
            return 2
        except RecursionError:
            _print_error("an input file is nested too deeply; check the files")
            return 2
        except RuntimeError as error:
            if "start new thread" not in str(error):
                raise
            _print_error("can't start more threads; use --threads 1, or allow more (ulimit -u)")
            return 2
        except ImportError as error:
            _print_error(
                f"a part of the program can't be loaded ({error}); is it installed whole, and is "
                "there enough memory, and enough file handles (ulimit -n)?"
            )
            return 2
