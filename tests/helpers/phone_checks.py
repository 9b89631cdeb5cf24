"""Checks of a phone's recording."""

from __future__ import annotations

import numpy as np

import made_phones as made
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import Recording


def check_frames(recording: Recording, *, turned: bool = False, exact: float = 6e-4) -> None:
    """Compare depth, confidence, colour and poses with the written ones."""
    assert len(recording) == 3
    np.testing.assert_allclose(recording.reference, made.POSES, atol=1e-9)
    for k, frame in enumerate(recording):
        truth = made.DEPTH[k].T if turned else made.DEPTH[k]
        np.testing.assert_allclose(frame.depth, truth, atol=exact)
        assert not frame.valid[0, 0]
        if frame.confidence_image is not None:
            sure = made.CONFIDENCE[k].T if turned else made.CONFIDENCE[k]
            np.testing.assert_array_equal(frame.confidence_image, sure)
            assert recording.metadata["confidence_max"] == 2
        if frame.color_image is not None:
            red, blue = frame.color_image[..., 0], frame.color_image[..., 2]
            middle = red.shape[1] // 2
            assert abs(int(red[5, middle - 3]) - (100 + 40 * k)) < 8
            assert blue[5, middle + 2] > 190
            assert blue[5, middle - 3] < 10
            assert frame.color_registered


def check_lens(frame: RangeFrame, fx: float, cx: float, cy: float) -> None:
    """A pixel of depth is 60 pixels wide in the image of the intrinsics."""
    camera = frame.camera
    assert isinstance(camera, Pinhole)
    v, u = 7, 11
    x = ((u + 0.5) * 60 - 0.5 - cx) / fx
    y = ((v + 0.5) * 60 - 0.5 - cy) / fx
    np.testing.assert_allclose(camera.rays()[v, u], [x, y], rtol=1e-5)
