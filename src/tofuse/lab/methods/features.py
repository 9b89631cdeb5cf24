"""Registration by matched image features (sections 2.5.1 and 2.5.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64, Int64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.clouds import robust_motion
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part
from tofuse.engine.search import pair_agreement
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view
from tofuse.lab.methods.keypoints import Channel, Detector, Keypoints, keypoints
from tofuse.lab.methods.sample_consensus import SampleOptions, registration_of


@part("registration", "features")
@dataclass(frozen=True)
class Features(Bounded, Registrar):
    """SIFT, ORB or FAST keypoints of the albedo or the colour, matched, with 3D positions.

    Matches are mutual nearest neighbours that pass the ratio test (Lowe 2004). As all have depth,
    three matches determine a motion; RANSAC maximises the inliers, with thresholds in standard
    deviations of each match. The pose is a weighted least-squares fit to the inliers. The guess is
    not used.

    Attributes
    ----------
    detector
        "sift", "orb" or "fast".
    channel
        Image of the detector: the "albedo" (amplitude times squared range), the "color", or "auto":
        the albedo if there is amplitude.
    count
        Number of strongest keypoints per view.
    ratio
        Largest descriptor distance of a match, relative to that of the second best.
    mutual
        Whether matches must be mutual nearest neighbours.
    blur_px
        Standard deviation of the detected position, pixels.
    verify
        Whether the image agreement (`agreement`) counts as much as the matches in the choice among
        several motions; contradicted ones are rejected.
    consensus
        Options of the sample consensus.
    """

    detector: Detector = "sift"
    channel: Channel = "auto"
    count: Annotated[int, Bounds(3, 100_000)] = 1000
    ratio: Annotated[float, Bounds(0.01, 1)] = 0.9
    mutual: bool = True
    blur_px: Annotated[float, Bounds(0.001, 100)] = 0.7
    verify: bool = True
    consensus: SampleOptions = SampleOptions()  # noqa: RUF009 - immutable
    takes: ClassVar[frozenset[str]] = frozenset({"range"})

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; points are the matches, correspondences the inliers.

        Raises
        ------
        RegistrationError
            If a view has neither amplitude nor colour, or too few matches are inliers, or the
            images contradict the motion.
        """
        (a, s), (b, t) = self._detect(source), self._detect(target)
        pairs = self.pairs(a, b)
        hypotheses = robust_motion.consensus(pairs, self.consensus, self.consensus.motions(rng))
        scores = [c.score / len(pairs) for c in hypotheses]
        if self.verify:
            agreements = [
                pair_agreement.agreement(s, t, c.T_target_source).score for c in hypotheses
            ]
            if max(agreements) <= 0:
                raise RegistrationError(
                    f"{hypotheses[0].count} of {len(pairs)} pairs of points agree on a motion that "
                    "what both images saw contradicts"
                )
            scores = [a + b for a, b in zip(scores, agreements, strict=True)]
        best = max(range(len(hypotheses)), key=lambda k: scores[k])
        rival = max((score for k, score in enumerate(scores) if k != best), default=0.0)
        return registration_of(pairs, hypotheses[best], scores[best] - max(rival, 0.0))

    def _detect(self, view: Frame) -> tuple[Keypoints, PreparedView]:
        if not isinstance(view, RangeFrame):
            raise RegistrationError("is not an image", where=f"frame {view.index}")
        surface = prepare_view(view, SurfaceOptions())
        detected = keypoints(
            view,
            surface,
            detector=self.detector,
            channel=self.channel,
            count=self.count,
            blur_px=self.blur_px,
        )
        return detected, surface

    def pairs(self, source: Keypoints, target: Keypoints) -> robust_motion.Pairs:
        """Match the points of two views."""
        i, j = self._match(source.descriptors, target.descriptors)
        return robust_motion.Pairs(
            source.points[i], target.points[j], source.variance[i] + target.variance[j]
        )

    def _match(self, a: NDArray[Any], b: NDArray[Any]) -> tuple[Int64, Int64]:
        """Index pairs of matching descriptors, in the order of a."""
        empty = np.zeros(0, np.int64)
        if len(a) < 2 or len(b) < 2:
            return empty, empty
        matcher = cv2.BFMatcher(cv2.NORM_HAMMING if a.dtype == np.uint8 else cv2.NORM_L2)
        best = matcher.knnMatch(a, b, k=2)
        matches = [m for m, second in best if m.distance < self.ratio * second.distance]
        if self.mutual:
            backward = [m.trainIdx for m in matcher.match(b, a)]
            matches = [m for m in matches if backward[m.trainIdx] == m.queryIdx]
        return (
            np.array([m.queryIdx for m in matches], np.int64),
            np.array([m.trainIdx for m in matches], np.int64),
        )
