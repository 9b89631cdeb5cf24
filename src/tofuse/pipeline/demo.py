"""``tofuse demo`` and ``tofuse simulate``: a recording made here, and what becomes of it."""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path
from typing import Any

from tofuse.errors import InputError
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.run import Options, run
from tofuse.results.output import RECORDING, OutputFolder
from tofuse.results.types import Reconstruction
from tofuse.simulation.effects import Effects
from tofuse.simulation.record import simulate

# What the thesis set differently for a scene (section 4.1): points beyond the object are cut.
_SCENE_OPTIONS: dict[str, dict[str, Any]] = {
    "torso": {"object": True},
    "box": {"object": True},
}


def demo(
    scene: str,
    out: Path,
    *,
    method: str | None = None,
    seed: int = 0,
    threads: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Reconstruction:
    """Simulate a scene into ``out/recording`` and reconstruct it into `out`.

    Raises
    ------
    InputError, OutputError
        If nothing could be written; see the message for the remedy.
    """
    progress = progress or Silent()
    OutputFolder(out, overwrite=overwrite).discard()
    recording = out / RECORDING
    simulate_to(scene, recording, seed=seed, overwrite=True, progress=progress)
    config = None
    if scene == "peaks":
        config = recording / "peaks.toml"
        config.write_text(PEAKS_CONFIG, encoding="utf-8")
    options = Options(
        out=out,
        method=method,
        config=config,
        seed=seed,
        threads=threads,
        overwrite=True,
        **_SCENE_OPTIONS.get(scene, {}),
    )
    return run([recording], options, progress)


# Section 4.1.6: all points, a resolution of 1 m, no filters; loops would be 3 m apart.
PEAKS_CONFIG = """\
filters = []

[odometry]
guess = "previous"

[odometry.registration]
resolution = 1.0
source.part = "all"
target.part = "all"
"""


def simulate_to(
    scene: str,
    out: Path,
    *,
    camera: str = "sr4000",
    seed: int = 0,
    every: int | None = None,
    frames: int | None = None,
    texture: bool = True,
    without: tuple[str, ...] = (),
    correction: bool = True,
    sigma: float | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> int:
    """Write a simulated recording; returns how many frames it has.

    `without` names fields of `Effects` to switch off, or "all".

    Raises
    ------
    InputError
        For an unknown scene, camera or effect.
    OutputError
        If the folder can't be written, or holds something already.
    """
    progress = progress or Silent()
    effects = effects_without(without)
    seen = 0

    def tell(done: int, total: int) -> None:
        nonlocal seen
        if done == 1:
            progress.stage("simulating", total)
        seen = done
        progress.advance()

    if overwrite:
        _clear_recording(out)
    options: dict[str, Any] = {} if sigma is None else {"sigma_m": sigma}
    simulate(
        scene,
        out,
        camera=camera,
        seed=seed,
        effects=effects,
        every=every,
        frames=frames,
        correction=correction,
        texture=texture,
        progress=tell,
        **options,
    )
    return seen or len(list(out.glob("cloud/*.ply")))


def effects_without(names: tuple[str, ...]) -> Effects:
    """Return all effects but those named; InputError for a name that is none."""
    known = [f.name for f in fields(Effects) if f.name != "noise"]
    if names == ("all",):
        return Effects.none()
    changes: dict[str, Any] = {}
    for name in names:
        if name not in known:
            raise InputError(f"is {name!r}", where="--without", remedy=f"use some of {known}")
        changes[name] = False if isinstance(getattr(Effects, name), bool) else 0.0
    return Effects(**changes)


def _clear_recording(out: Path) -> None:
    """Remove an earlier simulated recording, and nothing else."""
    if (out / "truth").is_dir():
        shutil.rmtree(out)
