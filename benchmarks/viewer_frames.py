"""Frame rate of `tofuse view` while its model is rotated, in software WebGL.

Serves a result, opens its page in a headless Chromium that renders on the CPU (SwiftShader), at the
sizes of a desktop and of a phone, and rotates the model with the pointer for some seconds. Prints
the frame rate (from the median interval) and the numbers of triangles of the surface and of
everything drawn in one frame, in motion and at rest. Of a tiled surface the server sends fewer
triangles to a slow browser; the first seconds, in which it adapts, are not counted.

    python benchmarks/viewer_frames.py RESULT [--seconds 6]

Needs Chromium and Playwright.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

from report_frames import FLAGS, SIZES, TURN
from tofuse.viewer.app import ResultView
from tofuse.viewer.content import read_content
from tofuse.viewer.server import address, serve, stop

LOADING_S, SETTLING_S, RESTING_S = 10.0, 4.0, 4.0
# Where the pointer moves, as fractions of the canvas: left of the panel.
PLACE = {"desktop": (0.5, 0.5), "phone": (0.2, 0.25)}
# Records for each screen frame when it began, and the triangles drawn: instances are wide lines.
WATCH = """
  window.painted = [];
  let surface = 0, lines = 0;
  const context = WebGL2RenderingContext.prototype;
  const draw = context.drawElements, instances = context.drawElementsInstanced;
  context.drawElements = function (mode, count, ...rest) {
    if (mode === this.TRIANGLES) surface += count / 3;
    return draw.call(this, mode, count, ...rest);
  };
  context.drawElementsInstanced = function (mode, count, type, offset, number) {
    lines += count / 3 * number;
    return instances.call(this, mode, count, type, offset, number);
  };
  (function next(now) {
    if (surface + lines > 0) window.painted.push([now, surface, surface + lines]);
    surface = lines = 0;
    requestAnimationFrame(next);
  })(performance.now());
"""


def measured(page: Any, at: tuple[float, float], seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (time in ms, triangles of the surface, all triangles) in motion and at rest."""
    canvas = page.locator("canvas").first
    page.wait_for_function("window.painted.length > 0")
    page.wait_for_timeout(1000 * LOADING_S)
    box = canvas.bounding_box()
    x, y = box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.evaluate("window.painted.length = 0")
    canvas.evaluate(TURN.strip(), [x, y, box["width"] / 6])
    page.wait_for_timeout(1000 * (seconds + SETTLING_S))
    moving = np.array(page.evaluate("window.painted"))
    page.evaluate("window.turning = false")
    page.mouse.up()
    page.wait_for_timeout(1000 * RESTING_S)
    page.evaluate("window.painted.length = 0")
    page.wait_for_function("window.painted.length > 1")  # viser renders at rest once a second
    resting = np.array(page.evaluate("window.painted"))
    return moving[moving[:, 0] > moving[0, 0] + 1000 * SETTLING_S], resting


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT")
    parser.add_argument("--seconds", type=float, default=6.0)
    options = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    print("| result | screen | frames/s | 95 % ms | surface moving | all | surface at rest | all |")
    print("|---|---|---|---|---|---|---|---|")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for result in options.results:
            server = serve()
            ResultView(server, read_content(result))
            for name, (width, height, scale) in SIZES.items():
                page = browser.new_page(
                    viewport={"width": width, "height": height},
                    device_scale_factor=scale,
                    bypass_csp=True,
                )
                page.add_init_script(WATCH)
                page.goto(address(server))
                moving, resting = measured(page, PLACE[name], options.seconds)
                gaps = np.diff(moving[:, 0])
                print(
                    f"| {result.name} | {name} | {1000 / np.median(gaps):.0f} |"
                    f" {np.quantile(gaps, 0.95):.0f} |"
                    f" {np.median(moving[:, 1]):,.0f} | {np.median(moving[:, 2]):,.0f} |"
                    f" {resting[-1, 1]:,.0f} | {resting[-1, 2]:,.0f} |",
                    flush=True,
                )
                page.close()
            stop(server)
        browser.close()


if __name__ == "__main__":
    main()
