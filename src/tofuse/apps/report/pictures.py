"""The samples of frames as image files: range, amplitude, colour, and use of pixels."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tofuse.apps.report.thumbnails import (
    NO_MEASUREMENT,
    REMOVED,
    encode,
    grey,
    percentile_range,
    viridis,
)
from tofuse.engine.compute import run_all
from tofuse.engine.quality import frame_samples
from tofuse.engine.quality import frame_samples as samples

# Kinds of images, in the order in which they are shown, and their titles.
KINDS = {"color": "Colour", "range": "Range", "amplitude": "Amplitude", "fate": "Use of pixels"}

# Colour and label of each use of a pixel.
FATES = {
    samples.KEPT: ((38, 150, 140), "in the model"),
    samples.TRACKED: ((236, 170, 60), "tracking only"),
    samples.REMOVED: (REMOVED, "removed by a filter"),
    samples.NOTHING: (NO_MEASUREMENT, "no measurement"),
}


@dataclass(frozen=True, eq=False)
class Pictures:
    """Images of one frame by kind (`KINDS`): JPEG, and PNG for the use of pixels."""

    index: int
    images: dict[str, bytes]

    def uri(self, kind: str) -> str:
        """Return an image as a data URI, which is empty if there is none of this kind."""
        data, name = self.images.get(kind), "png" if kind == "fate" else "jpeg"
        return f"data:image/{name};base64,{base64.b64encode(data).decode()}" if data else "data:,"


def depth_range(frames: Sequence[frame_samples.FrameSample]) -> tuple[float, float]:
    """Return the depths in m at the ends of the colour map, the same for all frames."""
    subsampled = [f.depth[::3, ::3] for f in frames]
    values = (
        np.concatenate([d[d > 0] for d in subsampled]) if subsampled else np.zeros(0, np.float16)
    )
    return percentile_range(values, min_width=1e-3)


def draw(frames: Sequence[frame_samples.FrameSample]) -> tuple[Pictures, ...]:
    """Render the samples of frames."""
    low, high = depth_range(frames)
    fate_colors = np.zeros((4, 3), np.uint8)
    for fate, (color, _) in FATES.items():
        fate_colors[fate] = color

    def render(frame: frame_samples.FrameSample) -> Pictures:
        depth = frame.depth.astype(float)
        picture = viridis((depth - low) / (high - low))
        picture[depth == 0] = NO_MEASUREMENT
        images = {} if frame.color is None else {"color": encode(frame.color, jpeg=True)}
        images["range"] = encode(picture, jpeg=True)
        if frame.amplitude is not None:
            images["amplitude"] = encode(grey(frame.amplitude), jpeg=True)
        images["fate"] = encode(fate_colors[frame.fate])
        return Pictures(frame.index, images)

    return tuple(run_all([partial(render, frame) for frame in frames]))
