"""Fixtures that several tests share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from cabinet import Cabinet

# The same examples each time, however long one of them takes on a busy machine.
settings.register_profile("tests", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("tests")


def pytest_configure(config: pytest.Config) -> None:
    """Compile kernels once where several processes share the tests; each would compile its own."""
    several = getattr(config.option, "numprocesses", None)
    if several and not hasattr(config, "workerinput") and not config.option.collectonly:
        from tofuse.engine.compute import ahead

        marker = ahead.compiled_marker()
        if marker is not None and not marker.exists():
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
def cabinet(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Cabinet:
    """Finished recordings and results, kept between test runs where pytest keeps anything."""
    kept = getattr(request.config, "cache", None)
    return Cabinet(kept.mkdir("cabinet") if kept else tmp_path_factory.mktemp("cabinet"))


@pytest.fixture(scope="session")
def room_recording(cabinet: Cabinet) -> Path:
    """A simulated native recording of 8 frames; tests copy it where they change it."""
    from tofuse.lab.simulation.effects import Effects
    from tofuse.lab.simulation.record import simulate

    def make(folder: Path) -> None:
        simulate("room", folder, frames=8, effects=Effects.none(shot_noise=True))

    return cabinet.get("room", make)


@pytest.fixture(scope="session")
def room_result(cabinet: Cabinet, room_recording: Path) -> Path:
    """The result of `tofuse run` on it without options, with its report."""
    from tofuse.apps.cli.program import main

    def make(folder: Path) -> None:
        assert main(["run", str(room_recording), "--out", str(folder), "--threads", "2"]) == 0

    return cabinet.get("room-result", make)


@pytest.fixture(scope="session")
def session_results(cabinet: Cabinet) -> dict[str, Path]:
    """Results of two sessions in a room, and of one in a differently furnished flat of its plan."""
    from made_rooms import OTHER
    from made_sessions import HERE, THERE, made_result

    walks = {"here": HERE[::2], "there": THERE[::2], "elsewhere": THERE[::2]}

    def make(folder: Path) -> None:
        folder.mkdir()
        for number, (name, path) in enumerate(walks.items(), 1):
            scene = {"boxes": OTHER} if name == "elsewhere" else {}
            made_result(folder / name, path, number, **scene)

    folder = cabinet.get("sessions", make)
    return {name: folder / name for name in walks}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A headless Chromium; tests that need it are skipped without one."""
    from browser import chromium

    with chromium() as found:
        yield found


@pytest.fixture(scope="session")
def posed_views(room_recording: Path) -> tuple[list[Any], Any]:
    """Prepared views of the room with their true poses, and these poses (N, 4, 4)."""
    from tofuse.engine.stored_views.view_store import PosedView
    from tofuse.engine.views import SurfaceOptions
    from tofuse.engine.views.prepared_view import prepare_view
    from tofuse.formats.recordings.open import open_recording

    recording = open_recording(room_recording)
    views = [prepare_view(frame, SurfaceOptions()) for frame in recording]
    posed = [PosedView(v, T) for v, T in zip(views, recording.reference, strict=True)]
    return posed, recording.reference
