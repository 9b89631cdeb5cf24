"""A source over depth PNGs of one camera, as in RGB-D data sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.images import check_first_size, read_color, read_image
from tofuse.geometry.cameras import Camera
from tofuse.recordings.camera_file import load_camera
from tofuse.recordings.depth_counts import depth_from_counts
from tofuse.recordings.frames import DepthKind, RangeFrame
from tofuse.recordings.reader import ReaderOptions
from tofuse.recordings.sources import FileSource


class DepthImageSource(FileSource):
    """Depth images, with colour images registered to them where given.

    Parameters
    ----------
    files
        16-bit PNGs, one for each frame.
    timestamps
        (N,) seconds.
    camera, depth_unit_m
        Of all frames, unless `options` has a camera.json, which replaces both.
    color
        None, or one image per frame, None where there is none.
    color_registered
        Whether colour is registered to depth.
    sensor
        Name of the camera, unless `options` has a camera.json that names it; empty if unknown.
    options
        Of the reader.

    Raises
    ------
    InputError
        If the camera does not have the size of the images.
    """

    concurrent = True

    def __init__(
        self,
        files: Sequence[Path],
        timestamps: Float64,
        camera: Camera | None,
        depth_unit_m: float,
        *,
        color: Sequence[Path | None] | None = None,
        color_registered: bool = True,
        sensor: str = "",
        options: ReaderOptions | None = None,
    ) -> None:
        super().__init__(timestamps)
        self.files, self.color = list(files), None if color is None else list(color)
        self.color_registered = color_registered
        kind: DepthKind = "z"
        where = "the camera of this format"
        if options is not None and options.camera is not None:
            description, camera = load_camera(options.camera)
            depth_unit_m, kind = description.depth_unit_m, description.depth_kind
            where, sensor = str(options.camera), description.sensor or sensor
        if camera is None:
            raise InputError(
                "has no camera", where=self.files[0].parent, remedy="pass one with --camera"
            )
        self.camera, self.depth_unit_m, self.depth_kind = camera, depth_unit_m, kind
        self.metadata |= {"depth_unit_m": depth_unit_m, "depth_kind": kind}
        if sensor:
            self.metadata["sensor"] = sensor
        self.note_missing_color(self.color or ())
        remedy = "pass the camera of these images with --camera"
        check_first_size(self.files, (camera.width, camera.height), where, remedy)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        size = (self.camera.width, self.camera.height)
        counts = read_image(self.files[index], size=size, dtype="uint16")
        color = None
        path = None if self.color is None else self.color[index]
        if path is not None:
            color = read_color(path)
            if color.shape[:2] != counts.shape:
                raise InputError(
                    f"is {color.shape[1]} x {color.shape[0]} pixels, depth {size[0]} x {size[1]}",
                    where=path,
                    remedy="register colour to depth, or leave it out",
                )
        return RangeFrame(
            index,
            float(self.timestamps[index]),
            self.camera,
            depth_from_counts(counts, self.depth_unit_m),
            self.depth_kind,
            color_image=color,
            color_registered=self.color_registered,
        )
