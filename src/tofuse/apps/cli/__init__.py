"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.cli.commands import print_result
    from tofuse.apps.cli.program import console
    from tofuse.apps.cli.progress import TerminalProgress, progress_for

__getattr__, __dir__, __all__ = face(__name__, __file__)
