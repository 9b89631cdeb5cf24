"""Fixtures of the tests of the pose graph."""

from __future__ import annotations

import pytest

import tofuse
from tofuse.engine.stored_views.view_store import PosedView
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions


@pytest.fixture(scope="module")
def posed_views(room_recording):
    """Prepared views of the room with their true poses, and these poses (N, 4, 4)."""
    recording = tofuse.open(room_recording)
    prepared = [prepare_view(frame, SurfaceOptions()) for frame in recording]
    truth = recording.reference
    return [PosedView(v, T) for v, T in zip(prepared, truth, strict=True)], truth
