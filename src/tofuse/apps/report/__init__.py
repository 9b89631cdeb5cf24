"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.report import plots, thumbnails
    from tofuse.apps.report.extras import ReportExtras
    from tofuse.apps.report.html import page, write_report
    from tofuse.apps.report.pair import write_pair_report
    from tofuse.apps.report.pair_words import decision, lines
    from tofuse.apps.report.plots import (
        AFTER,
        BAD,
        BEFORE,
        GRID,
        INK,
        MUTED,
        REFERENCE,
        make_figure,
        svg,
    )
    from tofuse.apps.report.policy import script_hashes
    from tofuse.apps.report.scene import make_scene, render, render_thumbnail
    from tofuse.apps.report.thumbnails import (
        data_uri,
        depth_image,
        depth_limits,
        encode,
        grey,
        subsample,
        viridis,
    )
    from tofuse.apps.report.words import length

__getattr__, __dir__, __all__ = face(__name__, __file__)
