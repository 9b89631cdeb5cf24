"""Charts of a texture, and when one is made."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace

import cv2
import numpy as np
from test_fusion_texture import POSES, look, pattern, sheet

from tofuse.engine.fusion.atlas import chart_atlas
from tofuse.engine.fusion.cloud import NO_COLOR
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.fusion.texture import TextureView, textured
from tofuse.formats.geometry.glb import read_textured_glb, write_glb
from tofuse.formats.geometry.usdz import write_usdz
from tofuse.formats.images.images import jpeg_bytes


def test_charts_do_not_overlap_and_keep_their_scale() -> None:
    mesh = sheet(30, 20, 0.05)
    label = (mesh.vertices[mesh.faces].mean(1)[:, 0] > 0).astype(np.int32)
    pixels = (mesh.vertices[mesh.faces][..., :2] * 100).astype(np.float32)
    for size in (1024, 64):
        atlas = chart_atlas(mesh.faces, label, pixels, size)
        np.testing.assert_array_equal(atlas.vertices[atlas.faces], mesh.faces)
        corners = atlas.texels[atlas.faces]
        sides = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
        given = np.linalg.norm(pixels[:, 0] - pixels[:, 1], axis=1)
        ratio = sides / given
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
        assert ratio[0] > 0.999 if size == 1024 else ratio[0] < 0.9
        boxes = [
            (corners[label == k].min((0, 1)) - 1, corners[label == k].max((0, 1)) + 1)
            for k in (0, 1)
        ]
        (low0, high0), (low1, high1) = boxes
        assert (high0 < low1).any() or (high1 < low0).any()
        assert atlas.size <= size
        # Only the vertices on the boundary occur twice.
        both = np.intersect1d(mesh.faces[label == 0], mesh.faces[label == 1])
        assert len(atlas.vertices) == len(mesh) + len(both)


def test_texture_has_details_of_fine_images() -> None:
    frame = look(np.eye(4), 1.0)
    fine = np.zeros((480, 640, 3), np.uint8)
    fine[:] = 60
    fine[:, ::8], fine[:, 1::8] = 220, 220  # stripes of two pixels, a quarter of a pixel of depth
    mesh = sheet(25, 17, 0.05)
    coarse = textured(mesh, [TextureView.of(frame)], POSES[:1], 1024)
    made = textured(mesh, [TextureView.of(frame, fine)], POSES[:1], 1024)
    assert made.detail > 50 * coarse.detail
    used = made.charts
    row = np.rint(made.atlas.texels[:, 1]).astype(int)
    inner = made.image[int(np.median(row)), :, 0]
    assert (inner > 180).sum() > 20
    assert (inner < 90).sum() > 60
    assert len(used) == len(made.atlas.vertices)


def test_unseen_surface_is_neutral_and_no_fringe_is_painted() -> None:
    mesh = replace(sheet(25, 17, 0.05), color=None)
    frame = look(np.eye(4), 1.0)
    color = frame.color_image.copy()
    color[:, :30] = 0  # the colour camera did not see it
    color[:, 30:32] = [255, 0, 255]  # a fringe beside it
    made = textured(mesh, [TextureView.of(replace(frame, color_image=color))], POSES[:1], 512)
    shown = made.charts.color.astype(int)
    x = mesh.vertices[made.atlas.vertices, 0]
    assert (np.abs(shown[x < -0.45] - NO_COLOR[0]) <= 1).all()
    assert (shown.min(1) > 10).all()
    fringe = (shown[:, 0] > 200) & (shown[:, 1] < 80)
    assert not fringe.any()
    seen = (x > 0) & (np.abs(mesh.vertices[made.atlas.vertices]).max(1) < 2.1)
    truth = pattern(mesh.vertices[made.atlas.vertices[seen]])
    assert np.median(np.abs(shown[seen] - truth)) < 4


def test_seam_between_images_of_unequal_exposure_is_invisible() -> None:
    mesh = sheet(49, 33, 0.025)
    frames = [look(T, g) for T, g in zip(POSES, (0.8, 1.25, 1.0), strict=True)]
    used = textured(mesh, [TextureView.of(f) for f in frames], POSES, 1024).charts
    truth = pattern(used.vertices) * np.exp(np.log([0.8, 1.25, 1.0]).mean())
    inside = (np.abs(used.vertices[:, :2]) < [0.5, 0.3]).all(1)
    assert np.abs(used.color[inside] - truth[inside]).max() < 8


def test_files_with_texture_are_read_back(tmp_path) -> None:
    made = textured(sheet(9, 7, 0.1), [TextureView.of(look(np.eye(4), 1.0))], POSES[:1], 256)
    used = made.charts
    record = GeometryRecord(
        used.vertices, used.faces, used.normals, uv=made.atlas.uv, texture=jpeg_bytes(made.image)
    )
    write_glb(tmp_path / "mesh.glb", record, T_scene_node=np.eye(4))
    found, in_world = read_textured_glb(tmp_path / "mesh.glb")
    assert in_world
    for name in ("points", "faces", "normals", "uv"):
        np.testing.assert_array_equal(getattr(found, name), getattr(record, name))
    assert found.texture == record.texture
    (tmp_path / "mesh.glb").write_bytes(b"glTF")
    assert read_textured_glb(tmp_path / "mesh.glb") is None
    write_usdz(tmp_path / "a.usdz", record)
    data = (tmp_path / "a.usdz").read_bytes()
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        stage, image = archive.infolist()
        assert (stage.filename, image.filename) == ("model.usda", "texture.jpg")
        for member in (stage, image):
            assert member.compress_type == zipfile.ZIP_STORED
            start = member.header_offset + 30 + len(member.filename) + len(member.extra)
            assert start % 64 == 0
            assert data[start : start + member.file_size] == archive.read(member)
        text = archive.read(stage).decode()
    assert text.startswith("#usda 1.0")
    assert text.count("(") - text.count(")") == 0
    points = text.split("point3f[] points = [")[1].split("]")[0]
    assert points.count("(") == len(used)
    write_usdz(tmp_path / "b.usdz", record)
    assert (tmp_path / "b.usdz").read_bytes() == data
    assert cv2.imdecode(np.frombuffer(record.texture, np.uint8), 1).shape[0] == made.atlas.size


def test_exposures_are_compared_at_a_part_of_many_vertices() -> None:
    """OpenCV samples at most 32,767 pixels at once."""
    mesh = sheet(190, 180, 0.007)
    assert len(mesh) > np.iinfo(np.int16).max
    views = [TextureView.of(look(T, gain)) for T, gain in zip(POSES[:2], (1.0, 0.7), strict=True)]
    assert textured(mesh, views, POSES[:2], 1024).image.any()
