"""Reader of the ASCII export of MESA's SwissRanger SR4000."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.formats.files import reading, tables
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, pixels

FRAME_RATE_HZ = 32.0
# Modulated at 30 MHz, the factory default.
AMBIGUITY_M = 5.0
# The export measures Z from about 1 cm in front of the optical centre; nearer points can't be
# measured and don't determine a ray.
NEAREST_M = 0.01

_BLOCKS = {
    "calibrated distance": "z",
    "calibrated xvector": "x",
    "calibrated yvector": "y",
    "amplitude": "amplitude",
    "confidence map": "confidence",
}
_TAIL = 16384
_TIME = re.compile(rb"%[^\n]*time stamp \[ms\][^\n]*\n\s*([0-9.eE+-]+)", re.IGNORECASE)


@part("reader", "sr4000", label="validated")
class Sr4000(Reader):
    """SwissRanger SR4000: folders of .dat files of MESA's ASCII export."""

    joinable = True

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = _files(path)
        if any(b"calibrated distance" in reading.read_head(f, 256).lower() for f in files[:3]):
            return Sniff(1.0, f"{len(files)} .dat files of a SwissRanger")
        return None

    def open(self, path: Path, options: ReaderOptions) -> Sr4000Source:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "sr4000")
        remedy = "pass the export's folder"
        return Sr4000Source(inputs.required(_files(path), ".dat files", path, remedy))


def _files(path: Path) -> list[Path]:
    return inputs.files_at(path, ".dat")


class Sr4000Source(FileSource):
    """Frames whose ray tables reproduce the camera's vectors exactly.

    The file's axes point left and up, and are converted. The rays meet about 1 cm behind the
    origin, so that x/z of a pixel depends slightly on z: each frame has its own table, with which
    `frame.points` equals the vectors of the file.
    """

    amplitude_kind = "range_compensated"
    ambiguity_m = AMBIGUITY_M

    def __init__(self, files: list[Path]) -> None:
        self.files = files
        super().__init__(np.zeros(len(files)))
        self._read_timestamps()
        self.metadata |= {
            "sensor": "MESA SR4000",
            "confidence_max": 7.0,
            "frame_rate_hz": FRAME_RATE_HZ,
            "depth_kind": "z",
            "amplitude_kind": "range_compensated",
            "ambiguity_m": AMBIGUITY_M,
        }

    def _read_timestamps(self) -> None:
        times = np.array([_time_stamp(path) for path in self.files])
        missing = int((~np.isfinite(times)).sum())
        if missing == len(times):
            self.warnings.append(f"no timestamps: a frame rate of {FRAME_RATE_HZ} Hz is assumed")
            self.timestamps = np.arange(len(times)) / FRAME_RATE_HZ
            return
        if missing:
            self.warnings.append(
                f"{quantities.count(missing, 'frame')} without a timestamp: interpolated"
            )
        times = inputs.interpolated(times)
        # Frames stay in sequence where the camera's counter restarts.
        if (np.diff(times, prepend=times[0]) < 0).any():
            self.warnings.append("timestamps decrease; frames stay in the order of files")
        self.timestamps = times

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        path = self.files[index]
        blocks = _read_blocks(path)
        z = blocks["z"]
        valid = (z >= NEAREST_M) & (z < se3.MAX_COORDINATE_M)  # false for NaN, too
        valid &= np.isfinite(blocks["x"]) & np.isfinite(blocks["y"])
        if valid.sum() < 16:
            raise InputError("has no valid distances", where=path)
        depth = np.where(valid, z, 0)
        safe = np.where(valid, z, np.nan)
        rays = np.stack([-blocks["x"] / safe, -blocks["y"] / safe], -1)
        confidence = blocks.get("confidence")
        amplitude = blocks.get("amplitude")
        if confidence is not None:
            confidence = np.clip(np.nan_to_num(confidence), 0, 255).astype(np.uint8)
        return self.image(
            index,
            depth.astype(np.float32),
            camera=RayTable(rays.astype(np.float32)),
            amplitude_image=None if amplitude is None else pixels.finite_float32(amplitude),
            confidence_image=confidence,
        )


def _time_stamp(path: Path) -> float:
    """Timestamp in s from the last lines of a file; NaN if there is none."""
    if not reading.is_file(path):  # reading a FIFO would block, a device never end
        return float("nan")
    try:
        with path.open("rb") as file:
            file.seek(0, 2)
            file.seek(max(0, file.tell() - _TAIL))
            match = _TIME.search(file.read(_TAIL))
        return float(match.group(1)) / 1000 if match else float("nan")
    except (OSError, ValueError):
        return float("nan")


def _read_blocks(path: Path) -> dict[str, Float64]:
    """Return the (H, W) blocks of a file by short name."""
    blocks: dict[str, Float64] = {}
    for section in tables.plain_nan(reading.read_text(path)).split("%")[1:]:
        title, _, body = section.partition("\n")
        name = _BLOCKS.get(title.strip().lower())
        if name is None:
            continue
        try:
            numbers = np.array([float(cell) for cell in body.split()])
        except ValueError as error:
            raise InputError(
                f"is damaged in the block {title.strip()!r} ({error})", where=path
            ) from error
        width = len(body.partition("\n")[0].split())
        if width < 2 or len(numbers) % width or len(numbers) < 2 * width:
            raise InputError(f"is cut off in the block {title.strip()!r}", where=path)
        blocks[name] = numbers.reshape(-1, width)
    missing = [title for title, name in _BLOCKS.items() if name in "xyz" and name not in blocks]
    if missing:
        raise InputError(
            f"has no block {missing[0]!r}", where=path, remedy="export the frame again"
        )
    if len({block.shape for block in blocks.values()}) > 1:
        raise InputError("has blocks of different sizes (cut off)", where=path)
    return blocks
