"""Deviations, their uncertainty, and the verdicts that follow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import tofuse
from measured_parts import NOISE, drawn, scan
from tofuse.apps.compare import comparing
from tofuse.apps.compare import deviations as module
from tofuse.apps.compare.comparing import _regions, compared
from tofuse.apps.compare.deviations import COVERAGE
from tofuse.apps.compare.nearest import Reach, Reference
from tofuse.apps.compare.page import compare_scene
from tofuse.apps.compare.surface import Surface, in_metres, surface_of
from tofuse.apps.pairs import register
from tofuse.engine.errors import InputError
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.geometry import KdTree, se3
from tofuse.lab.world import mesh as meshes

T = se3.exp([0.3, 0.1, -0.2, 0.4, 1.0, -0.3])


@pytest.fixture(scope="module")
def part() -> Reference:
    return Reference.of(drawn())


def moved(surface: Surface, pose=T) -> Surface:
    return replace(
        surface,
        points=se3.transform(pose, surface.points),
        normals=surface.normals @ pose[:3, :3].T,
    )


def test_distances_are_exact_and_signed(part) -> None:
    rng = np.random.default_rng(3)
    surface = Reference.of(drawn(meshes.box([0.2, 0.2, 0.2])))
    points = np.column_stack([rng.uniform(-0.08, 0.08, (200, 2)), np.full(200, 0.1)])
    heights = rng.uniform(-0.01, 0.01, 200)
    up = np.tile([0.0, 0, 1], (200, 1))
    reach = Reach(0.02, 0.002)
    found = surface.distances(points + heights[:, None] * up, up, reach)
    np.testing.assert_allclose(found.signed, heights, atol=1e-9)
    # Another side of the body, or nothing beside the border.
    assert not surface.distances(points, -up, reach).compared.any()
    assert not surface.distances(points + np.array([0.2, 0, 0.005]), up, reach).compared.any()


def test_distances_are_those_of_an_unlimited_search(part, monkeypatch) -> None:
    rng = np.random.default_rng(4)
    points = part.centres[rng.integers(len(part.centres), size=300)]
    points = points + rng.normal(0, 1, (300, 3)) * 10 ** rng.uniform(-4, 0, (300, 1))
    reach = Reach(0.02, 0.002)
    found = part.distances(points, np.zeros((300, 3)), reach)
    limits = []

    def unlimited(tree, queries, k, max_distance=np.inf):
        limits.append(max_distance)
        return search(tree, queries, k)

    search = KdTree.neighbours
    monkeypatch.setattr(KdTree, "neighbours", unlimited)
    wanted = part.distances(points, np.zeros((300, 3)), reach)
    assert 50 < wanted.compared.sum() < 250
    np.testing.assert_array_equal(found.signed, wanted.signed)
    # A search for neighbours of points that are far from all takes thousands of times as long.
    assert max(limits) < 0.05


def test_faces_of_a_cad_model_are_regions(part) -> None:
    assert part.has_faces
    assert part.region.max() + 1 == 18
    areas = np.bincount(part.region, part.area)
    assert (np.diff(areas) <= 1e-9).all()
    np.testing.assert_allclose(areas[0], 0.2 * 0.14, rtol=1e-6)


@pytest.mark.parametrize(
    ("bump", "verdict"), [(0.0, "pass"), (0.0024, "undecided"), (0.006, "fail")]
)
def test_a_bump_decides_the_verdict(part, bump, verdict) -> None:
    found = compared(scan(part, bump=bump), part, 0.002, searched=False)
    assert found.verdict == verdict
    assert found.sentence.startswith(verdict.capitalize())
    assert {"not seen"} < {region.verdict for region in found.regions}
    assert 0.6 < found.seen < 0.8
    if verdict == "fail":
        worst = max(found.worst, key=lambda row: abs(row["deviation_m"]))
        assert np.linalg.norm([worst["x"] + 0.03, worst["y"] - 0.03]) < 0.015
        assert worst["verdict"] == "fail"


def test_surface_that_a_solid_lacks_does_not_pass(part) -> None:
    """A block that is not drawn is beyond the reach of deviations; a table is no part of it."""
    post = meshes.box([0.03, 0.03, 0.04], [-0.06, 0.04, 0.045])
    blocks = (
        meshes.box([0.2, 0.14, 0.05]),
        meshes.box([0.05, 0.08, 0.06], [0.04, 0.02, 0.055]),
        meshes.box([0.03, 0.03, 0.05], [-0.07, -0.04, 0.05]),
    )
    extended = scan(Reference.of(drawn(*blocks, post)))
    found = compared(extended, part, 0.002, searched=False)
    assert found.verdict == "undecided"
    assert found.sentence.startswith("Undecided: not all of the surface has a counterpart")
    (more,) = found.deviations.unmatched
    np.testing.assert_allclose(more.centre_m, [-0.06, 0.04, 0.05], atol=0.01)
    assert 0.02 < more.distance_m < 0.045
    assert found.to_dict()["unmatched"][0]["area_m2"] == more.area_m2
    assert compared(extended, part, searched=False).deviations.unmatched
    # Fail stays fail, and what an open surface lacks was only not scanned there.
    bumped = scan(Reference.of(drawn(*blocks, post)), bump=0.006)
    assert compared(bumped, part, 0.002, searched=False).verdict == "fail"
    open_surface = replace(part.surface, faces=part.surface.faces[2:])
    found = compared(extended, Reference.of(open_surface), 0.002, searched=False)
    assert not found.deviations.unmatched
    x, y = np.random.default_rng(5).uniform(-0.2, 0.2, (2, 15_000))
    beside = (np.abs(x) > 0.1) | (np.abs(y) > 0.07)
    table = np.column_stack([x, y, np.full(len(x), -0.025)])[beside]
    calm = scan(part)
    on_table = replace(
        calm,
        points=np.concatenate([calm.points, table]),
        normals=np.concatenate([calm.normals, np.tile([0.0, 0, 1], (len(table), 1))]),
        sigma=np.full(len(calm.points) + len(table), NOISE),
    )
    found = compared(on_table, part, 0.002, searched=False)
    assert found.verdict == "pass"
    share = len(table) / len(on_table.points)
    assert found.to_dict()["without_counterpart"] == pytest.approx(share, abs=0.02)
    assert "% has no counterpart in it." in found.sentence


@pytest.mark.parametrize(
    ("shift", "verdict"), [(0.0, "pass"), (0.001, "pass"), (0.005, "undecided")]
)
def test_a_hole_that_is_elsewhere_does_not_pass(shift, verdict) -> None:
    """Of a thin plate, seen from above at points of 2 mm, which says nothing of the walls."""
    half = np.array([0.1, 0.07])
    strips = [meshes.box([0.09, 0.14, 0.006], [side * 0.055, 0, 0]) for side in (-1, 1)] + [
        meshes.box([0.02, 0.06, 0.006], [0, side * 0.04, 0]) for side in (-1, 1)
    ]
    x, y = np.mgrid[-half[0] : half[0] : 0.002, -half[1] : half[1] : 0.002].reshape(2, -1) + 1e-3
    at = (np.abs(x - shift) > 0.01) | (np.abs(y) > 0.01)
    z = 0.003 + np.random.default_rng(0).normal(0, 1e-4, at.sum())
    points = np.column_stack([x[at], y[at], z])
    up = np.tile([0.0, 0, 1], (len(points), 1))
    measured = Surface("scan", points, up, None, True, np.full(len(points), 1e-4), 1e-4)
    found = compared(measured, Reference.of(drawn(*strips)), 0.002, searched=False)
    assert found.verdict == verdict
    if shift > 0.002:
        (more,) = found.deviations.unmatched
        np.testing.assert_allclose(more.centre_m, [-0.0075, 0, 0.003], atol=0.002)
        assert 0.002 < more.distance_m < 0.007


def test_a_block_that_is_missing_does_not_pass(part) -> None:
    """The plate is drawn below it, too: what was measured there deviates from nothing."""
    calm = scan(Reference.of(drawn(meshes.box([0.2, 0.14, 0.05]))))
    x, y = np.mgrid[0.017:0.064:0.002, -0.017:0.058:0.002].reshape(2, -1)
    floor = np.column_stack([x, y, np.full(len(x), 0.025)])
    measured = replace(
        calm,
        points=np.concatenate([calm.points, floor]),
        normals=np.concatenate([calm.normals, np.tile([0.0, 0, 1], (len(floor), 1))]),
        sigma=np.full(len(calm.points) + len(floor), NOISE),
        eyes=np.array([[0.0, 0, 1], [0.1, 0.5, 0.5]]),
    )
    found = compared(measured, part, 0.002, searched=False)
    assert found.verdict == "undecided"
    (floor_of_block,) = found.deviations.unmatched
    np.testing.assert_allclose(floor_of_block.centre_m, [0.04, 0.02, 0.025], atol=0.005)
    assert 0.01 < floor_of_block.distance_m < 0.07
    # Of a file it is not known what its cameras saw through.
    unknown = replace(measured, eyes=np.zeros((0, 3)))
    assert compared(unknown, part, 0.002, searched=False).verdict == "pass"


def test_cameras_of_a_result_are_known(room_result) -> None:
    result = tofuse.load(room_result)
    eyes = surface_of(result).eyes
    np.testing.assert_array_equal(eyes, result.trajectory[result.has_pose, :3, 3] + result.shift)


def test_a_result_is_shown_upright(room_result) -> None:
    """As in its report, however the first camera was held; the scene has y down."""
    result = tofuse.load(room_result)
    result = replace(result, up=se3.exp([0, 0, 0, 0, 0, 0.5])[:3, :3] @ [0, -1, 0])
    comparison = tofuse.compare(result, result, guess=np.eye(4))
    drawn_points = compare_scene(comparison)[0].points
    found = comparison.deviations
    upright = se3.transform(result.T_up_world, found.points[found.place >= 0]) * [1, -1, -1]
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(drawn_points, 0), end(upright, 0), atol=0.1)


def test_a_solid_is_recognised(part) -> None:
    assert part.is_solid
    box = drawn(meshes.box([0.2, 0.14, 0.05]))
    assert not Reference.of(replace(box, faces=box.faces[2:])).is_solid
    tube = replace(box, faces=box.faces[4:])  # its normals cancel
    assert not Reference.of(tube).is_solid
    # A thin shell with a crack along one of its triangles, which a large one is not.
    shell = drawn(meshes.box([0.2, 0.14, 0.06]), meshes.inside_out(meshes.box([0.19, 0.13, 0.05])))
    corner, *others = shell.points[shell.faces[0]]
    for width, is_solid in ((0.05, True), (0.2, False)):
        triangle = np.array([corner, *(end + width * (corner - end) for end in others)])
        points = np.concatenate([shell.points, triangle])
        faces = np.vstack([[16, 17, 18], shell.faces[1:]]).astype(np.int32)
        assert Reference.of(replace(shell, points=points, faces=faces)).is_solid == is_solid


def test_a_solid_that_is_inside_out_is_turned(part) -> None:
    inverted = Reference.of(replace(part.surface, faces=part.surface.faces[:, ::-1]))
    found = compared(scan(part, bump=0.006), inverted, 0.002, searched=False)
    assert found.verdict == "fail"
    worst = max(found.worst, key=lambda row: abs(row["deviation_m"]))
    assert worst["deviation_m"] > 0.004


def test_faces_that_look_the_other_way_are_named(part) -> None:
    measured = scan(part)

    def warned(reference) -> list[str]:
        found = compared(measured, reference, searched=False)
        return [words for words in found.warnings if "other way" in words]

    faces = part.surface.faces.copy()
    faces[2:4] = faces[2:4, ::-1]  # the top of the plate
    assert warned(part) == []
    (words,) = warned(Reference.of(replace(part.surface, faces=faces)))
    top = (np.abs(measured.points[:, 2] - 0.025) < 0.002) & (measured.normals[:, 2] > 0.9)
    assert float(words.split(" %")[0]) == pytest.approx(100 * top.mean(), rel=0.1)


def test_a_room_faces_inwards(part) -> None:
    """It is closed as a solid is, whose faces would be inside out."""
    room = Reference.of(replace(part.surface, faces=part.surface.faces[:, ::-1]))
    outside = scan(part, bump=0.006)
    found = compared(replace(outside, normals=-outside.normals), room, 0.002, searched=False)
    worst = max(found.worst, key=lambda row: abs(row["deviation_m"]))
    assert worst["deviation_m"] < -0.004
    assert found.to_dict()["without_counterpart"] < 0.05


def test_a_pose_is_found_without_a_guess(part) -> None:
    found = compared(moved(scan(part)), part, 0.002)
    assert found.verdict == "pass"
    gap = found.deviations.T_reference_measured @ T
    assert np.linalg.norm(gap[:3, 3]) < 2e-4
    assert se3.angle(gap) < 1e-3


def test_a_guess_excludes_rivals_that_are_far_from_it(part, monkeypatch) -> None:
    right = se3.inverse(T)
    turned = se3.exp(np.array([0, 0, 0, 0, 0, np.pi])) @ right

    def doubtful(source, target, guess=None, method=None):
        found = register(source, target, guess=guess, method=method)
        doubt = {"reason": "close", "remedy": "a guess near it"}
        return found if method else replace(found, believed=False, runner_up=turned, **doubt)

    monkeypatch.setattr(comparing, "register", doubtful)
    measured = moved(scan(part))
    near = right @ se3.exp(np.array([0.01, -0.01, 0, 0, 0.05, 0]))
    found = compared(measured, part, 0.002, near)
    assert found.verdict == "pass"
    assert found.given == "given the guess: another pose fits nearly as well"
    # Without one, or between both, it is not decided.
    between = se3.exp(np.array([0, 0, 0, 0, 0, 0.4 * np.pi])) @ right
    for guess in (None, between):
        said = compared(measured, part, 0.002, guess).sentence
        assert "not accepted: close; a guess near it would decide" in said


@pytest.mark.nightly_part
def test_a_symmetry_is_named() -> None:
    box = Reference.of(drawn(meshes.box([0.2, 0.14, 0.05])))
    found = compared(moved(scan(box)), box, 0.002)
    assert found.verdict == "pass"
    assert "turned by 180" in found.given
    assert found.given in found.sentence


def test_sigma_is_that_of_repeated_scans(part) -> None:
    """Means of places scatter as stated; averaging does not reduce shared errors."""
    found = [compared(scan(part, k, shared=0.0), part, 0.002, searched=False) for k in range(6)]
    z = np.concatenate([c.deviations.places.deviation / c.deviations.places.sigma for c in found])
    assert 0.8 < z.std() < 1.1
    shared = compared(scan(part, shared=0.0005), part, 0.002, searched=False).deviations.places
    assert np.median(found[0].deviations.places.sigma) < 0.5 * NOISE
    assert 0.0003 < np.median(shared.sigma) < 0.0006


def test_errors_without_bound_leave_all_undecided(part) -> None:
    found = compared(scan(part, shared=np.inf, bump=0.006), part, 0.002, searched=False)
    assert found.verdict == "undecided"
    assert "not bounded" in found.sentence
    assert {r.verdict for r in found.regions} == {"undecided", "not seen"}


def test_a_rejected_registration_leaves_every_place_undecided(part) -> None:
    found = compared(scan(part, bump=0.006), part, 0.001, searched=False)
    assert {"fail", "pass"} & {row["verdict"] for row in found.worst}
    rejected = replace(found, reason="the registration is not accepted")
    assert {row["verdict"] for row in rejected.worst} == {"undecided"}
    regions = _regions(found.deviations, part, 0.001, decided=False)
    assert not any(r.outside or r.changed or r.verdict in ("pass", "fail") for r in regions)


def test_changes_are_significant_from_the_detection_limit(part) -> None:
    calm = compared(scan(part), part, searched=False)
    assert calm.verdict is None
    assert calm.changed == 0
    assert calm.sentence.startswith("No place differs significantly")
    limit = next(r.detectable_m for r in calm.regions if r.places)
    assert COVERAGE * 0.0001 < limit < 0.002
    changed = compared(scan(part, 1, bump=3 * limit), part, searched=False)
    assert changed.changed > 0
    # The largest deviation that is named is one that is significant.
    places = changed.deviations.places
    calmest = int(np.abs(places.deviation).argmin())
    deviation, covariance = places.deviation.copy(), places.covariance.copy()
    deviation[calmest], covariance[calmest, calmest] = 1.0, 1.0
    noisy = replace(places, deviation=deviation, covariance=covariance)
    found = replace(changed, deviations=replace(changed.deviations, places=noisy))
    assert found.sentence == changed.sentence


def test_zero_has_no_sign() -> None:
    assert [comparing.millimetres(v) for v in (-1e-6, -1e-5, -0.02)] == ["0.00", "-0.01", "-20.0"]


def test_the_unit_of_a_file_is_recognised() -> None:
    nominal = drawn()
    in_mm = replace(nominal, points=1000 * nominal.points)
    _, reference, said = in_metres(nominal, in_mm)
    np.testing.assert_allclose(reference.points, nominal.points)
    assert "in mm" in said
    _, reference, said = in_metres(nominal, in_mm, "mm")
    np.testing.assert_allclose(reference.points, nominal.points)
    assert said == ""
    in_inches = replace(nominal, points=nominal.points / 0.0254)
    np.testing.assert_allclose(in_metres(nominal, in_inches, "in")[1].points, nominal.points)
    assert in_metres(nominal, nominal)[2] == ""


@pytest.mark.nightly_part
def test_lengths_of_any_size_are_compared() -> None:
    """Their squares are no numbers."""
    points = np.random.default_rng(0).uniform(0, [1, 1, 0], (2000, 3))
    for tolerance_m, accuracy_m in ((1e-300, None), (1e300, 1e300)):
        tofuse.compare(
            points, points, tolerance_m=tolerance_m, accuracy_m=accuracy_m, guess=np.eye(4)
        )


def test_python_compares_meshes_and_clouds(part) -> None:
    surface = part.surface
    mesh = Mesh.of(GeometryRecord(surface.points, surface.faces))
    found = tofuse.compare(mesh, mesh, tolerance_m=0.001, accuracy_m=0.0002)
    assert found.verdict == "pass"
    assert "Comparison: Pass" in repr(found)
    for wrong in ({"tolerance_m": -1.0}, {"accuracy_m": 0.0}):
        with pytest.raises(InputError, match=r"_m: is .*; pass a finite number, above 0"):
            tofuse.compare(mesh, mesh, **wrong)


def test_surfaces_that_don_t_overlap_are_refused(part) -> None:
    far = moved(scan(part), se3.translation(np.array([0, 0, 5.0])))
    with pytest.raises(InputError, match="no surface within"):
        compared(far, part, 0.002, searched=False)
    with pytest.raises(InputError, match=r"within .* \(a.stl is taken to be in mm\)"):
        compared(far, part, 0.002, said="a.stl is taken to be in mm", searched=False)
    result = Reference.of(replace(part.surface, is_result=True))
    with pytest.raises(InputError, match="state the result first"):
        compared(far, result, 0.002, searched=False)


def test_places_without_bound_have_no_slope() -> None:
    """Three in a row and one of another region, which has no neighbours there."""
    places = np.array([(0.0, 0, 0), (0.01, 0, 0), (0.02, 0, 0), (0.03, 0, 0)])
    region, deviation = np.array([0, 0, 0, 1]), np.array([0.0, 0.001, 0.002, 0.003])
    steep = module._gradients(places, region, deviation, np.zeros((4, 4)), 0.012)
    np.testing.assert_allclose(steep, [0.1, 0.1, 0.1, 0], atol=1e-9)
    unknown = module._gradients(places, region, deviation, np.full((4, 4), np.inf), 0.012)
    np.testing.assert_array_equal(unknown, 0)


def test_slope_is_neither_that_of_noise_nor_less_than_it_is() -> None:
    """Errors that neighbours share do not change their differences."""
    u, v = np.mgrid[:9, :9].reshape(2, -1) * 0.01
    places, region = np.stack([u, v, 0 * u], 1), np.zeros(len(u), np.intp)
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    covariance = 0.0005**2 * np.eye(len(u)) + 0.001**2 * np.exp(-apart / 0.1)
    root, rng = np.linalg.cholesky(covariance), np.random.default_rng(0)
    found = [
        module._gradients(places, region, 0.1 * u + root @ noise, covariance, 0.01)
        for noise in rng.normal(size=(50, len(u)))
    ]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.1, rel=0.05)


def test_what_one_view_alone_saw_is_no_change(part) -> None:
    """What is wrong in one view is in no sigma, and no other view averages it out."""
    low = (part.normals[:, 2] > 0.9) & (part.centres[:, 0] < -0.03) & (part.centres[:, 2] < 0.03)
    corners = part.triangles + np.where(low, 0.004, 0)[:, None, None] * [0, 0, 1]
    vertices = corners.reshape(-1, 3).astype(np.float32)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    sigma = np.full(len(vertices), 0.0003, np.float32)

    def mesh(views: int) -> Mesh:
        seen = np.where(np.repeat(low, 3), 1, views).astype(np.int32)
        return Mesh(vertices, faces, np.zeros_like(vertices), None, sigma, seen)

    found = compared(surface_of(mesh(9)), part, searched=False)
    assert found.changed == 0
    assert any("only one view saw" in words for words in found.warnings)
    # Where most is seen once, nothing is more certain than the rest.
    once = surface_of(mesh(1))
    assert once.left_out == 0
    assert compared(once, part, searched=False).changed > 0
