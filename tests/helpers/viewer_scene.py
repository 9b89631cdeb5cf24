"""The picture of a viewer, read from a browser."""

from __future__ import annotations

import importlib.util

import pytest

from browser import changed

needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="viser is not installed"
)


CANVAS = "canvas[data-engine]"


def drawn(seen):
    """The picture after rendering has settled."""
    last = seen.pixels(CANVAS)
    for _ in range(40):
        seen.page.wait_for_timeout(250)
        now = seen.pixels(CANVAS)
        if changed(last, now) == 0:
            return now
        last = now
    return last
