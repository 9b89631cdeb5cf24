"""The report in a browser: rotation, sliders and switches, on a phone and in dark mode."""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from browser import changed, watched
from report_results import make_room
from tofuse.apps.certainty import LengthErrors
from tofuse.apps.report.html import asset
from tofuse.apps.report.section_model import packed_lengths
from tofuse.apps.report.sections import write_report
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.texture import baked

pytestmark = pytest.mark.nightly

DESK, PHONE = {"width": 1200, "height": 900}, {"width": 360, "height": 800}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    result, extras = make_room()
    write_report(result, path, extras)
    return path


@contextmanager
def opened(browser, report, **options):
    """The report with all that is folded shown."""
    with watched(browser, report.as_uri(), ours=report.as_uri(), **options) as seen:
        seen.page.evaluate(
            "document.querySelectorAll('details').forEach((d) => { d.open = true; })"
        )
        yield seen
        seen.check()


CANVAS = "#viewer .stage canvas"


def rested(seen):
    """The image at rest: with all triangles, and smooth edges."""
    seen.rest()
    return seen.pixels(CANVAS)


def ready(seen):
    seen.page.locator("#viewer.live").wait_for(timeout=20_000)
    return rested(seen)


def middle(page):
    box = page.locator(CANVAS).bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def test_model_rotates_and_toggles_switch(browser, report):
    with opened(browser, report, viewport=DESK) as seen:
        page = seen.page
        first = ready(seen)
        assert len(np.unique(first.reshape(-1, 3), axis=0)) > 50  # something is drawn
        assert changed(first, seen.pixels(CANVAS)) == 0
        x, y = middle(page)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 160, y + 40, steps=4)
        page.mouse.up()
        assert changed(first, rested(seen)) > 0.1
        for name in ("Above", "Front", "Side", "Zoom in", "Zoom out"):
            was = seen.pixels(CANVAS)
            page.get_by_role("button", name=name).click()
            assert changed(was, rested(seen)) > 0.02, name
        page.get_by_role("button", name="Reset").click()
        assert changed(first, rested(seen)) < 0.002
        for name, orange in (("before", True), ("after", False)):
            was = seen.pixels(CANVAS)
            page.locator(f"input[name={name}]").click()
            now = rested(seen)
            assert changed(was, now) > 0.0005, name
            # BGR: the cameras before are orange, those after blue.
            ink = now
            blue, red = ink[..., 0], ink[..., 2]
            strong = (red - blue > 100) if orange else (blue - red > 100)
            assert strong.sum() > 50


def test_two_taps_measure_distance_with_error(browser, report):
    with opened(browser, report, viewport=DESK) as seen:
        page = seen.page
        ready(seen)
        page.get_by_role("button", name="Front").click()
        bright = rested(seen).min(-1) > 70
        page.get_by_role("button", name="Measure").click()
        caption = page.locator("#viewer .measured")
        assert caption.inner_text() == "Tap a point, or two for their distance"
        box = page.locator(CANVAS).bounding_box()

        def tap(left, right):
            rows, columns = np.nonzero(bright[100:500, left:right])
            page.mouse.click(box["x"] + left + int(columns[0]), box["y"] + 100 + int(rows[0]))

        page.mouse.click(box["x"] + 5, box["y"] + box["height"] - 5)
        assert caption.inner_text() == "No surface there: tap the model"
        tap(150, 300)
        beyond = "\nwithout range errors"  # which the points' sigma doesn't contain
        assert re.fullmatch(
            rf"(−?\d\.\d{{3}}(, )?){{3}} m ± [\d.]+ mm{beyond}", caption.inner_text()
        )
        tap(450, 600)
        words = caption.inner_text()
        match = re.fullmatch(rf"([\d.]+) (m|mm) ± ([\d.]+) mm{beyond}", words)
        assert match, words
        # Across a room of 6 m.
        assert 0.5 < float(match[1]) * {"m": 1, "mm": 1e-3}[match[2]] < 6
        assert 2 < float(match[3]) < 150
        page.keyboard.press("Escape")
        assert caption.is_hidden()


