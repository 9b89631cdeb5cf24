"""Results compared with a reference, or with each other: `tofuse compare` and `tofuse repeat`.

`compare` registers a result to a CAD model, a mesh or another result and maps its deviations. Each
has a standard deviation, by which places and regions pass, fail or stay undecided. `repeated` does
so for results of the same place, and separates the variance within sessions from that between.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.compare.comparing import Comparison, compare, millimetres
    from tofuse.apps.compare.job import (
        CompareOptions,
        RepeatOptions,
        compare_exit_status,
        compare_files,
        repeat_files,
    )
    from tofuse.apps.compare.repeating import Repetition

__getattr__, __dir__, __all__ = face(__name__, __file__)
