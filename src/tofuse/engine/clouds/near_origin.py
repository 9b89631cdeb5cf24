"""Two views in coordinates where single precision is sufficient, whatever those of their files."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.geometry import se3

# Clouds with coordinates beyond are moved near the origin.
_MAX_ORIGIN_DISTANCE_M = 1000.0


@dataclass(frozen=True, eq=False)
class NearOrigin:
    """Two views near the origin, where single precision is sufficient.

    Attributes
    ----------
    source, target
        The views; clouds far from the origin with the `shift` that brings them there.
    guess
        (4, 4) T_target_source of these views; None for none.
    """

    source: Frame
    target: Frame
    guess: Float64 | None

    @classmethod
    def of(cls, source: Frame, target: Frame, guess: Float64 | None) -> NearOrigin:
        """Move clouds that are far from the origin near it.

        Without a guess, clouds close to each other are shifted equally, which preserves the
        identity as initial pose; else each is centred.

        Parameters
        ----------
        source, target
            The views.
        guess
            (4, 4) T_target_source in the coordinates of their files; None for none.
        """
        boxes = [_box(view) for view in (source, target)]
        centres = [np.round(box.mean(0)) for box in boxes]
        for k, view in enumerate((source, target)):
            if isinstance(view, RangeFrame):
                centres[k] = np.zeros(3)
        if not any(np.abs(box).max() > _MAX_ORIGIN_DISTANCE_M for box in boxes):
            centres = [np.zeros(3), np.zeros(3)]
        elif guess is None and isinstance(source, CloudFrame) and isinstance(target, CloudFrame):
            max_distance = np.ptp(boxes[0], axis=0).max() + np.ptp(boxes[1], axis=0).max()
            if np.linalg.norm(centres[0] - centres[1]) <= max_distance:
                centres[0] = centres[1]
        if guess is not None:
            guess = se3.translation(-centres[1]) @ guess @ se3.translation(centres[0])
            # Projected onto a rotation: rounded entries would move points far from the origin.
            guess = se3.orthonormalise(guess)
        near = [
            view.relative_to(centre) if isinstance(view, CloudFrame) else view
            for view, centre in zip((source, target), centres, strict=True)
        ]
        return cls(near[0], near[1], guess)

    def in_files(self, registration: Registration) -> Registration:
        """Return a registration of these views in the coordinates of their files.

        Information and unobservable directions remain about the origin of the near source: about
        that of a map, far away, they would lose their digits.
        """
        to_target_file = se3.translation(self.target.shift)
        from_source_file = se3.translation(-self.source.shift)
        runner_up = registration.runner_up
        return replace(
            registration,
            T_target_source=to_target_file @ registration.T_target_source @ from_source_file,
            runner_up=None if runner_up is None else to_target_file @ runner_up @ from_source_file,
            reference_point=self.source.shift,
        )


def _box(view: Frame) -> Float64:
    """Return the corners (2, 3) of the box of 90 % of the points, in the file's coordinates."""
    if not len(view):
        return np.zeros((2, 3))
    box: Float64 = np.percentile(view.points.astype(float), [5, 95], axis=0)
    return box + view.shift