def test_page_bounds_lengths_as_python_does(browser):
    rng = np.random.default_rng(4)
    count, cameras = 50, 7
    L = rng.normal(0, 0.003, (6 * cameras, 6 * cameras))
    axes = rng.normal(size=(cameras, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    errors = LengthErrors(
        rng.normal(size=3),
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        rng.integers(0, 2, (count, cameras), np.uint8) * np.uint8(80) + np.uint8(1),
        np.concatenate([rng.normal(size=(cameras, 3)), axes], 1).astype(np.float32),
        rng.normal(0, 3, (count, 3)).astype(np.float32),
        (L @ L.T).astype(np.float32),
        {"focal": 0.01, "offset": 0.004, "scale": 0.02, "range": 0.01, "surface": 0.003},
    )
    ends = rng.normal(0, 3, (20, 2, 3))
    page = browser.new_page()
    names = ("bytes", "eye", "measure")
    scripts = "\n".join(asset(f"js/{name}.js") for name in names)
    bounds = page.evaluate(
        f"async ([packed, ends]) => {{ {scripts}\n"
        "const bound = await makeLengths(packed); return ends.map(([a, b]) => bound(a, b)); }",
        [packed_lengths(errors), ends.tolist()],
    )
    for (a, b), found in zip(ends, bounds, strict=True):
        assert found == pytest.approx(errors.between(a, b).causes_m, rel=1e-5)


def floor_below(cloud) -> Mesh:
    """A floor under the middle of a cloud, as wide as it; y points down."""
    x, z = (coordinate.ravel() for coordinate in np.meshgrid(*2 * [np.linspace(-3, 3, 21)]))
    points = np.stack([x, np.zeros_like(x), z], -1) + np.median(cloud.points, 0)
    k = (np.arange(20) + 21 * np.arange(20)[:, None]).ravel()
    faces = np.concatenate([[k, k + 1, k + 21], [k + 1, k + 22, k + 21]], 1).T
    count = len(points)
    return Mesh(
        points.astype(np.float32),
        faces.astype(np.int32),
        np.tile(np.float32([0, -1, 0]), (count, 1)),
        np.full((count, 3), 200, np.uint8),
        np.full(count, 0.002, np.float32),
        np.full(count, 5, np.int32),
    )


def test_filled_holes_are_not_measured(browser, tmp_path):
    result, extras = make_room()
    made = baked(floor_below(result.cloud), 5000, 512)
    path = tmp_path / "report.html"
    for filled, words in ((0, " m"), (len(made.mesh.faces), "No surface there: tap the model")):
        write_report(result, path, replace(extras, texture=replace(made, filled=filled)))
        with opened(browser, path, viewport=DESK) as seen:
            ready(seen)
            seen.page.get_by_role("button", name="Measure").click()
            seen.page.mouse.click(*middle(seen.page))
            assert words in seen.page.locator("#viewer .measured").inner_text()


def test_page_without_scripts_folds_nothing_empty(browser, report):
    options = {"viewport": PHONE, "java_script_enabled": False}
    with watched(browser, report.as_uri(), ours=report.as_uri(), **options) as seen:
        assert seen.page.get_by_text("A static image").is_visible()
        assert not seen.page.get_by_text("Colours, cameras and views").is_visible()
        seen.check()


def test_phone_scrolls_past_model(browser, report):
    with opened(browser, report, viewport=PHONE, has_touch=True, is_mobile=True) as seen:
        page = seen.page
        first = ready(seen)
        session = page.context.new_cdp_session(page)
        x, y = middle(page)

        def swipe(dx, dy):
            for k in range(9):
                kind = "touchStart" if k == 0 else "touchMove"
                at = [{"x": x + dx * k / 8, "y": y + dy * k / 8}]
                session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})
                page.wait_for_timeout(16)
            session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

        swipe(120, 0)
        assert page.evaluate("scrollY") == 0
        assert changed(first, rested(seen)) > 0.05  # a horizontal swipe rotates it
        swipe(0, -160)
        seen.rest()
        assert page.evaluate("scrollY") > 80


def test_folded_page_is_short_and_links_unfold_it(browser, report):
    address = report.as_uri()
    with watched(browser, address, ours=address, viewport={"width": 400, "height": 800}) as seen:
        page = seen.page
        ready(seen)
        assert page.evaluate("document.documentElement.scrollHeight") < 3 * 800
        plain = page.locator("#summary").inner_text()
        assert re.search(r"[\d.]+ m wide, [\d.]+ m high and [\d.]+ m deep", plain)
        assert page.locator("#frames").is_hidden()
        page.evaluate("document.querySelector('a[href=\"#frames\"]').click()")
        assert page.locator("#frames").is_visible()
        seen.check()


