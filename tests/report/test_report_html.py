"""The report: a single valid file that states the results."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from functools import cache, partial
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from report_results import lonely, make_room
from tofuse.apps.report import plots
from tofuse.apps.report.extras import ReportExtras
from tofuse.apps.report.fields import fields
from tofuse.apps.report.packing import pack
from tofuse.apps.report.scene import make_scene, packed
from tofuse.apps.report.section_frames import path_length
from tofuse.apps.report.sections import write_report
from tofuse.apps.report.subject import Subject
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import OutputError
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.fusion.cloud import Cloud, empty_cloud
from tofuse.engine.fusion.drawing import display_colors
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.pose_errors import UNKNOWN_M
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import LoopRecord
from tofuse.engine.quality.frame_samples import FrameSample, FrameSamples
from tofuse.engine.results.types import Component, FrameRecord, Reason, SessionRecord
from unpacked import unpack


@cache
def room():
    return make_room()


class Page(HTMLParser):
    """Text of each section and of all tables, addresses, identifiers; tags must balance."""

    VOID = frozenset({"meta", "link", "img", "br", "input", "hr"})

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.sections, self.links, self.ids, self.scripts = [], {}, [], [], []
        self.rows, self.images, self.titles, self.charts = [], [], [], []
        self.section, self.text = None, text
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "section":
            self.section = attrs["id"]
            self.sections[self.section] = ""
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if "data-chart" in attrs:
            self.charts.append(json.loads(attrs["data-chart"]))
            assert attrs["aria-label"] == self.charts[-1]["label"]
        if tag == "img":
            assert attrs["alt"]
            self.images.append(attrs["src"])
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.links += [v for k, v in attrs.items() if k in ("href", "src", "xlink:href", "action")]

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        if tag == "section":
            self.section = None

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)
            return
        if self.open and self.open[-1] == "title" and "svg" in self.open:
            self.titles.append(data)
        if self.section:
            self.sections[self.section] += data
        if "td" in self.open or "th" in self.open:
            self.rows[-1][-1] += data

    def row(self, *start):
        """The only table row that starts with these cells."""
        (found,) = [r for r in self.rows if tuple(r[: len(start)]) == start]
        return found


def page(folder, result, extras):
    path = Path(folder) / "report.html"
    write_report(result, path, extras)
    assert [p.name for p in Path(folder).iterdir()] == ["report.html"]
    return Page(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    return page(tmp_path_factory.mktemp("room"), *room())


ORDER = [
    "model", "summary", "verdict", "frames", "views", "error", "objective", "filters", "loops",
    "recording", "timings", "settings", "reading",
]  # fmt: skip


def test_model_is_shown_alone_at_first(shown):
    boxes = re.findall(r'type="checkbox" name="(\w+)"[^>]*?( checked)?>', shown.text)
    checked = {name for name, on in boxes if on}
    assert checked & {"mesh", "points"}
    assert not checked & {"after", "before", "reference", "loops"}


def test_sections_are_ordered_with_model_first(shown):
    assert list(shown.sections) == [name for name in ORDER if name != "recording"]
    text = " ".join(shown.sections["verdict"].split())
    assert "Degraded: use this model with care." in text
    assert "2 readable frames have no pose (frames 9-10)." in text
    for name, number in (("tracked", 20), ("predicted", 1), ("lost", 2), ("skipped", 1)):
        assert f"frames {name}{number}" in shown.sections["frames"]
    assert f"{len(room()[0].cloud):,} points" in shown.sections["frames"]


def test_page_has_no_external_resources(shown):
    assert shown.links
    assert all(link.startswith(("#", "data:")) for link in shown.links)
    text = shown.text.replace("/*! https://github.com/leeoniya/uPlot ", "")  # its only address
    assert "://" not in text
    assert "@import" not in text
    assert "default-src 'none'" in text
    assert not re.search(r"url\((?!#)", text)
    assert len(text) < 20e6


def test_identifiers_are_unique_and_links_resolve(shown):
    assert len(shown.ids) == len(set(shown.ids))
    anchors = {link[1:] for link in shown.links if link.startswith("#")}
    assert anchors <= set(shown.ids)
    assert set(ORDER) - {"recording", "summary"} <= anchors


def test_same_result_gives_same_file(shown, tmp_path):
    assert page(tmp_path, *room()).text == shown.text


def test_errors_are_relative_to_reference(shown):
    result, extras = room()
    assert "Estimated minus reference" in shown.sections["error"]
    for name, poses in (("Before", result.diagnostics.sequential), ("After", result.trajectory)):
        error = poses[:, :3, 3] - extras.reference[:, :3, 3]
        error = error[np.isfinite(error[:, 0])]
        row = shown.row(f"{name}, rms")
        expected = [*np.sqrt((error**2).mean(0)), np.sqrt((error**2).sum(1).mean())]
        for cell, value in zip(row[1:5], expected, strict=True):
            number, unit = cell.split()
            assert float(number) * {"mm": 1e-3, "m": 1}[unit] == pytest.approx(value, rel=0.06)
    last = se3.angle(se3.inverse(extras.reference[-1]) @ result.diagnostics.sequential[-1])
    assert shown.row("Before, last frame")[5] == f"{np.degrees(last):.2f}°"
    moved = result.trajectory[:, :3, 3] - result.diagnostics.sequential[:, :3, 3]
    worst = np.nanargmax(np.linalg.norm(moved, axis=1))
    assert f"most at frame {worst}." in shown.sections["error"]


@pytest.mark.parametrize("exact", [True, False])
def test_rotated_model_is_measured_along_its_own_sides(exact, tmp_path):
    rng = np.random.default_rng(2)
    surface = rng.uniform(-0.5, 0.5, (20_000, 3))
    axis = rng.integers(0, 3, len(surface))
    surface[np.arange(len(surface)), axis] = rng.choice([-0.5, 0.5], len(surface))
    box = surface * [0.3, 0.4, 0.6]
    points = se3.transform(se3.exp([0.2, 0, 1, 0, 0.4, 0]), box).astype(np.float32)
    cloud = Cloud(points, None, None, np.ones(len(points), np.int32))
    extras = ReportExtras("x", truth_points=points if exact else None)
    got = page(tmp_path, lonely(cloud=cloud), extras)
    for name, size in (("width", 0.3), ("height", 0.4), ("depth", 0.6)):
        for cell in got.row(name)[1:3]:
            assert float(cell.split()[0]) == pytest.approx(size, abs=0.011)


def test_frames_without_colour_show_their_range(tmp_path):
    """Some apps store a colour image with every fifth frame only."""
    depth, fate = np.ones((3, 4), np.float16), np.zeros((3, 4), np.uint8)
    colors = (None, np.full((3, 4, 3), 99, np.uint8))
    samples = tuple(FrameSample(k, depth, fate, None, color) for k, color in enumerate(colors))
    frames = tuple(FrameRecord(k, 0.1 * k, "tracked") for k in range(2))
    got = page(tmp_path, lonely(samples=samples, frames=frames), ReportExtras("x"))
    (text,) = re.findall(r'<script type="application/json" id="pictures">(.*?)</script>', got.text)
    images = json.loads(text)["images"]
    assert [bool(image) for image in images["color"]] == [False, True]
    assert all(images["range"])
    assert re.search(r'data-kind="color" src="data:,"\s+hidden', got.text)


@pytest.mark.parametrize(
    ("up", "turn"),
    [
        ((-1, 0, 0), "90"),
        ((0.1, 1, 0), "180"),
        ((1, 0, -1), "270"),
        ((0, -1, 0), ""),
        ((0, 0, 1), ""),
    ],
)
def test_images_of_a_turned_camera_are_upright(up, turn, tmp_path):
    got = page(tmp_path, lonely(up=np.array(up, float)), ReportExtras("x"))
    assert re.findall(r"transform: rotate\((\d+)deg\)", got.text) == [turn] * bool(turn)


def test_summary_shows_where_its_advice_applies(tmp_path):
    frames = tuple(FrameRecord(k, 0.1 * k, "tracked") for k in range(9))
    for ranges, links in ((((3, 4),), 1), (((0, 8),), 0)):
        reasons = (Reason("unobserved_motion", ranges, ""),)
        result = lonely(verdict="degraded", reasons=reasons, frames=frames)
        assert page(tmp_path, result, ReportExtras("x")).text.count(">Show where<") == links


def test_reasons_name_their_frames(tmp_path):
    frames = tuple(FrameRecord(k, 0.1 * k, "tracked") for k in range(90))
    reason = Reason("images_differ", ((3, 4), (20, 34), (50, 50)), "Surfaces do not agree.")
    result = lonely(verdict="degraded", reasons=(reason,), frames=frames)
    text = page(tmp_path, result, ReportExtras("x")).sections["verdict"]
    assert "Surfaces do not agree (frames 3-4, 20-34, 50)." in " ".join(text.split())


def test_summary_of_a_single_image_speaks_of_no_parts(tmp_path):
    summary = page(tmp_path, lonely(verdict="degraded"), ReportExtras("x")).sections["summary"]
    assert "deep, and was seen by a single image." in " ".join(summary.split())


def test_a_single_image_has_no_accuracy_of_its_pose(tmp_path):
    first = FrameRecord(0, 0.0, "tracked", covariance=np.zeros((6, 6)))
    cloud = replace(lonely().cloud, sigma=np.full(3, 0.01, np.float32))
    got = page(tmp_path, lonely(frames=(first,), cloud=cloud), ReportExtras("x"))
    scene = json.loads(got.scripts[0])
    assert scene["frames"]["errors"] is None
    assert scene["fields"]["accuracy"]["labels"][0] == "±20 mm"
    assert "accuracy below" not in got.text


def test_summary_names_the_fault_of_the_recording(tmp_path):
    text = "The median depth is 11 m. Check depth_unit_m."
    result = lonely(verdict="degraded", reasons=(Reason("faulty_recording", ((0, 0),), text),))
    assert text in " ".join(page(tmp_path, result, ReportExtras("x")).sections["summary"].split())


def test_surface_without_triangles_is_counted(tmp_path):
    record = GeometryRecord(np.zeros((0, 3)), faces=np.zeros((0, 3), np.int32))
    got = page(tmp_path, replace(lonely(), mesh=Mesh.of(record)), ReportExtras("x"))
    assert "0 triangles" in got.sections["frames"]


def test_filter_used_twice_removes_a_fraction_of_what_reached_it_first(tmp_path):
    first = unlit()
    first = replace(first, depth=np.ones_like(first.depth))
    halves = [replace(first, depth=first.depth.copy()) for _ in range(2)]
    for frame, columns in zip(halves, (4, 8), strict=True):
        frame.depth[:, :columns] = 0
    share = f"{100 * 8 / first.depth.shape[1]:.0f} %"
    steps = (("raw", first), ("confidence", halves[0]), ("confidence", halves[1]))
    assert share in page(tmp_path, lonely(), ReportExtras("x", steps)).sections["filters"]


def in_parts(number=20):
    """Frames 0 to 9 in the main component, 10 and 11 linked to it, the rest separate."""
    result = many(number)
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(number)
    poses[12:] = np.nan
    component = [0] * 10 + [1] * 2 + [2] * (number - 14) + [3] * 2
    frames = tuple(FrameRecord(k, k / 10, "tracked", component=c) for k, c in enumerate(component))
    components = (
        Component(((0, 9),), np.eye(4), None),
        Component(((10, 11),), np.eye(4), "links"),
        Component(((12, number - 3),), None, None, lonely()),
        Component(((number - 2, number - 1),), None, None),
    )
    diagnostics = replace(result.diagnostics, frames=frames, sequential=poses, loops=())
    return replace(result, trajectory=poses, diagnostics=diagnostics, components=components)


@pytest.mark.nightly_part
def test_components_are_listed_with_their_own_models(tmp_path):
    got = page(tmp_path, in_parts(), ReportExtras("x"))
    assert got.row("0 (main)")[1:] == ["0–9", "this one", "–", "10"]
    assert got.row("1")[1:] == ["10–11", "this one", "links between views", "2"]
    assert got.row("2")[1:] == ["12–17", "component-2", "not connected", "6"]
    assert got.row("3")[1:] == ["18–19", "none: too few frames", "not connected", "2"]
    assert "2 of them could not be connected" in " ".join(got.sections["components"].split())
    assert got.links.count("component-2/report.html") == 1
    assert "#components" in got.links
    assert any(t.endswith("component 2 (not connected to the main one)") for t in got.titles)
    assert any(t.endswith("component 1") for t in got.titles)
    assert "not all of them could be connected" in got.sections["frames"]
    one = replace(in_parts(), components=in_parts().components[:1])
    records = tuple(replace(r, component=0) for r in one.diagnostics.frames)
    one = replace(one, diagnostics=replace(one.diagnostics, frames=records))
    plain = page(tmp_path, one, ReportExtras("x"))
    assert "components" not in plain.sections
    assert not any("component" in t for t in plain.titles)


def test_lost_frames_state_their_reason(shown):
    assert len([t for t in shown.titles if t.startswith("Frame ")]) == 24
    lost = "Frame 9: lost – too few correspondences: 31 of 1000"
    assert any(title.startswith(lost) for title in shown.titles)
    assert shown.row("frames 9–10")[1:] == ["2", "lost", "too few correspondences: 31 of 1000"]
    assert shown.row("frame 15")[2:] == ["skipped", "depth/000015.png: is truncated"]


def test_path_length_excludes_steps_between_cameras_and_sessions():
    result, _ = make_room()
    walk = np.tile(np.eye(4), (24, 1, 1))
    camera = np.arange(24) % 2
    walk[:, 0, 3] = 0.1 * (np.arange(24) // 2)
    walk[:, 1, 3] = 5.0 * camera  # two cameras of a rig, 5 m apart
    rig = {**result.recording, "rig": {"cameras": ["a", "b"], "of_frames": camera.tolist()}}
    result = replace(result, trajectory=walk, recording=rig)
    assert path_length(Subject.of(result, ReportExtras("room"))) == pytest.approx(1.1)
    sessions = tuple(SessionRecord(n, n, {}, {}, 12 * k, 12, np.eye(4)) for k, n in enumerate("ab"))
    walk = np.tile(np.eye(4), (24, 1, 1))
    walk[:, 0, 3] = np.where(np.arange(24) < 12, 0.1, -0.2) * np.arange(24)
    result = replace(result, trajectory=walk, recording={}, sessions=sessions)
    assert path_length(Subject.of(result, ReportExtras("room"))) == pytest.approx(1.1 + 2.2)


def test_packed_arrays_round_trip():
    rng = np.random.default_rng(3)
    for array in (
        rng.integers(0, 2**16, (50, 3)).astype(np.uint16),
        rng.integers(0, 2**32, (40, 3)).astype(np.uint32),
        rng.integers(-128, 128, (30, 3)).astype(np.int8),
        rng.normal(0, 1e3, (20, 12)).astype(np.float32),
        np.arange(1).astype(np.uint8)[:, None],
    ):
        back = unpack(pack(array), array.dtype.str, array.shape[1])
        np.testing.assert_array_equal(back, array)


def test_viewer_mesh_is_simplified():
    # A wavy sheet with far more faces than a phone should draw.
    n = 520
    x, y = np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n))
    z = 2 + 0.05 * np.sin(6 * x)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel(), k[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]).astype(np.int32)
    normals = np.tile(np.float32([0, 0, -1]), (n * n, 1))
    color = np.full((n * n, 3), 90, np.uint8)
    ones = np.ones(n * n)
    mesh = Mesh(vertices, faces, normals, color, ones.astype(np.float32), ones.astype(np.int32))
    result, rows = room()[0], {}
    scene = make_scene(replace(result, mesh=mesh), rows)
    assert len(scene.mesh.faces) <= 250_000
    assert len(scene.mesh.faces) > 60_000
    data = packed(scene)
    model = data["model"]
    shown = unpack(model["points"], "<u2", 3) / 65535 * data["extent"] + data["low"]
    off = shown[:, 2] - (2 + 0.05 * np.sin(6 * shown[:, 0]))
    assert np.abs(off).max() < 0.003
    assert unpack(model["faces"], "<u4", 3).max() == len(shown) - 1
    assert len(unpack(model["colors"], "u1", 3)) == len(shown) == data["count"]
    assert packed(make_scene(result, rows))["model"]["faces"] is None


def test_viewer_contains_model_cameras_and_loops(shown):
    result, extras = room()
    R = Subject.of(result, extras).R_display_world
    scene = json.loads(shown.scripts[0])
    model = scene["model"]
    points = np.array(scene["low"]) + unpack(model["points"], "<u2", 3) / 65535 * scene["extent"]
    np.testing.assert_allclose(points, result.cloud.points @ R.T, atol=1e-4)
    colors = unpack(model["colors"], "u1", 3)
    np.testing.assert_array_equal(colors, display_colors(result.cloud.color))
    normals = unpack(model["normals"], "i1", 3) / 127
    np.testing.assert_allclose(normals, result.cloud.normals @ R.T, atol=0.01)
    loops = unpack(scene["lines"]["loops"], "<f4", 3)
    np.testing.assert_allclose(loops, result.trajectory[[0, 23], :3, 3] @ R.T, atol=1e-6)
    frames = scene["frames"]
    assert unpack(frames["index"], "<u4", 1)[:, 0].tolist() == list(range(24))
    assert frames["status"] == "000001000220000300000000"
    for name, poses in (("before", result.diagnostics.sequential), ("after", result.trajectory)):
        found = unpack(frames[name], "<f4", 12).reshape(-1, 3, 4)
        known = np.isfinite(poses[:, 0, 0])
        np.testing.assert_allclose(found[known], R @ poses[known, :3], atol=1e-6)
        assert not found[~known].any()


def test_charts_have_values_gaps_and_text(shown):
    inliers, residual, x, _, _, rotation, objective = shown.charts
    result, _ = room()
    shares = [record.inlier_share for record in result.diagnostics.frames]
    expected = [100 * share for share in shares if share is not None]
    values = [v for v in inliers["series"]["after"] if v is not None]
    np.testing.assert_allclose(values, expected, rtol=1e-4)
    assert inliers["series"]["after"][15] is None
    assert inliers["bad"] == [9, 10, 15]
    assert (inliers["floor"], residual["ylabel"]) == (True, "rms residual, mm")
    assert list(x["series"]) == ["before", "after"]
    assert (x["x"], x["zero"]) == (list(range(24)), True)
    high = max(v for v in rotation["series"]["before"] if v is not None)
    assert rotation["label"].endswith(f"rotation, degrees: from 0 to {high:.3g}")
    assert (objective["xlabel"], objective["scale"]["distr"]) == ("iteration", 3)


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        ([2, 1, np.nan], {"distr": 3, "asinh": 1.0}),
        ([2, 0, np.inf], {"distr": 4, "asinh": 2.0}),
        ([0, 0, 0], {}),
    ],
)
def test_logarithmic_axis_is_linear_near_zero(values, scale):
    y = np.array(values, float)
    fine = plots.lines(np.array([-0.25, 1e5]), {"after": np.ones(2)}, label="a", ylabel="b")
    assert json.dumps(fine["x"]) == "[-0.25, 100000]"
    chart = plots.lines(np.arange(3.0), {"after": y}, label="a", ylabel="b", log=True)
    assert chart["scale"] == scale
    assert chart["series"]["after"][2] == (0.0 if values[2] == 0 else None)


def test_plan_shows_outline_extents_and_path_in_pixels():
    points = np.random.default_rng(1).uniform(0, 1, (20_000, 3)) * [4, 1, 2]
    cameras = np.array([[1.0, 0, 0.5], [2.0, 0, 0.5], [3.0, 0, 0.5]])
    corners = np.array([[0, 0, 0], [4.0, 1, 2]])
    p = plots.model(points, cameras, points, "above", measured=corners, label="a")
    at = {text: pixel for pixel, text in p["x"]}
    scale = at["2"] - at["1"]
    left, top, right, bottom = p["measured"]
    assert (right - left, bottom - top) == pytest.approx((4 * scale, 2 * scale), abs=0.2)
    assert p["path"] == pytest.approx([at["1"], p["path"][1], at["3"], p["path"][1]], abs=0.2)
    up = {text: pixel for pixel, text in p["y"]}
    assert (up["1"] + up["0"]) / 2 == pytest.approx(p["path"][1], abs=0.2)
    (ring,) = np.array(p["truth"]).reshape(1, -1, 2)
    assert [*ring.min(0), *ring.max(0)] == pytest.approx(p["measured"], abs=0.06 * scale)
    assert p["names"] == ["right, m", "forward, m"]


def test_model_without_colours_begins_with_its_shape(tmp_path):
    """What the accuracy looks like is for specialists."""
    text = page(tmp_path, lonely(), ReportExtras("x")).text
    assert re.search(r'name="by"[^>]*><option value="">Shape</option>', text)


def test_model_can_be_coloured_by_attributes_of_points():
    points = np.array([[0, -2.0, 1], [0, -1, 1], [0, 0, 1], [1, 0, 2]], np.float32)
    sigma = np.array([0.001, 0.002, 0.004, UNKNOWN_M], np.float32)
    cloud = Cloud(points, None, None, np.array([1, 2, 3, 4], np.int32), sigma)
    found = {f.name: f for f in fields(make_scene(lonely(cloud=cloud), {}))}
    assert list(found) == ["accuracy", "height", "views"]
    packed_values = {name: field.packed()["values"] for name, field in found.items()}
    of = {name: unpack(v, "u1", 1)[:, 0].astype(int) for name, v in packed_values.items()}
    assert of["height"].tolist() == [255, pytest.approx(128, abs=3), 0, 0]
    assert (np.diff(of["views"]) > 0).all()
    # The bar covers constrained points; unconstrained ones are beyond its end, and named there.
    accuracy = found["accuracy"]
    assert of["accuracy"][3] == 255
    np.testing.assert_allclose(np.diff(of["accuracy"][:3]), np.log(2) / np.log(1.049), atol=1)
    assert accuracy.low == pytest.approx(0.00196, rel=0.1)
    assert accuracy.high == pytest.approx(0.00784, rel=0.1)
    assert accuracy.labels[2].endswith("mm or not constrained")
    # The page decodes the byte, for the ± of a distance.
    low, high = accuracy.span
    assert low * (high / low) ** (of["accuracy"][1] / 255) == pytest.approx(0.00392, rel=0.03)
    # Cameras are coloured by the same bar.
    wider = fields(make_scene(lonely(cloud=cloud), {}), np.array([0.05, np.nan]))[0]
    assert wider.high == pytest.approx(0.05)


@pytest.mark.nightly_part
def test_external_text_is_escaped(tmp_path):
    bad = "</script><script>alert('1')</script><b>&"
    result, extras = room()
    d = result.diagnostics
    result = replace(
        result,
        config={"method": bad, bad: bad},
        recording={"path": bad, "format": bad, "frames": 1, "warnings": [bad]},
        diagnostics=replace(
            d,
            reasons=(Reason("lost_frames", ((1, 2),), bad),),
            frames=(*d.frames[:-1], replace(d.frames[-1], status="lost", reason=bad)),
            loops=(replace(d.loops[0], reason=bad),),
            removed={bad: 0.5},
            seconds={bad: 1.0},
        ),
    )
    steps = ((bad, extras.filter_steps[0][1]), (bad, extras.filter_steps[1][1]))
    write_report(result, tmp_path / "r.html", replace(extras, title=bad, filter_steps=steps))
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "alert('1')" not in text
    assert "<b>" not in text
    got = Page(text)
    assert len(got.scripts) == 3
    for name in ("verdict", "filters", "frames", "loops", "timings", "settings"):
        assert "alert(" in got.sections[name]


def many(number):
    """A long recording in which every third frame is lost, each for another reason."""
    frames = tuple(
        FrameRecord(k, k / 10, *(("lost", f"reason {k}") if k % 3 == 1 else ("tracked", "")))
        for k in range(number)
    )
    poses = np.tile(np.eye(4), (number, 1, 1))
    poses[:, 0, 3] = np.arange(number) * 0.01
    poses[1::3] = np.nan
    loops = tuple(LoopRecord(k, k + 50, False, "too far") for k in range(300))
    posed = {"trajectory": poses, "timestamps": np.arange(number) / 10, "sequential": poses}
    return lonely(**posed, frames=frames, loops=loops)


@pytest.mark.nightly
def test_page_of_long_recording_stays_readable_and_small(tmp_path):
    got = page(tmp_path, many(10_000), ReportExtras("very long"))
    assert (tmp_path / "report.html").stat().st_size < 4e6
    titles = [t for t in got.titles if t.startswith("Frame ")]
    assert 500 <= len(titles) < 600
    assert all("lost" in t for t in titles)  # a cell shows the worst of its frames
    assert "3,183 more are not shown" in got.sections["frames"]
    assert "150 more are not shown" in got.sections["loops"]
    assert list(got.sections) == [s for s in ORDER if s != "recording"]


def cloud_frame():
    return CloudFrame.of(np.random.default_rng(0).normal(0, 1, (500, 3)), index=4)


def unlit():
    return RangeFrame(0, 0.0, Pinhole(8, 6, 8, 8, 4, 3), np.zeros((6, 8), np.float32))


def dark():
    return FrameSample.of(unlit(), unlit(), unlit())


def still(count, pose=None, **changes):
    """A camera whose poses are all the same."""
    poses = np.tile(np.eye(4) if pose is None else pose, (count, 1, 1))
    times = np.arange(float(count))
    return lonely(trajectory=poses, timestamps=times, sequential=poses, **changes)


def records(*statuses):
    return tuple(FrameRecord(k, float(k), status) for k, status in enumerate(statuses))


POOR = {
    "one cloud": (lonely(), ReportExtras("x", (("raw", cloud_frame()),), clouds=(cloud_frame(),))),
    "nothing read": (
        still(0, cloud=empty_cloud(), frames=(), reasons=(), verdict="failed"),
        ReportExtras("x"),
    ),
    "all lost": (
        still(
            2, np.full((4, 4), np.nan), cloud=empty_cloud(), frames=records("lost", "lost"),
            reasons=(Reason("few_poses", ((0, 1),), "no frame has a pose"),), verdict="failed",
        ),
        ReportExtras("x", reference=np.tile(np.eye(4), (2, 1, 1))),
    ),
    "cameras without a model": (lonely(cloud=empty_cloud()), ReportExtras("x")),
    "one point": (
        lonely(cloud=Cloud(np.ones((1, 3), np.float32), None, None, np.ones(1, np.int32))),
        ReportExtras("x", truth_points=np.ones((1, 3), np.float32)),
    ),
    "objective of zero": (lonely(objective=(0.5, 0.0, 0.0)), ReportExtras("x")),
    "objective of one value": (lonely(objective=(0.5,)), ReportExtras("x")),
    "no valid pixel": (
        lonely(samples=(dark(),)),
        ReportExtras("x", (("raw", unlit()), ("median", unlit()))),
    ),
    "stationary camera": (
        still(3, frames=tuple(FrameRecord(k, k, "tracked", "", 0.0, 0.0, 0.0) for k in range(3))),
        ReportExtras("x", reference=np.full((3, 4, 4), np.nan)),
    ),
    "skipped frames without a row": (
        still(
            2, frames=records("tracked", "skipped", "tracked"),
            loops=(LoopRecord(0, 2, True, ""), LoopRecord(0, 7, True, "")),
        ),
        ReportExtras("x"),
    ),
}  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("name", POOR)
def test_poor_results_give_complete_report(name, tmp_path):
    result, extras = POOR[name]
    got = page(tmp_path, result, extras)
    assert [s for s in ORDER if s != "recording" or extras.clouds] == list(got.sections)
    for section, text in got.sections.items():
        assert len(text.split()) > 4, section
        assert not re.search(r"\b(nan|None|inf)\b", text), section
    assert f"{result.diagnostics.verdict.capitalize()}:" in got.sections["verdict"]


@pytest.mark.nightly
@pytest.mark.parametrize("title", [os.fsdecode(b"caf\xe9 'q' \"") + '\u202e\u062e\u0631<b>"x"', ""])
def test_any_file_name_is_shown(title, tmp_path):
    result, extras = room()
    record = replace(result.diagnostics.frames[9], reason=title)
    frames = (*result.diagnostics.frames[:9], record, *result.diagnostics.frames[10:])
    result = replace(
        result,
        recording={**result.recording, "path": title},
        diagnostics=replace(result.diagnostics, frames=frames),
    )
    got = page(tmp_path, result, replace(extras, title=title))
    shown = re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", title)
    assert any(f"Frame 9: lost – {shown}" in t or not title for t in got.titles)


def test_unwritable_path_leaves_no_file(tmp_path):
    (tmp_path / "report.html").mkdir()
    with pytest.raises(OutputError, match="report"):
        write_report(lonely(), tmp_path / "report.html", ReportExtras("x"))
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.nightly
def test_long_recording_of_large_images_stays_below_size_limit(tmp_path):
    result, extras = room()
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
    # All of them pure noise, the worst case for image compression.
    detailed = replace(result, diagnostics=replace(result.diagnostics, samples=kept))
    write_report(detailed, tmp_path / "r.html", extras)
    assert (tmp_path / "r.html").stat().st_size < 20e6
