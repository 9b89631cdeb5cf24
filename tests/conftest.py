"""Fixtures that several tests share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# The same examples each time, however long one of them takes on a busy machine.
settings.register_profile("tests", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("tests")


def pytest_configure(config: pytest.Config) -> None:
    """Compile kernels once where several processes share the tests; each would compile its own."""
    several = getattr(config.option, "numprocesses", None)
    if several and not hasattr(config, "workerinput") and not config.option.collectonly:
        from tofuse.engine.compute import ahead

        if not ahead.compiled_marker().exists():
            with ahead.compiling_in_background():
                ahead.compile_listed(1, 2)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real recordings outside the project; tests that need it are skipped without it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real recordings are not on this machine (../shared/data)")
    return folder


@pytest.fixture(scope="session")
def room_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated native recording of 8 frames; tests copy it where they change it."""
    from tofuse.lab.simulation.effects import Effects
    from tofuse.lab.simulation.record import simulate

    folder = tmp_path_factory.mktemp("simulated") / "room"
    return simulate("room", folder, frames=8, effects=Effects.none(shot_noise=True))


@pytest.fixture(scope="session")
def posed_views(room_recording: Path) -> tuple[list[Any], Any]:
    """Prepared views of the room with their true poses, and these poses (N, 4, 4)."""
    from tofuse.engine.views.surface_options import SurfaceOptions

    from tofuse.engine.stored_views.view_store import PosedView
    from tofuse.engine.views.prepared_view import prepare_view
    from tofuse.formats.recordings.open import open_recording

    recording = open_recording(room_recording)
    views = [prepare_view(frame, SurfaceOptions()) for frame in recording]
    posed = [PosedView(v, T) for v, T in zip(views, recording.reference, strict=True)]
    return posed, recording.reference
