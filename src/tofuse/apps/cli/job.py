"""One job of a batch: `tofuse run` and a thumbnail of its model, as a child process.

    python -m tofuse.apps.cli.job PICTURE INPUT --out DIR ...

It is killed when its standard input closes: without its parent, another worker may be doing the
same job, and can go on after its tracking. The last lines on standard output are JSON: the result
as `tofuse run --json` prints it, and facts for the batch.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence

_PICTURE_SIZE = (336, 210)  # pixels


def main(arguments: Sequence[str]) -> int:
    """Run the job and return the exit status of `tofuse run`.

    Parameters
    ----------
    arguments
        Path of the thumbnail, then the arguments of `tofuse run`.
    """
    from tofuse.apps.cli.program import ended_by_signals, prepare_process, report_bugs, run_command

    prepare_process()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with ended_by_signals():
        return report_bugs(lambda: run_command(lambda: _job(arguments[0], arguments[1:])))


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    if sys.platform == "win32":
        os._exit(137)
    else:
        os.kill(os.getpid(), signal.SIGKILL)


def _job(picture: str, run_arguments: Sequence[str]) -> int:
    from tofuse.apps.cli.commands import print_result, run_options
    from tofuse.apps.cli.options import Run
    from tofuse.apps.cli.parser import make_parser
    from tofuse.apps.cli.progress import QuietProgress, emit
    from tofuse.apps.jobs import exit_status, run
    from tofuse.apps.report import scene, thumbnails
    from tofuse.formats.files import atomic

    arguments = Run(**vars(make_parser().parse_args(["run", *run_arguments])))
    with QuietProgress() as progress:
        result = run(arguments.inputs, run_options(arguments), progress)
    rows = {record.index: k for k, record in enumerate(result.diagnostics.frames)}
    atomic.write_bytes(
        picture,
        thumbnails.encode(scene.render(scene.make_scene(result, rows), _PICTURE_SIZE), jpeg=True),
    )
    print_result(result, arguments.out, as_json=True)
    emit({"posed": int(result.has_pose.sum()), "peak_bytes": _peak_bytes()})
    return exit_status(result)


def _peak_bytes() -> int | None:
    """Peak memory of this process; None where the system does not report it."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
