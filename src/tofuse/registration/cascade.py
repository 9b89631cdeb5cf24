"""Registrations one after another, each from where the one before arrived."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tofuse.parts import part
from tofuse.recordings.frames import Frame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.interfaces import Float64


@part("registration", "cascade")
@dataclass(frozen=True)
class Cascade(Registrar):
    """Coarse to fine: the last registration gives the result, the others its guess.

    Attributes
    ----------
    stages
        In the order in which they are run.
    """

    stages: tuple[Registrar, ...]

    def __post_init__(self) -> None:
        if not self.stages:
            raise ValueError("stages is empty")

    @property
    def takes(self) -> frozenset[str]:
        """Kinds of view that every stage works on."""
        return frozenset.intersection(*(stage.takes for stage in self.stages))

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; raises what any stage raises."""
        for stage in self.stages:
            found = stage.register(source, target, guess, rng)
            guess = found.T_target_source
        return found
