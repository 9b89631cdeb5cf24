"""What the 3D view can colour the model by, beside its own colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.fusion.pose_errors import UNKNOWN_M
from tofuse.report import words
from tofuse.report.scene import Scene, base64_of, height_range

Float64 = NDArray[np.float64]

# Of normally distributed errors, one in twenty exceeds so many standard deviations.
OF_95_PERCENT = 1.96


@dataclass(frozen=True, eq=False)
class Field:
    """A value of every point (K,) and of every vertex of the mesh (V,) that is shown.

    Attributes
    ----------
    low, high
        Values at the two ends of the colour bar; what is beyond has the colour of that end.
    said
        What is written at these ends.
    """

    name: str
    label: str
    points: Float64
    vertices: Float64
    low: float
    high: float
    said: tuple[str, str]

    def packed(self) -> dict[str, Any]:
        """Return the field for the viewer: values as bytes between the ends of the bar."""
        return {
            "label": self.label,
            "said": self.said,
            "points": base64_of(self._bytes(self.points)),
            "vertices": base64_of(self._bytes(self.vertices)),
        }

    def _bytes(self, values: Float64) -> NDArray[np.uint8]:
        share = (values - self.low) / max(self.high - self.low, 1e-9)
        # What is not known has the colour of what is worst.
        return np.round(255 * np.clip(np.nan_to_num(share, nan=1.0), 0, 1)).astype(np.uint8)


def fields(scene: Scene) -> list[Field]:
    """Return what the scene can be coloured by: height always, and what its points know."""
    out = [_height(scene)]
    mesh = scene.mesh
    if scene.sigma is not None:
        vertices = np.zeros(0) if mesh is None else OF_95_PERCENT * mesh.sigma.astype(float)
        out.append(_accuracy(OF_95_PERCENT * scene.sigma.astype(float), vertices))
    if scene.views is not None:
        vertices = np.zeros(0) if mesh is None else mesh.views.astype(float)
        points = scene.views.astype(float)
        low, high = _ends(points, vertices)
        said = (f"{low:.0f}", f"{high:.0f}")
        out.append(Field("views", "Number of views", points, vertices, low, high, said))
    return out


def _height(scene: Scene) -> Field:
    vertices = np.zeros(0) if scene.mesh is None else -scene.mesh.vertices[:, 1].astype(float)
    points = -scene.points[:, 1]
    low, high = height_range(scene.points) if len(points) else _ends(points, vertices)
    said = (words.length(0.0), words.length(high - low))
    return Field("height", "Height", points, vertices, low, high, said)


def _accuracy(points: Float64, vertices: Float64) -> Field:
    low, high = _ends(points, vertices)
    unknown = high >= UNKNOWN_M
    if unknown:  # what the others differ by is still to be seen
        low, high = _ends(points[points < UNKNOWN_M], vertices[vertices < UNKNOWN_M])
    said = (f"±{words.length(low)}", f"±{words.length(high)}{' or not constrained' * unknown}")
    return Field("accuracy", "Accuracy (95 %)", points, vertices, low, high, said)


def _ends(points: Float64, vertices: Float64) -> tuple[float, float]:
    """Values that bound the middle 96 % of the vertices, or of the points where there are none."""
    values = vertices if len(vertices) else points
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    low, high = np.percentile(values, [2, 98])
    return float(low), float(high)
