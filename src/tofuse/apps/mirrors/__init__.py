"""Mirrors in a finished model: found, reported, and the rooms behind them cut out.

A mirror looks like an opening in a plane (`openings`), behind which every view measures what the
reflection of the room predicts (`reflection`). A doorway is an opening, too, but the room behind it
is another one.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.mirrors.finding import find_mirrors, sentences

__getattr__, __dir__, __all__ = face(__name__, __file__)
