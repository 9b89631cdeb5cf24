"""Simulated recordings with large steps from frame to frame."""

from __future__ import annotations

from pathlib import Path

from tofuse.engine.frames.recording import Recording
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import simulate


def without_multipath(
    folder: Path, scene: str, camera: str, every: int, frames: int | None = None
) -> Recording:
    """A scene recorded at every `every`-th pose, without multipath and motion blur."""
    effects = Effects(multipath=False, smear=False)
    out = folder / scene
    simulate(scene, out, camera=camera, seed=10, every=every, frames=frames, effects=effects)
    return open_recording(out)
