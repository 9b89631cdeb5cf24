"""The interface of live cameras."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import typing
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from time import monotonic
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.cameras import Camera
from tofuse.engine.errors import InputError
from tofuse.engine.frames import AmplitudeKind, DepthKind, RangeFrame
from tofuse.engine.parts import discover, from_dict, name_of, registered

# Time without a frame until a camera counts as stopped; before the first, it warms up.
TIMEOUT_S, START_TIMEOUT_S = 2.0, 15.0

# How options that are not text are written.
_WORDS: dict[Any, str] = {bool: "true|false", int: "-?[1-9][0-9]*|0"}


class DeviceError(InputError):
    """A camera can't be opened, or has stopped sending."""


@dataclass(frozen=True, eq=False)
class Settings:
    """Properties of all frames of a camera, as in a recording's camera.json.

    Attributes
    ----------
    sensor
        The camera's name.
    camera
        Rays of the pixels.
    depth_unit_m
        Metres per count.
    depth_kind
        "z" or "range".
    frame_rate_hz
        As requested.
    amplitude_kind
        See `RangeFrame`; None without amplitude.
    """

    sensor: str
    camera: Camera
    depth_unit_m: float
    depth_kind: DepthKind
    frame_rate_hz: float
    amplitude_kind: AmplitudeKind | None = None


class Stream(AbstractContextManager["Stream"], ABC):
    """A running camera; closed at the end of its ``with`` block.

    Attributes
    ----------
    settings
        Available when the stream is opened.
    timeout_s
        Time to wait for the next frame.
    """

    settings: Settings
    timeout_s: float = START_TIMEOUT_S

    def __init__(self, options: Device) -> None:
        self._maker = options.maker
        pip, module = options.package
        try:
            package = importlib.import_module(module)
        except ImportError as error:
            raise DeviceError(
                f"needs the package {pip}, which can't be imported ({error})",
                where=name_of(options),
                remedy=f"run `pip install {pip}`",
            ) from error
        try:
            self.start(package, options)
        except DeviceError:
            raise
        except Exception as error:  # the maker's package may raise anything
            raise DeviceError(
                f"does not start ({type(error).__name__}: {error})",
                where=options.maker,
                remedy="check its cable, that no other program uses it, and the values of --set",
            ) from error
        try:
            self.settings = self.read_settings()
        except BaseException:
            self.close()
            raise

    def start(self, package: Any, options: Any) -> None:
        """Start the camera with the maker's package and the options of its device.

        Raises
        ------
        DeviceError
            If no camera is connected, or it doesn't start.
        """

    def read_settings(self) -> Settings:
        """Return the properties of the running camera, after `start`."""
        raise NotImplementedError

    @abstractmethod
    def read(self, index: int) -> RangeFrame:
        """Wait for the next frame, and return it with this index.

        Raises
        ------
        DeviceError
            If none arrives within `timeout_s`.
        """

    def poll(self, timeout_s: float) -> Any:
        """Return the next images of the maker's package; None if depth hasn't arrived in time."""
        raise NotImplementedError

    def wait(self) -> Any:
        """Return the next images: those without depth are skipped.

        Raises
        ------
        DeviceError
            If none arrive within `timeout_s`, or the camera fails.
        """
        end = monotonic() + self.timeout_s
        while (left := end - monotonic()) > 0:
            try:
                images = self.poll(left)
            except Exception as error:  # the maker's package may raise anything
                raise self._failed(f"stopped ({type(error).__name__}: {error})") from error
            if images is not None:
                self.timeout_s = TIMEOUT_S
                return images
        raise self._failed(f"sent no frame for {self.timeout_s:g} s")

    def _failed(self, problem: str) -> DeviceError:
        return DeviceError(problem, where=self._maker, remedy="check its cable and power supply")

    @abstractmethod
    def close(self) -> None:
        """Stop the camera."""

    def frame(
        self, index: int, seconds: float, counts: NDArray[Any], infrared: NDArray[Any] | None
    ) -> RangeFrame:
        """Return a frame of z depths in counts, and infrared: zeros if it alone is missing."""
        if infrared is None and self.settings.amplitude_kind is not None:
            infrared = np.zeros_like(counts)
        return RangeFrame(
            index,
            seconds,
            self.settings.camera,
            counts.astype(np.float32) * np.float32(self.settings.depth_unit_m),
            "z",
            None if infrared is None else infrared.astype(np.float32),
            amplitude_kind="ir",
        )

    def __iter__(self) -> Iterator[RangeFrame]:
        """Yield frames endlessly, for example to push them into a `Mapper`."""
        index = 0
        while True:
            yield self.read(index)
            index += 1

    def __exit__(self, *_: object) -> None:
        self.close()


class Device(ABC):
    """A kind of camera, registered by ``@part("device", name)`` in a module of `devices`.

    Attributes
    ----------
    maker
        Its name in messages.
    package
        Name of the required package for pip, and for import.
    stream
        Its frames.
    """

    part_kind: ClassVar[str] = "device"
    maker: ClassVar[str]
    package: ClassVar[tuple[str, str]]
    stream: ClassVar[type[Stream]]

    def open(self) -> Stream:
        """Start the camera.

        Raises
        ------
        DeviceError
            If the package is missing, no camera is connected, or it doesn't start.
        """
        return self.stream(self)


def device_named(name: str, options: Mapping[str, str]) -> Device:
    """Return a kind of camera by its name, with options as text.

    Raises
    ------
    InputError
        For an unknown camera or option, or a value of the wrong type.
    """
    kinds = known_devices()
    if name not in kinds:
        raise InputError(
            f"there is no camera {name!r}", where="record", remedy=f"use one of {', '.join(kinds)}"
        )
    types = typing.get_type_hints(kinds[name])
    values: dict[str, Any] = {"part": name}
    for key, text in options.items():
        words = _WORDS.get(types.get(key), "")
        if words and (not re.fullmatch(words, text)):
            remedy = "use true or false" if types[key] is bool else "use a whole number"
            raise InputError(f"is {text!r}", where=f"--set {key}", remedy=remedy)
        values[key] = json.loads(text) if words else text
    kind: Device = from_dict(Device, values, where="--set")
    return kind


def known_devices() -> dict[str, type[Any]]:
    """Return the known kinds of camera by name."""
    discover("tofuse.apps.live.devices")
    return registered("device")


def is_installed(device: type[Any]) -> bool:
    """Return whether the maker's package can be found."""
    return importlib.util.find_spec(device.package[1]) is not None
