"""Does a camera card find a drift of the camera, and does it warn without one?

    python benchmarks/card.py [seeds]
    python benchmarks/card.py --picture docs/images/card.png

A pool of short sessions is simulated (80 x 60 pixels, 48 frames; each seed once in a room and
once in a flat, with another motion and noise) and reconstructed four times: as they are, with a
camera that states a focal length 1 % too long, with ranges 5 mm too long, and with 1.5 times the
noise. A campaign is a number of sessions drawn from the pool; a drift begins after half of them.
Prints the scatter of the sessions in units of their sigmas, the share of campaigns in which the
card warns, and the change of the ranges that it says it would find (median of the campaigns). The
picture is the top of the card of a campaign whose values are drawn with these sigmas and scatter.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

import situations
import stress
import tofuse
from tofuse.apps.card.collecting import Identity, Session, values_of
from tofuse.apps.card.drift import drift_of, holm
from tofuse.apps.card.making import QUANTITIES, SIGNIFICANCE, card_of
from tofuse.apps.card.page import write_page
from tofuse.engine.frames.frames import RangeFrame
from tofuse.lab.simulation.models import noise_of
from variants import Take

Change = Callable[[RangeFrame], RangeFrame]
Values = dict[str, tuple[float, float]]
CAMPAIGNS, SIZES = 2000, (4, 8, 16)
CHANGES: dict[str, Change] = {
    "no drift": lambda frame: frame,
    "focal length by 1 %": lambda frame: stress.lens_off(frame, fx=1.01, fy=1.01),
    "ranges by 5 mm": lambda frame: stress.farther(frame, 0.005),
    "noise by half": lambda frame: noisier(frame, 1.5),
}


def noisier(frame: RangeFrame, factor: float) -> RangeFrame:
    """Add noise to ranges, so that it is larger by a factor."""
    law = noise_of(situations.CAMERA).range
    sigma = (law.a + law.b * frame.depth.astype(float) ** 2) * np.sqrt(factor**2 - 1)
    added = sigma * np.random.default_rng([frame.index, 9]).standard_normal(frame.depth.shape)
    moved = np.where(frame.depth > 0, frame.depth + added, 0)
    return replace(frame, depth=moved.astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=int, nargs="?", default=12)
    parser.add_argument("--picture", type=Path, help="only draw this picture")
    options = parser.parse_args()
    if options.picture is not None:
        draw(options.picture)
        return
    seeds = options.seeds
    pool = pool_of(seeds)
    print(f"{len(pool)} sessions\n")
    print("| quantity | sigma (median) | scatter (in sigmas) |\n|---|---|---|")
    for name in pool[0]["no drift"]:
        found = np.array([s["no drift"][name] for s in pool if name in s["no drift"]])
        whole = drift_of(np.arange(len(found)), *found.T, trend=False)
        quantity = QUANTITIES[name]
        print(
            f"| {quantity.label} | {quantity.text(np.median(found[:, 1]))} | {whole.scatter:.1f} |"
        )
    print("\n| sessions | " + " | ".join(CHANGES) + " | found of the ranges, mm |")
    print("|---|" + "---|" * (len(CHANGES) + 1))
    places = {"two places": pool, "the room": pool[::2], "the flat": pool[1::2]}
    for place, sessions in places.items():
        for size in (size for size in SIZES if size <= len(sessions)):
            columns = [f"{warned(sessions, size, change):.1%}" for change in CHANGES]
            columns.append(f"{1e3 * detectable(sessions, size):.0f}")
            print(f"| {size} in {place} | " + " | ".join(columns) + " |")


def pool_of(seeds: int) -> list[dict[str, Values]]:
    """Return what the card reads of each session, by the change."""
    pool = []
    for seed in range(seeds):
        for scene in (situations.room, situations.flat):
            take = scene(seed)
            pool.append({name: values(take.each(change)) for name, change in CHANGES.items()})
            print(f"seed {seed}, {scene.__name__}", file=sys.stderr)
    return pool


def values(take: Take) -> Values:
    result = tofuse.reconstruct(take.as_recording(), threads=1)
    refined = result.diagnostics.refinement
    check = None if refined is None else refined.calibration_check
    corrections = {each["part"]: each for each in result.config["corrections"]}
    # By the true lens: a wrong one is stated in the place of a lens that changes.
    lens = situations.CAMERA.camera
    rms = np.array([f.rms_m for f in result.diagnostics.frames if f.rms_m])
    return {} if check is None else values_of(check.estimates, corrections, lens, rms)


def warned(pool: list[dict[str, Values]], size: int, change: str) -> float:
    """Share of the campaigns in which a quantity is said to change."""
    rng = np.random.default_rng(0)
    count = 0
    for _ in range(CAMPAIGNS):
        drawn = rng.choice(len(pool), size, replace=False)
        sessions = [pool[k]["no drift" if i < size // 2 else change] for i, k in enumerate(drawn)]
        tests = []
        for name in QUANTITIES:
            rows = [(i, *s[name]) for i, s in enumerate(sessions) if name in s]
            if len(rows) > 1:
                tests.append(drift_of(*np.array(rows).T, trend=len(rows) > 3).p_alone)
        count += min(holm(tests)) < SIGNIFICANCE
    return count / CAMPAIGNS


def detectable(pool: list[dict[str, Values]], size: int) -> float:
    """Change of the range offset that is found in 95 % of cameras, by the card."""
    rng = np.random.default_rng(0)
    limits = []
    for _ in range(CAMPAIGNS // 10):
        drawn = [pool[k]["no drift"] for k in rng.choice(len(pool), size, replace=False)]
        rows = np.array([(i, *s["offset"]) for i, s in enumerate(drawn) if "offset" in s])
        if len(rows) > 3:
            limits.append(drift_of(*rows.T, trend=True).detectable(len(QUANTITIES)))
    return float(np.median(limits)) if limits else np.nan


def draw(path: Path) -> None:
    """Draw the card of a camera whose focal length changes by 1 % after half of 16 sessions."""
    rng = np.random.default_rng(0)
    truth = {"focal": (69.3, 0.11), "offset": (0.0, 0.0045), "center_x": (39.5, 0.04)}
    sessions = []
    for k in range(16):
        values = {
            name: (value * (1.01 if name == "focal" and k > 7 else 1) + 1.8 * sigma * error, sigma)
            for (name, (value, sigma)), error in zip(truth.items(), rng.normal(size=3), strict=True)
        }
        sessions.append(
            Session(f"scan{k + 1:02}/result", 86400 * (19_800 + 25 * k), False, values, None)
        )
    card = card_of(Identity("ifm O3R (ToF)", "17", (80, 60)), sessions)
    chromium = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        write_page(card, Path(folder) / "card.html")
        browser = playwright.chromium.launch(executable_path=chromium)
        page = browser.new_page(viewport={"width": 900, "height": 720})
        page.goto((Path(folder) / "card.html").as_uri())
        page.screenshot(path=path)
        browser.close()


if __name__ == "__main__":
    main()
