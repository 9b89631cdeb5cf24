"""The registration that `tofuse.register` makes, as a part of configurations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import RegistrationError
from tofuse.maps.surface_map import SurfaceOptions, surface_map
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.cloud_pair import follow_clouds, register_clouds
from tofuse.registration.verification import comparable
from tofuse.registration.view_pair import follow, register_pair

Float64 = NDArray[np.float64]

FEWEST_POINTS = 10


@part("registration", "any-pair")
@dataclass(frozen=True)
class AnyPair(Registrar):
    """Two views that may be far apart: the pose, and whether it is to be believed.

    Two images are registered by what both cameras saw (`registration.view_pair`), and where they
    have too little surface for that, like clouds (`registration.cloud_pair`).

    Attributes
    ----------
    search
        Whether poses are searched where the one that the guess leads to is not certain. Else that
        one is judged by itself.
    """

    search: bool = True
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def register(
        self, source: Frame, target: Frame, guess: Float64 | None, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without a guess the identity is tried first.

        Of poses that can't be told apart the one at the guess is taken.
        """
        for view in (source, target):
            if len(view) < FEWEST_POINTS:
                raise RegistrationError(f"has {len(view)} points", where=f"frame {view.index}")
        if isinstance(source, RangeFrame) and isinstance(target, RangeFrame):
            options = SurfaceOptions()
            data, model = surface_map(source, options), surface_map(target, options)
            if not comparable(data.depth, model.depth):
                raise RegistrationError(
                    f"has a median depth of {data.depth:.2g} m, and frame {target.index} of "
                    f"{model.depth:.2g} m: views of so different a scale can't be compared",
                    where=f"frame {source.index}",
                    remedy="check the unit of depth",
                )
            if self.search or guess is None:
                found = register_pair(data, model, guess)
            else:
                found = follow(data, model, guess)
            if found is not None:
                return found
        if self.search or guess is None:
            return register_clouds(source, target, guess, rng)
        return follow_clouds(source, target, guess, rng)
