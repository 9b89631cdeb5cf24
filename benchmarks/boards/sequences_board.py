"""Whole recordings: configurations, parts of the default configuration, and other trackers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar

import numpy as np

import peers
import sequences
import tracking
from boards import Board, Score, default_made
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import TofuseError
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.parts import name_of
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory

# Title, and which images are used: every n-th.
SCENES = {
    "room": ("room, SR4000", 1),
    "empty-room": ("empty room, SR4000", 1),
    "torso": ("turned torso, SR4000", 1),
    "kitchen": ("kitchen, Kinect v1 (real)", 4),
    "iphone": ("chair, iPhone (real)", 1),
    "kinect": ("boxes, Kinect v2 (real)", 1),
}
_METHODS = ("default", "thesis")
# Trackers of other programs, with the modules that they need, and the images they are tuned on.
_PEERS = {
    "Open3D odometry, depth": "open3d",
    "Open3D dense SLAM": "open3d",
    "small_gicp pairwise": "small_gicp",
    "small_gicp map": "small_gicp",
    "KISS-ICP": "kiss_icp",
}
_TUNING = 30


class Sequences(Board):
    """See `Board`."""

    name = "sequences"
    title = "Whole recordings"
    columns: ClassVar[dict[str, str]] = {scene: title for scene, (title, _) in SCENES.items()}

    def methods(self) -> Sequence[str]:
        """See `Board`: configurations, `default` with one part replaced, and peers."""
        out, config = [*_METHODS], from_method("default")
        for kind in ("odometry", "refinement", "optimiser"):
            own = name_of(getattr(config, kind))
            out += [f"{kind} {name}" for name in default_made(kind) if name != own]
        return [*out, *(label for label, module in _PEERS.items() if find_spec(module))]

    def cases(self, seeds: int) -> Sequence[str]:
        """See `Board`: a recording is one case, for any number of seeds."""
        return [f"{scene}/0" for scene in SCENES]

    def prepare(self, data: Path) -> None:
        """See `Board.prepare`."""
        for scene in SCENES:
            _sequence(scene, data)

    def run(self, method: str, case: str, data: Path) -> Score | None:
        """See `Board`."""
        sequence = _sequence(case.split("/")[0], data)
        if sequence is None or method == "odometry given":  # needs poses given with the images
            return None
        began = time.process_time()
        if method in _PEERS:
            poses = _tracked(method, sequence)
        else:
            config = from_method("default" if " " in method else method)
            if " " in method:
                kind, name = method.split()
                config = changed(config, {kind: {"part": name}}, where=method)
            try:
                result = reconstruct(sequence.checked, config)
                poses = result.trajectory
            except TofuseError:
                poses = np.full_like(sequence.reference, np.nan)
        seconds = time.process_time() - began
        times = np.arange(len(poses), dtype=float)
        known = np.isfinite(sequence.reference).all((1, 2))
        has = known & np.isfinite(poses).all((1, 2))
        posed = float(has.sum() / known.sum())
        if has.sum() < 3:
            return {"ate": np.inf, "degrees": np.inf, "posed": posed, "seconds": seconds}
        error = evaluate_trajectory(times[has], poses[has], times[has], sequence.reference[has])
        degrees = float(np.degrees(error.rotation_rms_rad))
        return {"ate": error.ate_rms_m, "degrees": degrees, "posed": posed, "seconds": seconds}

    def cell(self, scores: Sequence[Score]) -> str:
        """See `Board`: errors in mm and degrees, and the fraction of frames with a pose."""
        one = scores[0]
        if not np.isfinite(one["ate"]):
            return "lost"
        some = "" if one["posed"] > 0.995 else f", {100 * one['posed']:.0f} %"
        return f"{1000 * one['ate']:.1f}, {one['degrees']:.2f} deg{some}"

    def merit(self, scores: Sequence[Score]) -> float:
        """See `Board`: lost frames first, then the error."""
        return float(np.mean([10 * round(s["posed"], 1) - min(s["ate"], 9.0) for s in scores]))


@lru_cache(1)
def _sequence(scene: str, data: Path) -> sequences.Sequence | None:
    try:
        whole = sequences.load(scene, data)
    except FileNotFoundError:
        return None
    every = SCENES[scene][1]
    return replace(
        whole,
        frames=whole.frames[::every],
        cleaned=whole.cleaned[::every],
        checked=whole.checked.select(every=every),
        reference=whole.reference[::every],
    )


def _tracked(label: str, sequence: sequences.Sequence) -> Float64:
    """Poses by a peer, with the best of its tunings on the first images, see `tracking.best`."""
    candidates = next(
        tunings for tunings in peers.all_methods(sequence.frames[0]) if tunings[0].label == label
    )
    method, cleaned, _ = tracking.best(candidates, sequence, 1, _TUNING)
    return tracking.run(method, sequence.cleaned if cleaned else sequence.frames, 1).poses
