"""The output folder of a run, the same for everything that writes or reads a result.

`folders` knows which files belong to it and replaces an earlier result only as a whole; `run_json`
is the format of `run.json`; `integrity` says whether a result was edited; `reopening` opens the
recordings again that a result refers to. What `write_result` writes, `load_result` reads back.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.results import folders, integrity, reopening, run_json
    from tofuse.apps.results.loading import load_result, read_cloud, read_mesh, stated_accuracy
    from tofuse.apps.results.output import (
        CHANGE_COLORS,
        DISPLAY_FACES,
        QUALITY,
        TEXTURE_SIZE,
        textured_record,
        viridis,
        write_result,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
