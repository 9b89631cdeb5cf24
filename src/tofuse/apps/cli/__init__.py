"""The command line ``tofuse``: what a terminal needs around the jobs of the other rooms.

A command is a class of `options`, from which the parser and ``--help`` are made, and a function
that calls a job, shows its progress, and prints its result or one line that says what is wrong.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.cli import options
    from tofuse.apps.cli.commands import print_result, progress_unless_json, show
    from tofuse.apps.cli.program import console
    from tofuse.apps.cli.progress import progress_for, progress_in_python

__getattr__, __dir__, __all__ = face(__name__, __file__)
