"""noise.json: the noise model of a camera."""

from __future__ import annotations

import json
from pathlib import Path

from tofuse.engine.errors import InputError
from tofuse.engine.noise import NoiseModel
from tofuse.formats.files import atomic, reading


def write_noise(path: str | Path, model: NoiseModel) -> None:
    """Write a noise.json; raise OutputError if that's impossible."""
    atomic.write_text(path, json.dumps(model.to_dict(), indent=1) + "\n")


def read_noise(path: str | Path) -> NoiseModel:
    """Read a noise.json; raise InputError if it can't be read, or is invalid."""
    try:
        data = json.loads(reading.read_text(path, limit=1 << 20))
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"is broken JSON ({error})", where=path, remedy="write it again by `tofuse noise`"
        ) from error
    return NoiseModel.from_dict(data, where=str(path))
