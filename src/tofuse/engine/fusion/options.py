"""Options of fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tofuse.engine.bounds import Bounded, Bounds


@dataclass(frozen=True)
class Fusion(Bounded):
    """How posed views are fused into a model: a cloud, and for images a surface.

    Attributes
    ----------
    voxel_m
        Edge of a voxel, m; None chooses the distance between neighbouring pixels at the median
        depth, which keeps the resolution of the sensor, or 0.4 % of that depth if that is more,
        and doubles or halves it for much farther or nearer surfaces if that saves half of them.
    min_views
        Minimum number of frames that observed a point of the model.
    island
        Connected pieces of the surface with fewer vertices are removed: more against debris, fewer
        to keep small objects.
    memory_mb
        Maximum memory for the voxels: beyond it, the model is fused region by region, with the
        same result. A tenth as much may be used for stored views; those that do not fit are on
        disk until they are fused.
    faces
        Maximum number of triangles, slightly exceeded if so few left no surface; 0 keeps all. The
        cloud keeps all points.
    texture
        Maximum edge of the texture of the surface, in texels: 64 to 8192, or 0 for none.
    """

    voxel_m: Annotated[float | None, Bounds(1e-5, 100, exclusive=True)] = None
    min_views: Annotated[int, Bounds(1)] = 1
    island: Annotated[int, Bounds(0)] = 100
    memory_mb: Annotated[int, Bounds(1, 1_000_000)] = 600
    faces: Annotated[int, Bounds(0)] = 0
    texture: int = 2048

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.texture and not 64 <= self.texture <= 8192:
            raise ValueError(f"texture is {self.texture}, not 0 or 64 to 8192")
