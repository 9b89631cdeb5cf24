"""Values by which the 3D view can colour the model, in addition to its colours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.apps.report.packing import pack
from tofuse.apps.report.scene import Scene
from tofuse.apps.report.thumbnails import percentile_range
from tofuse.engine.arrays import Float64
from tofuse.engine.fusion import UNKNOWN_M
from tofuse.engine.normal import OF_95_PERCENT
from tofuse.engine.quantities import length

# Accuracies are stored as bytes on a logarithmic scale from 0.1 mm on, in steps of 4.9 %.
_MIN_ACCURACY_M = 1e-4


@dataclass(frozen=True, eq=False)
class Field:
    """A value of every point shown, or of every vertex of the surface.

    Attributes
    ----------
    name, label
        Identifier, and title of the colour bar.
    values
        (K,).
    low, high
        Values at the ends of the colour bar, at which colours are clamped.
    labels
        Tick labels at the lower end, in the middle and at the upper end.
    span
        Values that the bytes 0 and 255 represent.
    logarithmic
        Whether the scale is logarithmic.
    """

    name: str
    label: str
    values: Float64
    low: float
    high: float
    labels: tuple[str, str, str]
    span: tuple[float, float]
    logarithmic: bool = False

    def packed(self) -> dict[str, Any]:
        """Return the field for the viewer: values as bytes, and the ends of the colour bar."""
        return {
            "label": self.label,
            "labels": self.labels,
            "ends": [float(self.normalized(np.array(end))) for end in (self.low, self.high)],
            "span": self.span,
            "values": pack(np.round(255 * self.normalized(self.values)).astype(np.uint8)),
        }

    def normalized(self, values: Float64) -> Float64:
        """Return values as fractions of the span, 0 to 1; 1 where unknown."""
        low, high = self.span
        if self.logarithmic:
            values, low, high = np.log(np.maximum(values, low)), np.log(low), np.log(high)
        fraction: Float64 = (values - low) / max(high - low, 1e-9)
        return np.clip(np.nan_to_num(fraction, nan=1.0), 0, 1)


def fields(scene: Scene, errors: Float64 | None = None) -> list[Field]:
    """Return the fields of a scene: height, and those that its points have values for.

    Parameters
    ----------
    scene
        The scene.
    errors
        (N,) 95 % bounds in m of camera centres, which have the same colour scale as accuracies.
    """
    mesh = scene.mesh
    points = scene.points if mesh is None else mesh.vertices.astype(float)
    sigma = scene.sigma if mesh is None else mesh.sigma
    views = scene.views if mesh is None else mesh.views
    available = [] if sigma is None else [accuracy(OF_95_PERCENT * sigma.astype(float), errors)]
    low, high = percentile_range(-points[:, 1])
    ticks = length(0.0), length((high - low) / 2), length(high - low)
    available.append(Field("height", "Height", -points[:, 1], low, high, ticks, (low, high)))
    if views is not None:
        counts = views.astype(float)
        low, high = percentile_range(counts)
        ticks = f"{low:.0f}", "", f"{high:.0f}"
        available.append(Field("views", "Number of views", counts, low, high, ticks, (low, high)))
    return available


def accuracy(values: Float64, errors: Float64 | None = None) -> Field:
    """Return the field of accuracies, on a logarithmic scale.

    Parameters
    ----------
    values
        (K,) 95 % bounds, m.
    errors
        (N,) 95 % bounds of camera centres, m, which have the same colour scale.
    """
    max_bound = OF_95_PERCENT * UNKNOWN_M
    low, high = percentile_range(values[values < UNKNOWN_M])  # so that these can be distinguished
    if errors is not None and (errors < UNKNOWN_M).any():
        error_range = percentile_range(errors[errors < UNKNOWN_M])
        low, high = min(low, error_range[0]), max(high, error_range[1])
    low = max(low, _MIN_ACCURACY_M)
    high = max(high, 1.01 * low)
    suffix = " or not constrained" if (values >= UNKNOWN_M).mean() > 0.001 else ""
    middle = float(np.sqrt(low * high))
    labels = (
        f"±{length(low)}", f"±{length(middle)}", f"±{length(high)}{suffix}"
    )  # fmt: skip
    span = (_MIN_ACCURACY_M, max_bound)
    return Field("accuracy", "Accuracy (95 %)", values, low, high, labels, span, logarithmic=True)
