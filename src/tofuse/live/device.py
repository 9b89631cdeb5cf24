"""The interface of a camera that is plugged in."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import ModuleType, TracebackType
from typing import Any, ClassVar, Protocol, Self

from tofuse.errors import InputError
from tofuse.geometry.cameras import Camera
from tofuse.parts import discover, from_dict, known
from tofuse.recordings.frames import AmplitudeKind, DepthKind, RangeFrame

TIMEOUT_S = 2.0  # a camera that is silent for so long has stopped


class DeviceError(InputError):
    """A camera can't be opened, or has stopped sending."""


@dataclass(frozen=True, eq=False)
class Settings:
    """What holds for all frames of a camera, as in a recording's camera.json.

    Attributes
    ----------
    sensor
        Its name, as it states it.
    camera
        Rays of the pixels.
    depth_unit_m
        Metres of one count.
    depth_kind
        "z" or "range".
    frame_rate_hz
        As asked for.
    amplitude_kind
        What the amplitude counts; None where there is none.
    """

    sensor: str
    camera: Camera
    depth_unit_m: float
    depth_kind: DepthKind
    frame_rate_hz: float
    amplitude_kind: AmplitudeKind | None = None


class Stream(ABC):
    """A camera that is sending; closed at the end of its ``with`` block.

    Attributes
    ----------
    settings
        Known from the start.
    """

    settings: Settings

    @abstractmethod
    def read(self, index: int) -> RangeFrame:
        """Wait for the next frame, and give it an index.

        Raises
        ------
        DeviceError
            If none comes within `TIMEOUT_S`.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop sending."""

    def __iter__(self) -> Iterator[RangeFrame]:
        """Frames without end: they can be pushed into a `Mapper`."""
        index = 0
        while True:
            yield self.read(index)
            index += 1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        self.close()


class Device(Protocol):
    """A kind of camera. Registered by ``@part("device", name)`` in a module of `devices`.

    Attributes
    ----------
    package
        What has to be installed, by pip's name, and imported, by Python's.
    """

    part_kind: ClassVar[str] = "device"
    package: ClassVar[tuple[str, str]]

    def open(self) -> AbstractContextManager[Stream]:
        """Start the camera.

        Raises
        ------
        DeviceError
            If the package is missing, there is no camera, or it doesn't start.
        """
        ...


def device(name: str, options: Mapping[str, str]) -> Device:
    """Make a kind of camera by its name, with options as text.

    Raises
    ------
    InputError
        For an unknown camera or option, or a value that isn't of the option's type.
    """
    kinds = devices()
    if name not in kinds:
        raise InputError(
            f"there is no camera {name!r}", where="record", remedy=f"use one of {list(kinds)}"
        )
    types = {f.name: f.type for f in dataclasses.fields(kinds[name])}
    values: dict[str, Any] = {"part": name}
    for key, text in options.items():
        values[key] = _read(text, str(types.get(key)), f"--set {key}")
    made: Device = from_dict(Device, values, where="--set")
    return made


def _read(text: str, kind: str, where: str) -> object:
    if kind == "bool":
        if text not in ("true", "false"):
            raise InputError(f"is {text!r}", where=where, remedy="give true or false")
        return text == "true"
    if kind == "int":
        try:
            return int(text)
        except ValueError as error:
            raise InputError(f"is {text!r}", where=where, remedy="give a whole number") from error
    return text


def devices() -> dict[str, type[Any]]:
    """Return the known kinds of camera by name."""
    discover("tofuse.live.devices")
    return known("device")


def is_installed(device: type[Any]) -> bool:
    """Return whether the maker's package can be found."""
    return importlib.util.find_spec(device.package[1]) is not None


def vendor(package: tuple[str, str]) -> ModuleType:
    """Import the maker's package, named as in `Device.package`.

    Raises
    ------
    DeviceError
        Saying what to install.
    """
    pip, module = package
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise DeviceError(
            f"needs the package {pip}, which can't be imported ({error})",
            where="camera",
            remedy=f"give `pip install {pip}`",
        ) from error


def no_frame(sensor: str) -> DeviceError:
    """Return the error of a camera that is silent."""
    return DeviceError(
        f"sent no frame for {TIMEOUT_S:g} s", where=sensor, remedy="check its cable and its power"
    )


def not_started(name: str, error: Exception) -> DeviceError:
    """Return the error of a camera that does not start."""
    return DeviceError(
        f"does not start ({type(error).__name__}: {error})",
        where=name,
        remedy="check that it is plugged in, and that no other program uses it",
    )
