"""What the commands and the Python functions do, from input files to an output folder.

A job opens recordings, resolves the options, calls the engine and writes the result and its
report. `run` reconstructs a recording, `merging` joins the results of several runs, `judging`
assesses poses from another source, and `evaluate` compares poses with a reference.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.jobs import judging, locating, merging
    from tofuse.apps.jobs.evaluating import Evaluation, evaluate
    from tofuse.apps.jobs.report_files import write_report_files
    from tofuse.apps.jobs.run_options import Options, resolve
    from tofuse.apps.jobs.running import exit_status, quick_findings, run, with_findings

__getattr__, __dir__, __all__ = face(__name__, __file__)
