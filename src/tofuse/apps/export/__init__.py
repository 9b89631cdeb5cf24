"""A result in the formats of other programs: `tofuse export`.

Clouds, surfaces and trajectories are converted from the files of the result; data sets of
nerfstudio and COLMAP, recordings of Rerun and Foxglove, and grids for planners also need the frames
of its recording.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.export.exporting import export

__getattr__, __dir__, __all__ = face(__name__, __file__)
