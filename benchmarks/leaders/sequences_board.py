"""Whole recordings: odometry, refinement and optimiser parts within the default method."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np

import pairs
from leaders import Board, Score, default_made
from tofuse.errors import TofuseError
from tofuse.evaluation.trajectory import distances_between
from tofuse.pipeline.config import changed, from_method
from tofuse.pipeline.reconstruct import reconstruct

SCENES = {"room": "furnished room, SR4000", "flat": "flat of four rooms, SR4000"}
_METHODS = ("default", "thesis")


class Sequences(Board):
    """See `Board`."""

    name = "sequences"
    title = "Whole recordings"
    columns: ClassVar[dict[str, str]] = SCENES

    def methods(self) -> Sequence[str]:
        """See `Board`: the named configurations, and `default` with one part replaced."""
        out = [*_METHODS]
        for kind in ("odometry", "refinement", "optimiser"):
            out += [f"{kind} {name}" for name in default_made(kind)]
        return out

    def cases(self, seeds: int) -> Sequence[str]:
        """See `Board`: a recording is one case, for any number of seeds."""
        return [f"{scene}/0" for scene in SCENES]

    def run(self, method: str, case: str, data: Path) -> Score | None:
        """See `Board`."""
        recording = pairs.SCENES[case.split("/")[0]].open(data)
        if method in _METHODS:
            config = from_method(method)
        else:
            kind, name = method.split()
            if name == "given":
                return None  # it needs poses given with the images
            config = changed(from_method("default"), {kind: {"part": name}}, where=method)
        began = time.process_time()
        try:
            result = reconstruct(recording, config)
        except TofuseError:
            return {"ate": np.inf, "posed": 0.0, "seconds": time.process_time() - began}
        seconds = time.process_time() - began
        truth = recording.reference
        assert truth is not None
        known = result.has_pose & np.isfinite(truth).all((1, 2))
        if known.sum() < 3:
            return {"ate": np.inf, "posed": 0.0, "seconds": seconds}
        gaps = distances_between(result.trajectory[known], truth[known])
        ate = float(np.sqrt((gaps**2).mean()))
        return {"ate": ate, "posed": float(known.mean()), "seconds": seconds}

    def cell(self, scores: Sequence[Score]) -> str:
        """See `Board`: error in mm, and the fraction of the frames that have a pose."""
        return f"{1000 * scores[0]['ate']:.1f} mm, {100 * scores[0]['posed']:.0f} %"

    def merit(self, scores: Sequence[Score]) -> float:
        """See `Board`: lost frames first, then the error."""
        return float(np.mean([10 * round(s["posed"], 1) - min(s["ate"], 9.0) for s in scores]))
