"""One job of a batch: `tofuse run` with a small picture of its model, for a parent process.

    python -m tofuse.cli.job PICTURE INPUT --out DIR ...

It ends at once when its standard input does: when its parent is gone, somebody else may be doing
the same job. What it has so far stays for them. The last lines on standard output are JSON: what
`tofuse run --json` tells of its result, and what only a batch asks for.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Sequence

_PICTURE = (336, 210)  # pixels


def main(words: Sequence[str]) -> int:
    """Run the job and return the exit status of its run."""
    from tofuse.cli import ended_by_signals, faults_told, prepare_process, told

    prepare_process()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with ended_by_signals():
        return faults_told(lambda: told(lambda: _job(words[0], words[1:])))


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    if sys.platform == "win32":
        os._exit(137)
    else:
        os.kill(os.getpid(), signal.SIGKILL)


def _job(picture: str, words: Sequence[str]) -> int:
    from tofuse.cli.commands import run_options, tell
    from tofuse.cli.parser import make_parser
    from tofuse.cli.progress import QuietProgress, emit
    from tofuse.files.atomic import write_bytes
    from tofuse.pipeline.run import exit_status, run
    from tofuse.report.images import encoded
    from tofuse.report.scene import make_scene, small

    arguments = make_parser().parse_args(["run", *words])
    with QuietProgress() as progress:
        result = run(arguments.inputs, run_options(arguments), progress)
    rows = {record.index: k for k, record in enumerate(result.diagnostics.frames)}
    write_bytes(picture, encoded(small(make_scene(result, rows), _PICTURE), jpeg=True))
    tell(result, arguments.out, as_json=True)
    emit({"posed": int(result.has_pose.sum()), "peak_bytes": _peak_bytes()})
    return exit_status(result)


def _peak_bytes() -> int | None:
    """Most memory that this process held; None where the system does not tell."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
