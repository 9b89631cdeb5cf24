"""The report in a browser: it turns, slides and switches, on a phone and in the dark."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from browser import changed, chromium, watched
from test_report_html import make_room
from tofuse.report.html import write_report
from tofuse.report.pictures import draw
from tofuse.results.samples import FrameSample, FrameSamples

DESK, PHONE = {"width": 1200, "height": 900}, {"width": 390, "height": 800}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    result, extras = make_room()
    write_report(result, path, extras)
    return path


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def opened(browser, report, **options):
    return watched(browser, report.as_uri(), ours=report.as_uri(), **options)


def test_model_turns_and_toggles_switch(browser, report, tmp_path):
    with opened(browser, report, viewport=DESK) as seen:
        page = seen.page
        page.locator("#viewer.live").wait_for(timeout=20_000)
        page.wait_for_timeout(200)
        first = seen.pixels("#viewer canvas")
        assert len(np.unique(first.reshape(-1, 3), axis=0)) > 50  # something is drawn
        again = seen.pixels("#viewer canvas")
        assert changed(first, again) == 0
        box = page.locator("#viewer canvas").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 160, y + 40, steps=4)
        page.mouse.up()
        page.wait_for_timeout(200)
        turned = seen.pixels("#viewer canvas")
        assert changed(first, turned) > 0.1
        page.get_by_role("button", name="Reset").click()
        page.wait_for_timeout(200)
        assert changed(first, seen.pixels("#viewer canvas")) < 0.002
        for name, orange in (("before", True), ("after", False)):
            was = seen.pixels("#viewer canvas")
            page.locator(f"input[name={name}]").click()
            page.wait_for_timeout(200)
            now = seen.pixels("#viewer canvas")
            assert changed(was, now) > 0.0005, name
            # BGR: the cameras before are orange, those after blue.
            ink = now if orange else was
            blue, red = ink[..., 0], ink[..., 2]
            strong = (red - blue > 120) if orange else (blue - red > 120)
            assert strong.sum() > 50
        bar = page.locator("#viewer .bar")
        assert bar.is_hidden()
        for by, end in (("height", "0"), ("accuracy", "±"), ("views", "")):
            was = seen.pixels("#viewer canvas")
            page.select_option("select[name=by]", by)
            page.wait_for_timeout(200)
            assert changed(was, seen.pixels("#viewer canvas")) > 0.01, by
            assert bar.locator("span").first.inner_text().startswith(end)
        page.screenshot(path=tmp_path / "desk.png", full_page=True)
        seen.check()


def test_slider_shows_frames_and_why_one_is_lost(browser, report, tmp_path):
    with opened(browser, report, viewport=DESK) as seen:
        page = seen.page
        shot = "#player img[data-kind=range]"
        first = seen.pixels(shot)
        yellow = seen.pixels("#viewer canvas")
        page.locator("#frame").focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        page.wait_for_timeout(200)
        assert page.locator("#frame-said").inner_text().startswith("Frame 4: tracked")
        assert changed(first, seen.pixels(shot)) > 0.1
        assert changed(yellow, seen.pixels("#viewer canvas")) > 0.0002  # another camera is chosen
        page.get_by_role("button", name="Next with a problem").click()
        said = page.locator("#frame-said").inner_text()
        assert said.startswith("Frame 10: lost – too few correspondences: 31 of 1000")
        page.locator("#strip rect[data-frame='0']").click(force=True)
        assert page.locator("#frame-said").inner_text().startswith("Frame 0:")
        page.locator("#player").screenshot(path=tmp_path / "player.png")
        seen.check()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_looks_follow_the_reader(browser, report, tmp_path, scheme, size):
    with opened(browser, report, viewport=size, color_scheme=scheme) as seen:
        page = seen.page
        brightness = page.evaluate(
            "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)"
        )
        assert (min(brightness) > 200) == (scheme == "light")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.screenshot(path=tmp_path / f"{scheme}.png", full_page=True)
        page.locator("#viewer.live").wait_for(timeout=20_000)
        page.wait_for_timeout(200)
        # The model fills the canvas, all but a border on all sides.
        bright = seen.pixels("#viewer canvas")[8:-8, 8:-8].max(-1) > 60  # its corners are round
        rows, columns = bright.any(1), bright.any(0)
        assert not rows[[0, -1]].any()
        assert not columns[[0, -1]].any()
        assert max(rows.mean(), columns.mean()) > 0.7
        seen.check()


def test_without_scripts_there_is_a_picture_and_the_first_frame(browser, report):
    with opened(browser, report, viewport=PHONE, java_script_enabled=False) as seen:
        assert seen.page.locator("#viewer img").is_visible()
        assert seen.page.locator("#player img").first.is_visible()
        assert not seen.page.locator("#frame").is_visible()
        seen.check()


def test_a_long_recording_of_large_images_stays_below_the_limit(tmp_path):
    result, extras = make_room()
    rng = np.random.default_rng(0)
    collector = FrameSamples()
    color = rng.integers(0, 255, (131, 176, 3)).astype(np.uint8)
    depth = rng.uniform(1, 5, (131, 176)).astype(np.float16)
    taken = FrameSample(0, depth, (depth > 2).astype(np.uint8), depth.astype(np.float32), color)
    for k in range(3000):
        collector.take(lost=k % 7 == 0, make=partial(replace, taken, index=k))
    kept = collector.all
    assert 80 <= len(kept) <= 200
    assert sum(s.index % 7 == 0 for s in kept) >= 20
    # Pure noise, the worst there is for an image format, in all of them.
    detailed = replace(result, diagnostics=replace(result.diagnostics, samples=kept))
    write_report(detailed, tmp_path / "r.html", replace(extras, pictures=draw(kept)))
    assert (tmp_path / "r.html").stat().st_size < 20e6
