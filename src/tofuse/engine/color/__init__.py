"""Colour images at their full resolution as measurements of the motion between frames.

A `ColorView` has distinctive patches of an image with the planes that they lie on; `measured_pairs`
finds them in other images, and returns the motions that the reprojections measure. `with_color`
adds these to a pose graph.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.color.color_pairs import measured_pairs, with_color
    from tofuse.engine.color.color_views import ColorView

__getattr__, __dir__, __all__ = face(__name__, __file__)
