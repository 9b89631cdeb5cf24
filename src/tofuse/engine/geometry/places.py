"""Places visited by a camera, and the number of visits."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tofuse.engine.arrays import Float64


@dataclass
class PlaceCounts:
    """Thins the images of a camera that stays at a place or returns to it often.

    A place is a cell of positions and viewing directions. All of the first `images_per_place`
    images of a place are kept, then every second one of twice as many, every fourth one of four
    times as many, and so on: their number grows with the logarithm of the time that the camera is
    there.

    Parameters
    ----------
    angle, distance
        Size of a cell: rad, and fraction of the depth.
    images_per_place
        Number of images of a place of which all are kept.
    """

    angle: float
    distance: float
    images_per_place: int
    _count: dict[bytes, int] = field(default_factory=dict, init=False, repr=False)

    def keeps(self, depth: float, T_component_camera: Float64, component: int = 0) -> bool:
        """Count the next image, and return whether it is kept.

        Parameters
        ----------
        depth
            Median depth of the image, m.
        T_component_camera
            (4, 4) pose in the frame of its component.
        component
            Number of the component: positions in different ones are not comparable.
        """
        # Not the depth itself, which changes with every image.
        octave = round(math.log2(max(depth, 1e-3)))
        T, size = T_component_camera, self.distance * 2.0**octave
        # A component begins at the centre of a cell: a camera that stays there is in one place.
        cell = np.rint(np.concatenate([T[:3, 3] / size, T[:3, 2] / self.angle]))
        place = np.append(cell, [octave, component]).astype(np.int64).tobytes()
        count = self._count.get(place, 0)
        self._count[place] = count + 1
        every = 1 << int(math.log2(count / self.images_per_place + 1))
        return count % every == 0
