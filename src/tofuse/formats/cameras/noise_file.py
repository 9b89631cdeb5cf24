"""noise.json: the noise model of a camera."""

from __future__ import annotations

import json
from pathlib import Path

from tofuse.engine.noise import NoiseModel
from tofuse.formats.files import atomic, json_data


def write_noise(path: str | Path, model: NoiseModel) -> None:
    """Write a noise.json; raise OutputError if that's impossible."""
    atomic.write_text(path, json.dumps(model.to_dict(), indent=1) + "\n")


def read_noise(path: str | Path) -> NoiseModel:
    """Read a noise.json; raise InputError if it can't be read, or is invalid."""
    return NoiseModel.from_dict(json_data.read_json(path), where=str(path))
