"""Filter by a mask image."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar

import cv2
import numpy as np

from tofuse.engine.arrays import Bool
from tofuse.engine.bounds import Bounded, NotEmpty
from tofuse.engine.errors import InputError
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "mask")
@dataclass(frozen=True)
class Mask(Bounded, Filter):
    """Keep the pixels at which a mask image, one for the whole recording, is not black.

    Attributes
    ----------
    image
        Path of the image, of the size of the depth images.
    """

    image: Annotated[str, NotEmpty()]

    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`; InputError if the image can't be read, or has another size."""
        assert isinstance(frame, RangeFrame)
        modified = os.stat(self.image).st_mtime_ns if os.path.exists(self.image) else 0
        keep = _read(self.image, modified)
        if keep.shape != frame.depth.shape:
            rows, columns = frame.depth.shape
            raise InputError(
                f"is {keep.shape[1]} x {keep.shape[0]}, the depth images are {columns} x {rows}",
                where=self.image,
                remedy="use a mask of their size",
            )
        return keep


@lru_cache(maxsize=8)
def _read(path: str, modified: int) -> Bool:
    """Return the mask; a file that was modified is read again."""
    try:
        data = np.frombuffer(Path(path).read_bytes(), np.uint8)
    except OSError as error:
        raise InputError(
            f"can't be read ({error.strerror})", where=path, remedy="check the path of the mask"
        ) from error
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        raise InputError("is not an image", where=path, remedy="pass a PNG or JPEG")
    keep = image[..., :3].any(-1) if image.ndim == 3 else image != 0
    keep.setflags(write=False)
    return np.asarray(keep)
