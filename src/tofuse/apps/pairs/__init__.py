"""Registration of one pair of files: `tofuse register`.

`register_files` opens two views, moves them near the origin, registers them, and writes the pose,
the aligned cloud and a page that shows both views. A `PairResult` states the pose in the
coordinates of the files, with its uncertainty.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.pairs import pair_words
    from tofuse.apps.pairs.job import PairOptions, pair_exit_status, register_files
    from tofuse.apps.pairs.registering import register
    from tofuse.apps.pairs.result import PairResult, pair_json
    from tofuse.apps.pairs.views import named_view

__getattr__, __dir__, __all__ = face(__name__, __file__)
