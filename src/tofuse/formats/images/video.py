"""Frames of a video, as OpenCV decodes them."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import UInt8
from tofuse.engine.errors import InputError

MAX_SIDE = 8192


class Video:
    """A video with random access to its frames; fast if they are read in order.

    Attributes
    ----------
    width, height, count
        As its header declares.

    Raises
    ------
    InputError
        If it can't be opened.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        self.path = path
        self._lock = threading.Lock()
        self._next = 0
        try:
            self._capture: Any = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
            # The orientation that a phone states would turn images relative to their depth.
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
            get = self._capture.get
            self.width, self.height = (
                int(get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
            )
            self.count = int(get(cv2.CAP_PROP_FRAME_COUNT))
            usable = self._capture.isOpened()
        except (cv2.error, ValueError, OverflowError):
            usable = False
        if not usable or not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            raise InputError(
                "is not a video that can be decoded", where=path, remedy="copy it again"
            )

    def read(self, index: int) -> UInt8:
        """Return frame `index` as (H, W, 3) RGB; InputError if it can't be decoded."""
        import cv2

        with self._lock:
            try:
                if index != self._next:
                    self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
                ok, image = self._capture.read()
            except cv2.error:
                ok, image = False, None
            self._next = index + 1 if ok else -1
        if not ok or image is None or image.ndim != 3:
            raise InputError(f"frame {index} can't be decoded", where=self.path)
        return np.ascontiguousarray(image[..., ::-1])
