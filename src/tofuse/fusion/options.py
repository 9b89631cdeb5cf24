"""How views become one model."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fusion:
    """How the model is made: the cloud, and for images the surface.

    Attributes
    ----------
    voxel_m
        Edge of a voxel; None chooses the distance between neighbouring pixels at the median
        depth, which keeps what the sensor resolved, or 0.4 % of that depth if that is more.
    min_views
        What fewer frames saw is left out.
    normal_neighbours
        Points in the plane fit of each normal, for clouds.
    reach
        How far before and behind a surface a view speaks of it, voxels; more where the noise asks
        for it.
    island
        Pieces of surface with fewer vertices are left out.
    memory_mb
        Most memory for the voxels: where it does not do, the model is made region by region, with
        the same result. Half as much may go to the views that are kept for it; what does not fit
        is on disk until it is fused.
    holes_m
        Holes in the surface with a border no longer than this are closed; 0 closes none.
    faces
        At most so many triangles; 0 keeps all. The cloud keeps all points.
    texture
        Edge of the texture of the surface, in texels; 0 makes none.
    """

    voxel_m: float | None = None
    min_views: int = 1
    normal_neighbours: int = 12
    reach: float = 3.0
    island: int = 100
    memory_mb: int = 600
    holes_m: float = 0.0
    faces: int = 0
    texture: int = 0

    def __post_init__(self) -> None:
        if self.voxel_m is not None and not 1e-5 < self.voxel_m < 100:
            raise ValueError(f"voxel_m is {self.voxel_m}; give metres, such as 0.01")
        if self.min_views < 1:
            raise ValueError(f"min_views is {self.min_views}, not 1 or more")
        if not 3 <= self.normal_neighbours <= 1000:
            raise ValueError(f"normal_neighbours is {self.normal_neighbours}, not 3 to 1000")
        if not 1.5 <= self.reach <= 100:
            raise ValueError(f"reach is {self.reach}, not 1.5 to 100 voxels")
        if self.island < 0:
            raise ValueError(f"island is {self.island}, not 0 or more")
        if not 0 <= self.holes_m < 1e6:
            raise ValueError(f"holes_m is {self.holes_m}, not 0 or more")
        if self.faces < 0:
            raise ValueError(f"faces is {self.faces}, not 0 or more")
        if self.texture and not 64 <= self.texture <= 8192:
            raise ValueError(f"texture is {self.texture}, not 0 or 64 to 8192")
        if not 1 <= self.memory_mb <= 1_000_000:
            raise ValueError(f"memory_mb is {self.memory_mb}, not 1 or more")
