"""Stages of a run that are stopped and resumed."""

from __future__ import annotations

import numpy as np

from tofuse.pipeline.checkpoint import Stages
from tofuse.pipeline.states import decode, encode


class Stopped(BaseException):
    pass


class Kept(Stages):
    """Stores the state as bytes after every frame, and stops on request."""

    def __init__(self, stop_at: int) -> None:
        self.states: dict[str, dict[str, np.ndarray]] = {}
        self.saved: list[str] = []
        self.stop_at = stop_at

    def load(self, stage: str) -> object:
        arrays = self.states.get(stage)
        return None if arrays is None else decode(arrays)

    def save(self, stage: str, state: object) -> None:
        self.states[stage] = {name: array.copy() for name, array in encode(state)}
        self.saved.append(stage)
        if len(self.saved) == self.stop_at:
            raise Stopped

    def due(self) -> bool:
        return True
