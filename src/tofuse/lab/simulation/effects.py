"""Simulated camera errors and their strengths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntFlag
from typing import Any, Literal, Self

from tofuse.engine.errors import InputError

NoiseLaw = Literal["poisson", "other"]


@dataclass(frozen=True)
class Effects:
    """Switches and strengths of the errors of section 2.7; all are on by default.

    Strengths are factors on the camera model's values (1 is the real camera, 0 switches the effect
    off), except `scatter`, which is a fraction.

    Attributes
    ----------
    shot_noise
        Poisson noise of all electrons (signal and ambient light), and read-out noise.
    ambient
        Factor on the ambient light.
    saturation
        A bucket that overflows its full well makes the pixel invalid, amplitude 65535.
    under_exposure
        Weak pixels are invalid for cameras that drop them (the SR4000 reports noise instead).
    mixed_pixels
        Sub-rays, and neighbours by the blur of the lens, sum up in a pixel as phasors: "flying"
        pixels.
    wrap
        Ranges beyond the ambiguity range are wrapped.
    scatter
        Fraction of the light that is scattered in the lens over the whole image.
    multipath
        Multipath with one bounce: rounded corners.
    gloss
        Glossy surfaces reflect a fraction of the light specularly, and scatter less.
    smear
        Each of the four phase images is exposed at a different pose.
    wiggling
        Odd harmonics of the correlation: an error periodic in range.
    pixel_offsets
        Read-out delay and per-pixel offsets.
    amplitude_nonlinearity
        Compression of strong signals.
    thermal_drift
        Offset that grows as the camera warms up.
    noise
        "poisson" is the physical law. "other" has the same mean variance, but heavy tails, spatial
        correlation and a per-pixel gain: not modelled by any weight.
    """

    shot_noise: bool = True
    ambient: float = 1.0
    saturation: bool = True
    under_exposure: bool = True
    mixed_pixels: bool = True
    wrap: bool = True
    scatter: float = 0.02
    multipath: bool = True
    gloss: bool = True
    smear: bool = True
    wiggling: float = 1.0
    pixel_offsets: float = 1.0
    amplitude_nonlinearity: float = 1.0
    thermal_drift: float = 1.0
    noise: NoiseLaw = "poisson"

    def __post_init__(self) -> None:
        if not 0 <= self.scatter < 1:
            raise InputError(f"is {self.scatter}", where="scatter", remedy="use a fraction, 0 to 1")
        if self.ambient < 0:
            raise InputError(f"is {self.ambient}", where="ambient", remedy="use 0 or more")
        if self.noise not in ("poisson", "other"):
            raise InputError(f"is {self.noise!r}", where="noise", remedy="use poisson or other")

    @classmethod
    def none(cls, **enabled: Any) -> Self:
        """Return an ideal camera except for the effects given by name."""
        return cls(**({name: _disabled(name) for name in SWITCHES} | enabled))

    def without(self, *names: str) -> Self:
        """Return these effects with the named ones switched off; "all" means every one.

        Raises
        ------
        InputError
            If there is no such effect.
        """
        disabled = switched_off(names, SWITCHES, "there is no effect")
        return replace(self, **{name: _disabled(name) for name in disabled})


SWITCHES = tuple(field.name for field in fields(Effects) if field.name != "noise")


def _disabled(name: str) -> Any:
    return False if isinstance(getattr(Effects, name), bool) else 0.0


def switched_off(names: Sequence[str], known: Sequence[str], none: str) -> Sequence[str]:
    """Return the errors of a simulated camera that are switched off by name; "all": every one.

    `none` begins the message about a name that is not known.

    Raises
    ------
    InputError
        If there is no such error.
    """
    for name in names:
        if name not in (*known, "all"):
            raise InputError(
                f"{none} called {name!r}",
                where="--without",
                remedy=f"use all, or some of {[*known]}",
            )
    return known if "all" in names else names


class Flag(IntFlag):
    """Errors that affect a pixel: the bits of truth/flags/*.png (uint16).

    Errors common to all pixels (noise, wiggling, offsets, drift) have no bit.
    """

    NO_RETURN = 1
    """No surface along the ray."""
    UNDER_EXPOSED = 2
    """So weak that the camera reports its lowest confidence, or drops the pixel."""
    SATURATED = 4
    """A bucket overflowed in at least one phase image."""
    MIXED = 8
    """Sub-rays of the pixel lie more than 2 cm and 1 % of the range off the surface at its
    centre, or the blur of the lens moves the range by more than 2 cm."""
    WRAPPED = 16
    """Measured in another period than the true one (beyond the ambiguity, or unwrapped wrongly)."""
    MULTIPATH = 32
    """Light reflected by another surface changes the range by more than 3 mm."""
    SCATTER = 64
    """Light scattered in the lens changes the range by more than 3 mm."""
    SMEAR = 128
    """Motion between the phase images changes the range by more than 3 mm."""
    MIRROR = 256
    """More than a tenth of the light was reflected by a mirror."""
    PASSING = 512
    """On a distractor that moves through the scene; not an error of the camera."""
