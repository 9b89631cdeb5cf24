"""The normal equations of a pair of views, against finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from corner_views import BARREL, CAMERA, SHARP, corner, unpack
from pair_equations import KNOWN, pair_equations, targets
from tofuse.engine.alignment.projective import points_of
from tofuse.engine.cameras.cameras import RayTable
from tofuse.engine.cameras.lens import UNDISTORTED
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views import SampledView
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.views import residual_kernels
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions

SETTINGS = (0.05, 1.0, 0.1, 0.01, 4.0, 0.5)  # exposure, scales, slack, robust, cosine


def evaluate(source, target, T, errors=None, known=KNOWN, settings=SETTINGS):
    points = points_of(prepare_view(source, SHARP), 1)
    return pair_equations(points, prepare_view(target, SHARP), T, settings, errors, known)[0]


@pytest.fixture
def pair():
    T_target_source = se3.exp(np.array([0.06, -0.04, 0.05, 0.03, -0.04, 0.02]))
    return corner(T_target_source), corner(np.eye(4)), T_target_source


def as_measured(frame, kind):
    """Return the frame with the depth that a camera of a kind, "z" or "range", measures."""
    return frame if kind == "z" else replace(frame, depth=frame.radial_range, depth_kind=kind)


@pytest.mark.parametrize("kind", ["z", "range"])
@pytest.mark.parametrize(("scale_p", "tolerance"), [(0.0, 0.01), (0.5, 0.1)])
@pytest.mark.parametrize("error", range(kernels.SOURCE_SCALE))
@pytest.mark.parametrize("camera", [CAMERA, BARREL])
def test_camera_error_changes_gradient_as_predicted_by_hessian(
    pair, error, scale_p, tolerance, kind, camera
):
    """To first order g(e) = g(0) + H e: the mixed block is the slope of the gradient."""
    _, _, T = pair
    # A pattern so coarse that the pixel of a correspondence makes no difference.
    source, target = (
        as_measured(corner(at, waves=0.1, camera=camera), kind) for at in (T, np.eye(4))
    )
    known = KNOWN.copy()
    known[error] = 0
    wide = (0.0, 1.0, scale_p, 0.3, 50.0, 0.5)  # so wide that the robust weights are 1
    h = 1e-3  # points are in single precision
    plus, minus = np.zeros(kernels.ERRORS), np.zeros(kernels.ERRORS)
    plus[error], minus[error] = h, -h
    # Where both views agree, so that second derivatives, which H leaves out, don't count.
    H, _ = unpack(evaluate(source, target, T, known=known, settings=wide))
    ends = [unpack(evaluate(source, target, T, e, known, wide))[1] for e in (plus, minus)]
    slope = (ends[0] - ends[1]) / (2 * h)
    column = H[:, 7 + error]
    chosen = [*range(6), 7 + error]
    scale = np.sqrt(np.diag(H)[chosen] * H[7 + error, 7 + error])
    assert np.abs((slope - column)[chosen] / scale).max() < tolerance


WIDE = (0.0, 1.0, 0.02, 0.3, 50.0, 0.5)  # so wide that the robust weights are 1
DISTANCES_ONLY = (*WIDE[:2], 0.0, *WIDE[3:])


def of_albedo(source, target, T, *estimated, assumed=0.0):
    """H and g of the albedo alone; the first of the estimated errors is assumed to have a value."""
    errors, known = np.zeros(kernels.ERRORS), KNOWN.copy()
    known[[*estimated]] = 0
    errors[estimated[0]] = assumed
    (H, g), (H_distance, g_distance) = (
        unpack(evaluate(source, target, T, errors, known, settings))
        for settings in (WIDE, DISTANCES_ONLY)
    )
    return H - H_distance, g - g_distance


# Those that views side by side don't share.
RESPONDING = [
    (kernels.OFFSET, kernels.SOURCE_OFFSET),
    (kernels.SCALE, kernels.SOURCE_SCALE),
    (kernels.FOCAL, kernels.FOCAL),
]


@pytest.mark.parametrize("kind", ["z", "range"])
@pytest.mark.parametrize(("error", "of_source"), RESPONDING)
def test_response_of_albedo_to_an_error_is_its_slope(kind, error, of_source):
    """The range of the target does not count: its albedo is that of a ray."""
    T = se3.exp(np.array([0.1, 0.02, 0.0, 0.0, 0.0, 0.0]))
    source, target = (as_measured(corner(at, waves=0.3), kind) for at in (T, np.eye(4)))
    H, _ = of_albedo(source, target, T, error, of_source)
    ends = [of_albedo(source, target, T, error, assumed=e)[1] for e in (1e-3, -1e-3)]
    slope = (ends[0] - ends[1]) / 2e-3
    assert H[7 + error, 7 + error] == pytest.approx(slope[7 + error], rel=0.05)
    assert H[7 + of_source, 7 + error] == pytest.approx(slope[7 + error], rel=0.05)


@pytest.mark.parametrize("error", range(kernels.SOURCE_SCALE))
def test_large_error_has_no_effect_between_equal_views(error):
    """Its displacements cancel: else the estimate of an error would run away from a large one."""
    view = corner(np.eye(4))
    known = KNOWN.copy()
    known[error] = 0
    errors = np.zeros(kernels.ERRORS)
    errors[error] = 0.05
    wide = (0.0, 1.0, 0.0, 0.3, 50.0, 0.5)
    same, _ = unpack(evaluate(view, view, np.eye(4), errors, known, wide))
    apart = se3.exp(np.array([0.2, -0.1, 0.1, 0.3, -0.4, 0.2]))
    turned, _ = unpack(evaluate(corner(apart), view, apart, errors, known, wide))
    assert same[7 + error, 7 + error] < 0.01 * turned[7 + error, 7 + error]


INTRINSICS = [kernels.FOCAL, kernels.CENTER_X, kernels.CENTER_Y, kernels.DISTORTION]


def stated(frame, kind, error, size):
    """Return a frame whose stated intrinsics have an error."""
    camera = frame.camera
    wrong = camera
    if error == kernels.FOCAL:
        wrong = replace(camera, fx=camera.fx * (1 + size), fy=camera.fy * (1 + size))
    if error == kernels.CENTER_X:
        wrong = replace(camera, cx=camera.cx + size * camera.fx)
    if error == kernels.CENTER_Y:
        wrong = replace(camera, cy=camera.cy + size * camera.fy)
    if error == kernels.DISTORTION:
        rays = camera.rays()
        wrong = RayTable(rays / (1 + size * (rays**2).sum(-1, keepdims=True)))
    return replace(as_measured(frame, kind), camera=wrong)


@pytest.mark.parametrize("kind", ["z", "range"])
@pytest.mark.parametrize("camera", [CAMERA, BARREL])
@pytest.mark.parametrize("error", INTRINSICS)
def test_wrong_intrinsics_are_compensated(pair, kind, error, camera):
    """The measured quantity is kept: z, or the range along another ray."""
    *_, T = pair
    source, target = (corner(at, camera=camera) for at in (T, np.eye(4)))
    errors = np.zeros(kernels.ERRORS)
    errors[error] = 0.03 if error == kernels.DISTORTION else 0.01
    views = [stated(frame, kind, error, errors[error]) for frame in (source, target)]
    known = KNOWN.copy()
    known[error] = 0
    plain = (0.0, 1.0, 0.1, 0.002, 4.0, 0.5)

    def misfit(out):
        return 1 - out[kernels.SUPPORT] / out[kernels.TERMS]

    true = misfit(evaluate(source, target, T, settings=plain))
    corrected = misfit(evaluate(*views, T, errors, known, plain))
    wrong = misfit(evaluate(*views, T, known=known, settings=plain))
    assert corrected - true < 0.3 * (wrong - true)


@pytest.mark.parametrize("kind", ["z", "range"])
@pytest.mark.parametrize("camera", [CAMERA, BARREL])
@pytest.mark.parametrize("error", INTRINSICS)
def test_response_is_that_of_wrong_intrinsics(pair, kind, error, camera):
    """Stated intrinsics with an error change the gradient by the mixed block, behind any lens."""
    *_, T = pair
    frames = [corner(at, camera=camera) for at in (T, np.eye(4))]
    known = KNOWN.copy()
    known[error] = 0
    plain = (0.0, 1.0, 0.0, 0.3, 50.0, 0.5)  # distances only, and robust weights of 1
    size = 0.003
    H, g = unpack(evaluate(*(as_measured(f, kind) for f in frames), T, known=known, settings=plain))
    wrong = [stated(f, kind, error, size) for f in frames]
    _, changed = unpack(evaluate(*wrong, T, known=known, settings=plain))
    chosen = [*range(6), 7 + error]
    scale = np.sqrt(np.diag(H)[chosen] * H[7 + error, 7 + error])
    predicted = -size * H[:, 7 + error]
    assert np.abs(predicted[chosen] / scale).max() > 0.5 * size
    assert np.abs((changed - g - predicted)[chosen] / scale).max() < 0.1 * size


@pytest.mark.parametrize("kind", ["z", "range"])
@pytest.mark.parametrize("error", range(kernels.SOURCE_SCALE))
def test_known_errors_are_corrected_as_if_they_were_unknowns(pair, kind, error):
    *_, T = pair
    views = [as_measured(corner(at, waves=0.1), kind) for at in (T, np.eye(4))]
    wide = (0.0, 1.0, 0.1, 0.3, 50.0, 0.5)  # so wide that the robust weights are 1
    errors = np.zeros(kernels.ERRORS)
    errors[error] = 0.01
    unknown = KNOWN.copy()
    unknown[error] = 0

    def step(assumed, known=KNOWN):
        H, g = unpack(evaluate(*views, T, assumed, known, wide))
        return np.linalg.solve(H[:7, :7], g[:7])

    effect = step(errors, unknown) - step(np.zeros(kernels.ERRORS))
    assert np.abs(effect[:6]).max() > 5e-5
    found = step(errors) - step(errors, unknown)
    assert np.abs(found[:6]).max() < 0.2 * np.abs(effect[:6]).max()


def test_free_space_and_support_are_counted(pair):
    source, target, T = pair
    agree = evaluate(source, target, T)
    assert agree[kernels.SUPPORT] > 0.9 * agree[kernels.TERMS] > 0
    assert agree[kernels.IN_FRONT] == 0
    nearer = replace(source, depth=source.depth * np.float32(0.6))
    out = evaluate(nearer, target, T)
    assert out[kernels.IN_FRONT] > 0.8 * out[kernels.COMPARED]
    assert out[kernels.SUPPORT] < 0.1 * out[kernels.TERMS]


def test_overlap_counts_points_seen_from_same_side(pair):
    source, target, T = pair
    surface = prepare_view(target, SurfaceOptions(radii=(2,)))
    points = points_of(prepare_view(source, SurfaceOptions(radii=(2,))), 2)

    def share(pose, cosine=0.5, least=0.0):
        out = np.empty(1)
        kernels.overlaps(
            points,
            np.array([0, len(points)]),
            np.array([0]),
            surface.target_image,
            np.ascontiguousarray(pose),
            np.eye(4)[None],
            0.1,
            cosine,
            least,
            out,
        )
        return out[0]

    assert share(T) > 0.8
    assert share(T @ se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))) == 0
    aside = T @ se3.exp(np.array([0, 0, 0, 0, 0.4, 0]))
    assert 0 < share(aside) < share(T)
    assert share(aside, least=share(aside) - 0.01) == share(aside)
    assert share(aside, least=share(aside) + 0.01) == 0
    # Entirely behind the target's surface, so there is no overlap.
    assert share(T @ se3.exp(np.array([0, 0, 1.5, 0, 0, 0]))) < 0.05


@pytest.mark.parametrize("known", [KNOWN, np.array([0, 1, 0, 0, 1, 1, 1])])
def test_pairs_of_target_have_equations_of_single_pairs(pair, known):
    source, target, T = pair
    errors = np.where(known, 0.0, 0.01)
    poses = np.stack([T, T @ se3.exp(np.full(6, 0.01))])
    views = [prepare_view(view, SHARP) for view in (source, target)]
    points = [points_of(view, 1) for view in views]
    ends = np.cumsum([0, *map(len, points)])
    scales = np.array([0.05, 0.0]), np.array([1.0, 2.0]), np.array([0.1, 0.2])
    found = np.empty((2, kernels.SIZE))
    kernels.target_equations(
        kernels.SourcePoints(
            np.concatenate(points),
            np.zeros(ends[-1], np.int64),
            ends[:-1],
            ends[1:],
            np.zeros(2, bool),
            UNDISTORTED,
        ),
        np.array([1, 0]),
        *targets(views[1:], [0, 2]),
        poses,
        kernels.PairResiduals(*scales, *SETTINGS[3:]),
        errors,
        known,
        found,
        np.empty((2, 0, kernels.PATCH_SIZE)),
    )
    for k, of in enumerate((target, source)):
        settings = (*(scale[k] for scale in scales), *SETTINGS[3:])
        alone = evaluate(of, target, poses[k], errors, known, settings)
        np.testing.assert_array_equal(found[k], alone)


def test_equations_of_few_points_do_not_depend_on_pairs_before(pair):
    """As blocks are reused, errors of the camera would add up where they have no points."""
    source, target, T = pair
    points = points_of(prepare_view(source, SHARP), 1)
    few = 50  # the first pair has all
    known, errors = KNOWN.copy(), np.zeros(kernels.ERRORS)
    known[kernels.OFFSET], errors[kernels.OFFSET] = 0, -0.05
    count = 300
    scales = (np.full(count, value) for value in SETTINGS[:3])
    found = np.empty((count, kernels.SIZE))
    kernels.target_equations(
        kernels.SourcePoints(
            points,
            np.zeros(len(points), np.int64),
            np.zeros(2, np.int64),
            np.array([len(points), few]),
            np.zeros(2, bool),
            UNDISTORTED,
        ),
        np.minimum(np.arange(count), 1),
        *targets([prepare_view(target, SHARP)], [0, count]),
        np.tile(T, (count, 1, 1)),
        kernels.PairResiduals(*scales, *SETTINGS[3:]),
        errors,
        known,
        found,
        np.empty((count, 0, kernels.PATCH_SIZE)),
    )
    assert np.isfinite(found).all()
    assert found[1, kernels.COMPARED] > 0
    np.testing.assert_array_equal(found[1:], np.tile(found[1], (count - 1, 1)))


def test_scale_of_target_is_that_of_its_depth(pair):
    source, target, T = pair
    points = points_of(prepare_view(source, SHARP), 1)
    view = SampledView.of(prepare_view(target, SHARP), 100)
    image = view.target.copy()
    image[..., residual_kernels.DISTANCE] *= 1.02
    image[..., residual_kernels.VARIANCE] *= 1.02**2
    found, _ = pair_equations(points, view, T, SETTINGS, scale=1.02)
    expected, _ = pair_equations(points, replace(view, target=image), T, SETTINGS)
    np.testing.assert_array_equal(found, expected)
    assert np.any(found != pair_equations(points, view, T, SETTINGS)[0])
