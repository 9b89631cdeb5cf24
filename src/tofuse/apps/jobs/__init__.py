"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.jobs.evaluating import Evaluation, evaluate
    from tofuse.apps.jobs.judging import JudgeOptions, judge_files, sentence
    from tofuse.apps.jobs.merging import MergeOptions, check_result, merge, merge_files
    from tofuse.apps.jobs.pair import PairOptions, pair_exit_status, register_files
    from tofuse.apps.jobs.report_files import write_report_files
    from tofuse.apps.jobs.run_options import Options, resolve
    from tofuse.apps.jobs.running import exit_status, quick_findings, run, with_findings

__getattr__, __dir__, __all__ = face(__name__, __file__)
