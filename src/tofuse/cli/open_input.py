"""Opening the recording that the arguments of a command name."""

from __future__ import annotations

import argparse

from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording


def open_input(arguments: argparse.Namespace) -> Recording:
    """Open INPUT with --format, --camera and --topic; see `open_recording` for errors."""
    return open_recording(
        *arguments.inputs,
        format=arguments.format,
        camera=arguments.camera,
        topic=arguments.topic,
    )


def open_selection(arguments: argparse.Namespace) -> Recording:
    """Open INPUT, and select the frames of --start, --end and --every."""
    return open_input(arguments).select(arguments.start, arguments.end, arguments.every)
