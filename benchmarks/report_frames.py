"""Frame rate of a report's 3D view while it is rotated, in software WebGL.

Opens report.html of a result in a headless Chromium that renders on the CPU (SwiftShader), at the
sizes of a desktop and of a phone, and rotates the model with the pointer for some seconds. Prints
the frame rate (from the median interval), the numbers of triangles drawn in motion and at rest, and
the size of the file. On slow machines the view draws fewer triangles and pixels in motion; the
first second, in which it adapts, is not counted. The browser paints at most 60 frames per second.

    tofuse run RECORDING --out RESULT --voxel 0.008
    python benchmarks/report_frames.py RESULT [--seconds 4]

Needs Chromium and Playwright.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

from tofuse.formats.geometry.ply import read_ply

SIZES = {"desktop": (1280, 900, 1.0), "phone": (390, 844, 2.0)}
FLAGS = ["--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"]
FLAGS += ["--enable-unsafe-swiftshader"]
SETTLING_S = 1.0
# Records when a frame was painted, and its number of triangles.
WATCH = """
  window.painted = [];
  const draw = WebGLRenderingContext.prototype.drawElements;
  WebGLRenderingContext.prototype.drawElements = function (mode, count, ...rest) {
    window.painted.push([performance.now(), count / 3]);
    return draw.call(this, mode, count, ...rest);
  };
"""
# Moves the pointer once per screen frame: events from outside the page are slower.
TURN = """
  (canvas, [x, y, reach]) => {
    const begun = performance.now();
    window.turning = true;
    function move(now) {
      const t = (now - begun) / 1000;
      canvas.dispatchEvent(new PointerEvent("pointermove", {
        pointerId: 1, pointerType: "mouse", isPrimary: true, bubbles: true, buttons: 1,
        clientX: x + reach * Math.sin(2 * t), clientY: y + 0.2 * reach * Math.cos(3 * t),
      }));
      if (window.turning) requestAnimationFrame(move);
    }
    requestAnimationFrame(move);
  }
"""


def measured(page: Any, seconds: float) -> tuple[np.ndarray, float, float]:
    """Return frame intervals in ms in motion, and triangles in motion and at rest."""
    canvas = page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    page.wait_for_function("window.painted.length > 0")
    box = canvas.bounding_box()
    x, y, reach = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2, box["width"] / 4
    page.mouse.move(x, y)
    page.mouse.down()
    page.evaluate("window.painted.length = 0")
    canvas.evaluate(TURN.strip(), [x, y, reach])
    page.wait_for_timeout(1000 * (seconds + SETTLING_S))
    page.evaluate("window.turning = false")
    moving = np.array(page.evaluate("window.painted"))
    page.mouse.up()
    page.evaluate("window.painted.length = 0")
    page.wait_for_function("window.painted.length > 0")
    page.wait_for_timeout(500)
    resting = page.evaluate("window.painted")
    moving = moving[moving[:, 0] > moving[0, 0] + 1000 * SETTLING_S]
    return np.diff(moving[:, 0]), float(np.median(moving[:, 1])), float(resting[-1][1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT")
    parser.add_argument("--seconds", type=float, default=4.0)
    options = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    print("| result | triangles | report MB | screen | frames/s | 95 % ms | moving | at rest |")
    print("|---|---|---|---|---|---|---|---|")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        for result in options.results:
            report = (result / "report.html").resolve()
            faces = len(read_ply(result / "mesh.ply").faces)
            for name, (width, height, scale) in SIZES.items():
                page = browser.new_page(
                    viewport={"width": width, "height": height},
                    device_scale_factor=scale,
                    bypass_csp=True,
                )
                page.add_init_script(WATCH)
                page.goto(report.as_uri())
                gaps, moving, resting = measured(page, options.seconds)
                print(
                    f"| {result.name} | {faces:,} | {report.stat().st_size / 1e6:.1f} | {name} |"
                    f" {1000 / np.median(gaps):.0f} | {np.quantile(gaps, 0.95):.0f} |"
                    f" {moving:,.0f} | {resting:,.0f} |",
                    flush=True,
                )
                page.close()
        browser.close()


if __name__ == "__main__":
    main()
