"""A run and its result in the browser, served to this machine only.

`LiveView` shows the growing model while a run works; `ReportServer` serves the report of a result,
with the images of its recording at full resolution.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.viewer.live_map import LiveMap
    from tofuse.apps.viewer.live_view import LiveView
    from tofuse.apps.viewer.report_server import FrameImages, ReportServer, report_pages
    from tofuse.apps.viewer.server import address, serve, stop

__getattr__, __dir__, __all__ = face(__name__, __file__)
