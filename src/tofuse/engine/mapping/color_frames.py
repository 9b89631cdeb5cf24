"""The colour of a recording at its full resolution, read again after tracking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tofuse.engine.arrays import UInt8
from tofuse.engine.color import ColorView
from tofuse.engine.frames import Frame, RangeFrame, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph import PoseGraph
from tofuse.engine.sensor import Corrector
from tofuse.engine.stored_views import Spacing, ViewStore

# Wider than for depth: colour constrains far pairs, and frames in between follow by depth.
_SPACING = Spacing(angle=0.08, distance=0.05, max_views=60)
_USUAL_RATE_HZ = 30.0


@dataclass(frozen=True)
class Unread:
    """A frame that is not read yet: enough to select it by its pose.

    Attributes
    ----------
    index
        Of the frame in its recording.
    depth
        Its typical range, m.
    """

    index: int
    depth: float


@dataclass(frozen=True, eq=False)
class ColorFrames:
    """Reads the colour of frames.

    Attributes
    ----------
    recording
        The recording, whose frames are numbered as in its source.
    correctors
        Of the errors of the camera.
    """

    recording: Recording
    correctors: Sequence[Corrector]

    def views(self, graph: PoseGraph, depths: Mapping[int, float]) -> list[ColorView]:
        """Return views of the frames of a graph that have colour, spaced by motion.

        `depths` are the typical radial ranges of frames with colour, by their index, m.
        """
        store: ViewStore[Unread] = ViewStore(_SPACING)
        for index, pose in zip(graph.ids.tolist(), graph.poses, strict=True):
            if depths.get(index, 0.0) > 0:
                store.push(Unread(index, depths[index]), pose)
        speeds = self._speeds(graph)
        chosen = np.array([item.index for item in store.views], np.intp)
        frames = replace(self.recording, indices=chosen)

        def view_of(frame: Frame) -> ColorView:
            assert isinstance(frame, RangeFrame)
            full = full_image(self.recording, frame)
            color = frame.color_image if full is None else full
            assert color is not None
            for corrector in self.correctors:
                frame = corrector.apply(frame)
            assert isinstance(frame, RangeFrame)
            return ColorView.of(frame, color, speeds[frame.index])

        # Frames that are no longer readable have no view.
        return [view for _, view in frames.read_with(view_of) if view is not None]

    def _speeds(self, graph: PoseGraph) -> dict[int, tuple[float, float]]:
        """Return the speeds of the camera, m/s and rad/s, by frame index."""
        times = self.recording.source.timestamps[graph.ids]
        if not self.recording.has_timestamps:
            times = times / _USUAL_RATE_HZ
        steps = np.abs(se3.log(se3.inverse(graph.poses[:-1]) @ graph.poses[1:])).reshape(-1, 2, 3)
        rates = np.linalg.norm(steps, axis=2) / np.maximum(np.diff(times), 1e-3)[:, None]
        rates = np.concatenate([rates[:1], rates, rates[-1:], np.zeros((2, 2))])[: len(times) + 1]
        around = np.maximum(rates[:-1], rates[1:])
        return {
            int(k): (float(m), float(rad)) for k, (m, rad) in zip(graph.ids, around, strict=True)
        }


def full_image(
    recording: Recording, frame: RangeFrame, most_pixels: int | None = None
) -> UInt8 | None:
    """Return the colour of a frame as recorded, if it is finer than that at the depth's size.

    Reduced to at most so many pixels.
    """
    image = recording.full_color(frame)
    if image is None or most_pixels is None:
        return image
    step = int(np.ceil(np.sqrt(image.shape[0] * image.shape[1] / max(most_pixels, 1))))
    if step == 1:
        return image
    size = (image.shape[1] // step, image.shape[0] // step)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
