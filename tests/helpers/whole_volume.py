"""A volume that is not divided into regions."""

from __future__ import annotations

from tofuse.engine.arrays import Float64
from tofuse.engine.fusion.layout import Layout
from tofuse.engine.fusion.range_view import Views
from tofuse.engine.fusion.tsdf import Volume


def volume_around(views: Views, poses: Float64, voxel_m: float) -> Volume:
    """The empty volume of all blocks near the surfaces of views at poses (N, 4, 4)."""
    layout = Layout.of(views, poses, voxel_m)
    return Volume.of(layout, layout.single_region())
