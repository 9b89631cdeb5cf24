"""Which errors the simulated camera makes, and how strongly."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntFlag
from typing import Any, Literal, Self

from tofuse.errors import InputError

NoiseLaw = Literal["poisson", "other"]


@dataclass(frozen=True)
class Effects:
    """Switches and strengths of the errors of section 2.7; all are on by default.

    Strengths are factors on what the camera model says (1 is the camera as it is, 0 switches the
    effect off), except `scatter`, which is a share.

    Attributes
    ----------
    shot_noise
        Poisson noise of all electrons (signal and ambient light) and noise of reading them out.
    ambient
        Factor on the ambient light.
    saturation
        A bucket that overflows its full well makes the pixel invalid, amplitude 65535.
    under_exposure
        Cameras that drop weak pixels drop them (the SR4000 never does: it gives noise).
    mixed_pixels
        Light of several sub-rays, and of neighbours through the blur of the lens, adds up in a
        pixel as phasors: "flying" pixels.
    wrap
        Ranges beyond one period come back as short ones.
    scatter
        Share of the light that is scattered in the lens over the whole image.
    multipath
        Light that came by way of another surface (one bounce): rounded corners.
    gloss
        Glossy surfaces mirror their share of the light, and return that much less themselves.
    smear
        Each of the four phase images is exposed at its own pose.
    wiggling
        Odd harmonics of the correlation: an error that is periodic in range.
    pixel_offsets
        Delay along the read-out chain and from pixel to pixel.
    amplitude_nonlinearity
        Strong signals are measured weaker than they are.
    thermal_drift
        Offset that grows as the camera warms up.
    noise
        "poisson" is the physical law. "other" has the same mean variance, but heavy tails,
        correlated neighbours and a gain of noise per pixel: what no weight has been told.
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
            raise InputError(f"is {self.scatter}", where="scatter", remedy="give a share, 0 to 1")
        if self.ambient < 0:
            raise InputError(f"is {self.ambient}", where="ambient", remedy="give 0 or more")
        if self.noise not in ("poisson", "other"):
            raise InputError(f"is {self.noise!r}", where="noise", remedy="use poisson or other")

    @classmethod
    def none(cls, **on: Any) -> Self:
        """Return an ideal camera, but for the effects given by name."""
        return cls(**({name: _off(name) for name in SWITCHES} | on))

    def without(self, *names: str) -> Self:
        """Return these effects with the ones named switched off; "all" stands for every one.

        Raises
        ------
        InputError
            If there is no such effect.
        """
        for name in names:
            if name not in (*SWITCHES, "all"):
                raise InputError(
                    f"there is no effect called {name!r}",
                    where="effects",
                    remedy=f"use all, or some of {list(SWITCHES)}",
                )
        chosen = SWITCHES if "all" in names else names
        return replace(self, **{name: _off(name) for name in chosen})


SWITCHES = tuple(field.name for field in fields(Effects) if field.name != "noise")


def _off(name: str) -> Any:
    return False if isinstance(getattr(Effects, name), bool) else 0.0


class Flag(IntFlag):
    """Which errors hit a pixel: the bits of truth/flags/*.png (uint16).

    Errors of every pixel (noise, wiggling, offsets, drift) have no bit.
    """

    NO_RETURN = 1
    """No surface along the ray."""
    UNDER_EXPOSED = 2
    """So weak that the camera gives its lowest confidence, or drops the pixel."""
    SATURATED = 4
    """A bucket overflowed in at least one phase image."""
    MIXED = 8
    """Sub-rays of the pixel lie more than 2 cm and 1 % of the range off the surface at its
    centre, or the blur of the lens moves the range by more than 2 cm."""
    WRAPPED = 16
    """Measured in another period than the true one (beyond the ambiguity, or unwrapped wrongly)."""
    MULTIPATH = 32
    """Light by way of another surface moves the range by more than 3 mm."""
    SCATTER = 64
    """Light scattered in the lens moves the range by more than 3 mm."""
    SMEAR = 128
    """Motion between the phase images moves the range by more than 3 mm."""
    MIRROR = 256
    """More than a tenth of the light came by way of a mirroring surface."""
    PASSING = 512
    """On a thing that moves through the scene; no error of the camera."""
