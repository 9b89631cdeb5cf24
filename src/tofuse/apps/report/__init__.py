"""`report.html`: a result as one page for a human reader, without external resources.

`write_report` collects the values of each section, which a template turns into HTML. Its parts
serve other pages, too: charts and plans that follow the page's theme, images as data URIs, the
content of the 3D view as compressed arrays, and numbers in words.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.report import fields, html, plots, scene, session_words, thumbnails, words
    from tofuse.apps.report.extras import ReportExtras
    from tofuse.apps.report.sections import write_report

__getattr__, __dir__, __all__ = face(__name__, __file__)