def test_slider_shows_frames_and_reason_of_loss(browser, report):
    with opened(browser, report, viewport=DESK) as seen:
        page = seen.page
        shot = "#player img[data-kind=range]"
        first = seen.pixels(shot)
        yellow = ready(seen)
        page.locator("#frame").focus()
        page.keyboard.press("ArrowRight")
        page.keyboard.press("ArrowRight")
        seen.rest()
        assert page.locator("#frame-description").inner_text().startswith("Frame 4: tracked")
        assert changed(first, seen.pixels(shot)) > 0.1
        assert changed(yellow, seen.pixels(CANVAS)) > 0.0002  # another camera is selected
        page.get_by_role("button", name="Next with a problem").click()
        caption = page.locator("#frame-description").inner_text()
        assert caption.startswith("Frame 10: lost – too few correspondences: 31 of 1000")
        page.locator("#strip rect[data-frame='0']").click(force=True)
        assert page.locator("#frame-description").inner_text().startswith("Frame 0:")


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")])
def test_layout_follows_scheme_and_screen_size(browser, report, scheme, size):
    with opened(browser, report, viewport=size, color_scheme=scheme) as seen:
        page = seen.page
        brightness = page.evaluate(
            "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)"
        )
        assert (min(brightness) > 200) == (scheme == "light")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        ready(seen)
        for buttons in (".tools button", ".controls .group button"):
            tops = page.locator(buttons).evaluate_all("all => all.map((b) => b.offsetTop)")
            assert len(set(tops)) == 1, buttons
        # The model fills the canvas, except for a border on all sides.
        bright = seen.pixels(CANVAS)[8:-8, 8:-8].max(-1) > 60  # the corners are rounded
        rows, columns = bright.any(1), bright.any(0)
        assert not rows[[0, -1]].any()
        assert not columns[[0, -1]].any()
        assert max(rows.mean(), columns.mean()) > 0.7


def test_charts_are_drawn_when_seen_and_follow_pointer_and_theme(browser, report):
    with opened(browser, report, viewport=DESK, color_scheme="light") as seen:
        page = seen.page
        charts = page.locator("#error [data-chart]")
        assert page.locator("[data-chart] canvas").count() < page.locator("[data-chart]").count()
        charts.first.scroll_into_view_if_needed()
        charts.first.locator("canvas").wait_for()
        light = seen.pixels("#error [data-chart] >> nth=0")
        orange = light[..., 2] - light[..., 0] > 60  # BGR: the line before optimisation
        assert orange.sum() > 100
        box = charts.first.bounding_box()
        page.mouse.move(box["x"] + 0.9 * box["width"], box["y"] + 60)
        readout = page.locator("#error .chart span").first
        assert re.fullmatch(r"frame 2\d: before 0\.\d+, after 0\.\d+", readout.inner_text())
        page.mouse.move(1, 1)
        assert readout.inner_text() == ""
        page.emulate_media(color_scheme="dark")
        seen.rest()
        dark = seen.pixels("#error [data-chart] >> nth=0")
        assert light[:4, :4].min() > 200 > 60 > dark[:4, :4].max()
        # Redrawn with the lighter orange.
        assert ((dark[..., 2] > 225) & (dark[..., 0] < 120)).sum() > 50
        page.set_viewport_size(PHONE)
        seen.rest()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert charts.first.locator("canvas").bounding_box()["width"] > 300


def test_chart_in_closed_details_is_drawn_on_opening(browser, report, tmp_path):
    text = report.read_text(encoding="utf-8")
    before, section, rest = text.partition('<section id="objective">')
    folded = rest.replace("</section>", "</details></section>", 1)
    path = tmp_path / "folded.html"
    path.write_text(f"{before}{section}<details><summary>more</summary>{folded}", encoding="utf-8")
    with watched(browser, path.as_uri(), ours=path.as_uri(), viewport=DESK) as seen:
        seen.page.evaluate("document.querySelector('#details').open = true")
        details = seen.page.locator("#objective details")
        details.scroll_into_view_if_needed()
        seen.rest()
        assert details.locator("canvas").count() == 0
        details.locator("summary").click()
        details.locator("canvas").wait_for()
        assert details.locator("canvas").bounding_box()["width"] > 300
        seen.check()
