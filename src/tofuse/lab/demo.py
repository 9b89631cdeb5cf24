"""``tofuse demo`` and ``tofuse simulate``: a simulated recording and its reconstruction."""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from tofuse.apps.jobs import Options, resolve, run
from tofuse.apps.results import folders
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.results import Reconstruction
from tofuse.formats.files import atomic, staging
from tofuse.lab.simulation import CAMERAS, Effects, Passing, check_camera, phone, simulate

# Settings of the thesis per scene (section 4.1): points beyond the object are removed.
_SCENE_OPTIONS: dict[str, dict[str, Any]] = {
    "torso": {"object": True, "max_depth": 2.2},
    "box": {"object": True, "max_depth": 1.8},
}
# Along a corridor of uniform albedo all views are equal and the motion is unobservable without
# phase wrapping.
FAILURE = "corridor"


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
        For invalid options, or if the folder can't be written; see the message for the remedy.
    """
    progress = progress or Silent()
    options = Options(
        out=out,
        method=method,
        seed=seed,
        threads=threads,
        overwrite=True,
        **_SCENE_OPTIONS.get(scene, {}),
    )
    # Validate options and folder before the simulation.
    resolve(options)
    recording = out / folders.RECORDING
    with folders.OutputFolder(out, overwrite=overwrite) as folder:
        expect_failure = scene == FAILURE
        with staging.replacing_folder(recording, lambda _: _check_simulated(recording)) as fresh:
            simulate_to(
                scene,
                fresh,
                seed=seed,
                texture=not expect_failure,
                without=("wrap",) if expect_failure else (),
                progress=progress,
            )
            if scene == "peaks":
                thesis = options.method == "thesis"
                atomic.write_text(
                    fresh / "peaks.toml", PEAKS_CONFIG + (PEAKS_ICP if thesis else "")
                )
                options = replace(options, config=recording / "peaks.toml")
        try:
            return run([recording], options, progress, folder)
        except BaseException:
            if not folders.is_result(out):
                shutil.rmtree(recording, ignore_errors=True)
            raise


def _check_simulated(folder: Path) -> None:
    """Check that nothing but a simulated recording is replaced."""
    if os.path.lexists(folder) and not _is_simulated(folder):
        raise OutputError(
            "is no simulated recording, or holds something else as well",
            where=folder,
            remedy="move it away, or choose another --out",
        )


# All files of a simulated recording.
_SIMULATED = re.compile(
    r"(truth/)?[a-z_]+/\.?\d{6}\.[\w.-]+|truth/[\w.-]+\.ply"
    r"|\.?(camera|correction|rays|timestamps|groundtruth|odometry|frames|imu|peaks)\.[\w.-]+"
)


def _is_simulated(folder: Path) -> bool:
    """Whether a folder contains a simulated recording and nothing else, or is empty."""
    if folder.is_symlink() or not folder.is_dir():
        return False
    for parent, subfolders, names in os.walk(folder):
        if any((Path(parent) / name).is_symlink() for name in (*subfolders, *names)):
            return False
        relative = Path(parent).relative_to(folder)
        if not all(_SIMULATED.fullmatch((relative / name).as_posix()) for name in names):
            return False
    return (folder / "truth").is_dir() or not any(folder.iterdir())


def _refuse(simulated: str, **options: object) -> None:
    """Check that options are not given that what is simulated does not have."""
    for name, value in options.items():
        if value:
            option = f"--{name.replace('_', '-')}"
            raise InputError(f"{simulated} doesn't have this", where=option, remedy="omit it")


# Section 4.1.6: all points, no filters; and a resolution of 1 m. Loops would be 3 m apart.
PEAKS_CONFIG = """\
filters = []
"""
PEAKS_ICP = """
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
    first: int = 0,
    texture: bool = True,
    passing: Passing | None = None,
    mirror: tuple[float, float] | None = None,
    without: tuple[str, ...] = (),
    correction: bool = True,
    imu: bool = False,
    sigma: float | None = None,
    progress: Progress | None = None,
) -> int:
    """Write a simulated recording; returns its number of frames.

    `without` names effects to switch off, or is ("all",); see `Effects.without`, and
    `phone.PhoneErrors` for the camera "phone", whose folder is one of 3d Scanner App.

    Raises
    ------
    InputError
        For an unknown scene, camera or effect.
    OutputError
        If the folder can't be written, or is not empty.
    """
    check_camera(camera, [*CAMERAS, phone.NAME])
    progress = progress or Silent()
    completed = 0

    def report(done: int, total: int) -> None:
        nonlocal completed
        if done == 1:
            progress.stage("simulating", total)
        completed = done
        progress.advance()

    created = not out.exists() or (out.is_dir() and not any(out.iterdir()))
    options: dict[str, Any] = {
        "seed": seed, "every": every, "frames": frames, "first": first, "texture": texture
    }  # fmt: skip
    of_sensor = {"passing": passing, "mirror": mirror, "imu": imu}
    name = "passing" if passing is None else f"with_{passing.kind}"
    unusual = {name: passing, "mirror": mirror, "imu": imu, "no_correction": not correction}
    try:
        if scene == "peaks":
            lens = {"camera": camera != "sr4000", "without": without, "uniform": not texture}
            _refuse("the scene peaks", **unusual, **lens, first=first)
        else:
            _refuse(f"the scene {scene}", sigma=sigma is not None)
        if camera == phone.NAME:
            _refuse("a simulated phone", **unusual)
            errors = phone.PhoneErrors().without(*without)
            phone.write_phone(phone.plan_phone(scene, errors=errors, **options), out, report)
        else:
            options |= of_sensor | ({} if sigma is None else {"sigma_m": sigma})
            effects = Effects().without(*without)
            simulate(
                scene, out, camera=camera, effects=effects, correction=correction,
                progress=report, **options,
            )  # fmt: skip
    except BaseException:
        if created:
            shutil.rmtree(out, ignore_errors=True)
        raise
    return completed or len(list(out.glob("cloud/*.ply")))
