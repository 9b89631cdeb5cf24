"""A headless Chromium without access to anything but the page of a test."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pytest

FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
]  # fmt: skip
# A message that screenshots of WebGL cause.
_OWN = "GPU stall due to ReadPixels"
# The time when an animation frame was last requested or drawn, or the page scrolled.
_MOTION = """
  window.moved = performance.now();
  const moved = () => { window.moved = performance.now(); };
  const request = requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (draw) => {
    moved();
    return request((now) => { draw(now); moved(); });
  };
  addEventListener("scroll", moved, { capture: true, passive: true });
"""
_REST_MS = 350  # longer than the report waits before it draws the scene at rest


@contextmanager
def chromium() -> Iterator[Any]:
    """Start Chromium; skip the test if there is none."""
    api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next((found for found in map(shutil.which, names) if found), None)
    if path is None:
        pytest.skip("no Chromium on this machine")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield browser
        browser.close()


@dataclass
class Watched:
    """A page with its errors and its external requests."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)

    def rest(self) -> None:
        """Wait until nothing moves."""
        left = f"{_REST_MS} - (performance.now() - window.moved)"
        while (ms := self.page.evaluate(left)) > 0:
            self.page.wait_for_timeout(ms)

    def pixels(self, selector: str) -> np.ndarray:
        """Screenshot of an element, (H, W, 3)."""
        data = np.frombuffer(self.page.locator(selector).screenshot(), np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_COLOR).astype(int)

    def check(self) -> None:
        """Fail if there was any error or external request."""
        assert self.complaints == []
        assert self.outside == []


@contextmanager
def watched(browser: Any, address: str, *, ours: str, **options: Any) -> Iterator[Watched]:
    """Open a page; requests that do not begin with `ours` are blocked and recorded."""
    context = browser.new_context(**options)
    if options.get("java_script_enabled", True):
        context.add_init_script(_MOTION)
    out = Watched(context.new_page())

    def decide(route: Any) -> None:
        url = route.request.url
        if url.startswith((ours, "data:", "blob:")):
            route.continue_()
        else:
            out.outside.append(url)
            route.abort()

    context.route("**/*", decide)
    out.page.on("pageerror", lambda error: out.complaints.append(str(error)))
    out.page.on("console", lambda message: _record_error(out, message))
    try:
        out.page.goto(address)
        yield out
    finally:
        context.close()


def _record_error(out: Watched, message: Any) -> None:
    if message.type == "error" and _OWN not in message.text:
        out.complaints.append(f"{message.text} ({message.location})")


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of pixels that differ clearly; 1 if the size does."""
    if before.shape != after.shape:
        return 1.0
    return float((np.abs(before - after).max(-1) > 24).mean())
