"""Each effect of the simulated camera, switched on alone, shows its physical signature."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.geometry import se3
from tofuse.formats.cameras.calibration_files import corrected_depth
from tofuse.lab.simulation import sensor
from tofuse.lab.simulation.effects import Effects, Flag
from tofuse.lab.simulation.models import CAMERAS, camera_model
from tofuse.lab.simulation.render import RenderedFrame, render
from tofuse.lab.world.scene import Hits, Sequence, build

SMALL = Pinhole(44, 36, 57.0, 57.0, 21.5, 17.5)
# Without blur, so that sums over sub-rays are exact.
MODEL = replace(camera_model("sr4000"), camera=SMALL, blur_px=0.0)
CENTRE = (18, 22)


@dataclass
class Board:
    """A parallelogram: centre and two half sides."""

    centre: tuple[float, float, float]
    a: tuple[float, float, float] = (50.0, 0.0, 0.0)
    b: tuple[float, float, float] = (0.0, 50.0, 0.0)
    albedo: float = 0.5
    gloss: float = 0.0


@dataclass
class Boards:
    """A scene of boards, cast at by plain NumPy; x right, y down, z forward from the camera."""

    boards: list[Board]
    ambient: float = 0.0
    name: str = field(default="boards")
    passing_surfaces: frozenset[int] = frozenset()

    def cast(self, origins, directions, T_room_bodies=None) -> Hits:
        directions = np.asarray(directions, float)
        origins = np.broadcast_to(np.asarray(origins, float), directions.shape)
        best = np.full(len(directions), np.inf)
        normal = np.zeros(directions.shape)
        albedo, gloss = np.zeros(len(directions)), np.zeros(len(directions))
        for board in self.boards:
            a, b = np.array(board.a), np.array(board.b)
            n = np.cross(a, b) / np.linalg.norm(np.cross(a, b))
            with np.errstate(all="ignore"):
                t = ((board.centre - origins) @ n) / (directions @ n)
                p = origins + t[:, None] * directions - board.centre
                inside = (np.abs(p @ a) <= a @ a) & (np.abs(p @ b) <= b @ b)
            hit = inside & (t > 1e-9) & (t < best)
            best[hit] = t[hit]
            facing = np.where((directions @ n > 0)[:, None], -n, n)
            normal[hit] = facing[hit]
            albedo[hit], gloss[hit] = board.albedo, board.gloss
        return Hits(
            best.astype(np.float32),
            normal.astype(np.float32),
            albedo.astype(np.float32),
            gloss.astype(np.float32),
            np.where(np.isfinite(best), 0, -1).astype(np.int32),
        )


STILL = Sequence(100, 1, 30.0, lambda t: np.eye(4))


def wall(z: float, albedo: float = 0.5, gloss: float = 0.0, ambient: float = 0.0) -> Boards:
    return Boards([Board((0, 0, z), albedo=albedo, gloss=gloss)], ambient)


def shoot(
    scene, effects: Effects, index: int = 0, model=MODEL, sequence=STILL, seed=0
) -> RenderedFrame:
    return render(scene, sequence, model, index, effects=effects, seed=seed)


def ranges(scene, effects: Effects, **more) -> np.ndarray:
    """Radial range of the frame."""
    return shoot(scene, effects, **more).frame.radial_range.astype(float)


def stack(scene, effects: Effects, frames: int, **more) -> np.ndarray:
    return np.stack([ranges(scene, effects, index=k, **more) for k in range(frames)])


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_ideal_camera_measures_ground_truth(name: str) -> None:
    model = camera_model(name)
    small = replace(model.camera, width=24, height=20, cx=11.0, cy=9.0)
    model = replace(model, camera=small)
    for z in (0.9, 2.7, 4.1):
        rendered = shoot(wall(z), Effects.none(), model=model)
        np.testing.assert_allclose(
            rendered.frame.depth, rendered.depth, atol=0.51 * model.depth_unit_m + 2e-6
        )
        np.testing.assert_allclose(rendered.frame.z, z, atol=model.depth_unit_m)
        assert rendered.frame.depth_kind == model.depth_kind


def test_amplitude_follows_albedo_incidence_and_range() -> None:
    model = replace(MODEL, amplitude_kind="raw", falloff=0.0)

    def counts(board: Board) -> float:
        frame = shoot(Boards([board]), Effects.none(), model=model).frame
        return float(frame.amplitude_image[18, 22])

    one = counts(Board((0, 0, 1.0), albedo=0.8))
    assert counts(Board((0, 0, 1.0), albedo=0.2)) == pytest.approx(one / 4, rel=0.01)
    assert counts(Board((0, 0, 2.0), albedo=0.8)) == pytest.approx(one / 4, rel=0.01)
    tilted = Board((0, 0, 1.0), a=(40.0, 0, 40.0), albedo=0.8)
    # 45 degrees at the axis; the pixel is half a pixel off it.
    assert counts(tilted) == pytest.approx(one * np.sqrt(0.5), rel=0.03)


def test_shot_noise_falls_with_amplitude() -> None:
    effects = Effects.none(shot_noise=True)
    found, expected = [], []
    for albedo in (0.05, 0.15, 0.6):
        seen = stack(wall(2.0, albedo), effects, 40)[:, 14:22, 18:26]
        found.append(seen.std(0).mean())
        signal = MODEL.signal_electrons * albedo / 4
        # Difference of two buckets, two of the four phase images to a component of the phasor.
        variance = (signal + 2 * MODEL.read_noise_electrons**2) / 2
        phase = np.sqrt(variance) / (MODEL.modulation_contrast * signal)
        expected.append(phase * MODEL.period_m / (2 * np.pi))
    np.testing.assert_allclose(found, expected, rtol=0.08)
    # Read noise dominates in the dark: a third of the amplitude, nearly three times the noise.
    assert 2.2 < found[0] / found[1] < 3.0


def edge(near: float, far: float, u: float) -> Boards:
    """A near board that covers the columns left of pixel coordinate u, and a far wall."""
    x = (u - MODEL.camera.cx) / MODEL.camera.fx * near
    return Boards([Board((x - 5, 0, near), a=(5.0, 0, 0)), Board((0, 0, far))])


def mixed_range(near: float, far: float, share: float, row: int, column: int) -> float:
    """Range of a pixel of which the near board covers a share, by the phasor sum."""
    x = (column - MODEL.camera.cx) / MODEL.camera.fx
    y = (row - MODEL.camera.cy) / MODEL.camera.fy
    length = np.sqrt(1 + x * x + y * y)
    total = 0
    for z, part in ((near, share), (far, 1 - share)):
        r = z * length
        total += part / length / r**2 * np.exp(2j * np.pi * r / MODEL.period_m)
    return float(np.mod(np.angle(total) / (2 * np.pi), 1) * MODEL.period_m)


def test_mixed_pixels_are_phasor_sums() -> None:
    # On the half-pixel grid, the border between two pixels has weight 1/4, the centre 1/2.
    for offset, share in ((-0.25, 0.25), (0.25, 0.75)):
        rendered = shoot(edge(1.2, 2.2, 25 + offset), Effects.none(mixed_pixels=True))
        seen = rendered.frame.radial_range[16:20, 25]
        expected = [mixed_range(1.2, 2.2, share, v, 25) for v in range(16, 20)]
        np.testing.assert_allclose(seen, expected, atol=0.003)
        assert np.all((seen > 1.22) & (seen < 2.1))
        flagged = rendered.flags & Flag.MIXED > 0
        assert flagged[:, 25].all()
        assert not flagged[:, :24].any()
        assert not flagged[:, 27:].any()


def test_range_beyond_period_wraps() -> None:
    wrapped = shoot(wall(6.2), Effects.none(wrap=True))
    np.testing.assert_allclose(
        wrapped.frame.radial_range, ranges(wall(6.2), Effects.none()) - 5.0, atol=2e-4
    )
    assert (wrapped.flags & Flag.WRAPPED).all()
    assert not (shoot(wall(3.0), Effects.none(wrap=True)).flags & Flag.WRAPPED).any()


def test_second_frequency_resolves_ambiguity() -> None:
    model = camera_model("kinect2")
    true = np.linspace(0.01, model.ambiguity_m - 0.01, 3001)
    phasors = np.stack([np.exp(2j * np.pi * true * 2 * f / 299792458.0) for f in model.frequencies])
    np.testing.assert_allclose(sensor.unwrapped_range(model, phasors), true, atol=1e-9)


def test_wiggling_has_four_periods_per_phase_period() -> None:
    model = replace(MODEL, camera=Pinhole(8, 8, 57.0, 57.0, 4.0, 4.0))
    true = (np.arange(32) + 0.5) / 32 * model.period_m
    measured = np.array(
        [ranges(wall(z), Effects.none(wiggling=1.0), model=model)[4, 4] for z in true]
    )
    error = measured - true
    spectrum = np.abs(np.fft.rfft(error))
    assert spectrum.argmax() == 4
    assert spectrum[4] > 20 * np.delete(spectrum, [4, 8]).max()
    # Both harmonics alias onto the first with opposite signs: -h3 sin 4 phi + h5 sin 4 phi.
    h3, h5 = model.harmonics
    amplitude = 2 * spectrum[4] / 32
    assert amplitude == pytest.approx((h3 - h5) * model.period_m / (2 * np.pi), rel=0.05)


def test_scattering_biases_background_towards_bright_foreground() -> None:
    near = Board((-0.25, 0, 0.5), a=(0.2, 0, 0), b=(0, 0.5, 0), albedo=0.9)
    scene = Boards([near, Board((0, 0, 2.0), albedo=0.3)])
    bias = ranges(scene, Effects.none(scatter=0.02)) - ranges(scene, Effects.none())
    pull = bias[18, 24:]
    assert (pull < -0.003).all()
    assert pull[0] < -0.04
    assert pull[0] < pull[6] < pull[14]
    assert np.abs(bias[:, :12]).max() < 0.01
    twice = ranges(scene, Effects.none(scatter=0.04)) - ranges(scene, Effects.none())
    assert twice[18, 30] / bias[18, 30] == pytest.approx(2, rel=0.3)
    flags = shoot(scene, Effects.none(scatter=0.02)).flags & Flag.SCATTER > 0
    assert flags[18, 24:40].all()


def corner(albedo: float = 0.6) -> Boards:
    """Two walls at a right angle, whose edge is seen at 2 m in the image's middle."""
    s = np.sqrt(0.5)
    half = 1.5
    return Boards(
        [
            Board((-half * s, 0, 2 - half * s), (half * s, 0, half * s), (0, 3, 0), albedo),
            Board((half * s, 0, 2 - half * s), (half * s, 0, -half * s), (0, 3, 0), albedo),
        ]
    )


def test_corner_multipath_matches_integral_over_walls() -> None:
    """Falloff: half lamp, half lens; bounced light has that of the lamp at its source."""
    model = replace(MODEL, camera=Pinhole(176, 144, 152.0, 152.0, 87.5, 71.5))
    found = render(corner(), STILL, model, 0, effects=Effects.none(multipath=True)).frame
    direct = render(corner(), STILL, model, 0, effects=Effects.none()).frame
    k = 2 * np.pi / (2 * model.period_m)
    # Uniform points of both walls; the lamp fades out at 1.1 to 1.3 times the corner angle.
    along, up = np.meshgrid((np.arange(600) + 0.5) / 200, (np.arange(800) - 399.5) / 133)
    s, area = np.sqrt(0.5), (1 / 200) * (1 / 133)
    corner_angle = np.arctan(np.nanmax(np.linalg.norm(model.camera.rays(), axis=-1)))
    for row, column in ((74, 14), (72, 50), (26, 62), (120, 74), (14, 98), (134, 162)):
        side = 1.0 if column < 88 else -1.0
        r = float(direct.radial_range[row, column])
        ray = np.append(model.camera.rays()[row, column], 1.0)
        x = r * ray / np.linalg.norm(ray)
        n, m = np.array([side * s, 0, -s]), np.array([-side * s, 0, -s])
        q = np.stack([side * s * along, up, 2 - s * along], -1)
        d = np.linalg.norm(q, axis=-1)
        angle = np.arccos(q[..., 2] / d)
        lamp = np.cos(angle) ** 2 * np.clip((1.3 - angle / corner_angle) / 0.2, 0, 1)
        step = x - q
        way = np.linalg.norm(step, axis=-1)
        form = np.clip(step @ m, 0, None) * np.clip(-step @ n, 0, None) / (np.pi * way**4) * area
        light = (0.6 * lamp * -(q @ m) / d**3 * form * np.exp(1j * k * (d + way))).sum()
        own = -(x @ n) / r**3 * (x[2] / r) ** 2
        ratio = 1 + light * np.exp(-1j * k * r) / own
        bias = found.radial_range[row, column] - r
        assert bias == pytest.approx(np.angle(ratio) / (2 * k), rel=0.05, abs=0.001)
        share = found.amplitude_image[row, column] / direct.amplitude_image[row, column]
        share *= (r / found.radial_range[row, column]) ** 2
        assert share == pytest.approx(np.abs(ratio), rel=0.01)


def test_mirror_shows_reflected_surface_at_longer_path() -> None:
    # A mirror at 45 degrees 1 m ahead; a wall 1.5 m to its side, out of the camera's view.
    mirror = Board((0, 0, 1.0), a=(0.7, 0, 0.7), b=(0, 1, 0), albedo=0.0, gloss=1.0)
    side = Board((1.5, 0, 1.0), a=(0, 0, 3), b=(0, 3, 0), albedo=0.8)
    rendered = shoot(Boards([mirror, side]), Effects.none(gloss=True))
    assert rendered.frame.radial_range[CENTRE] == pytest.approx(2.5, abs=0.05)
    assert rendered.flags[CENTRE] & Flag.MIRROR
    assert rendered.depth[CENTRE] == pytest.approx(1.0, abs=0.02)


def test_mirror_without_reflected_surface_returns_nothing() -> None:
    mirror = Board((0, 0, 1.0), a=(0.7, 0, 0.7), b=(0, 1, 0), albedo=0.8, gloss=1.0)
    rendered = shoot(Boards([mirror]), Effects.none(gloss=True))
    assert rendered.frame.confidence_image[CENTRE] == 0
    assert rendered.flags[CENTRE] & Flag.UNDER_EXPOSED
    matte = shoot(Boards([mirror]), Effects.none(gloss=False))
    assert matte.frame.radial_range[CENTRE] == pytest.approx(1.0, abs=0.02)


def test_strong_light_saturates() -> None:
    rendered = shoot(wall(0.25, 0.9), Effects.none(saturation=True))
    assert (rendered.frame.amplitude_image == 65535).all()
    assert (rendered.frame.depth == 0).all()
    assert (rendered.frame.confidence_image == 0).all()
    assert (rendered.flags & Flag.SATURATED).all()
    fine = shoot(wall(2.0, 0.9), Effects.none(saturation=True))
    assert (fine.frame.amplitude_image < 65535).all()


def test_confidence_rises_with_falling_noise() -> None:
    board = [Board((0, 0, 2.0), albedo=0.0)]
    board = [
        Board(((k - 5.5) * 0.15, 0, 2.0), a=(0.075, 0, 0), b=(0, 2, 0), albedo=0.004 * 1.6**k)
        for k in range(12)
    ]
    frames = [shoot(Boards(board), Effects.none(shot_noise=True), index=k).frame for k in range(30)]
    confidence = np.round(np.mean([f.confidence_image for f in frames], 0))
    noise = np.std([f.radial_range for f in frames], 0)
    levels = [np.median(noise[confidence == c]) for c in range(8)]
    assert (np.diff(levels) < 0).all()
    assert levels[0] > 0.2
    assert levels[7] < 0.02


def turning(degrees_per_second: float) -> Sequence:
    def pose(t: float) -> np.ndarray:
        return se3.exp([0, 0, 0, 0, np.radians(degrees_per_second) * t, 0])

    return Sequence(100, 1, 30.0, pose)


def test_motion_smears_edges() -> None:
    scene = edge(1.2, 2.2, 25.1)
    sharp, smeared = (Effects.none(smear=on) for on in (False, True))
    np.testing.assert_array_equal(ranges(scene, sharp), ranges(scene, smeared))
    sequence = turning(90.0)
    moved = shoot(scene, smeared, sequence=sequence)
    error = np.abs(moved.frame.radial_range - ranges(scene, sharp, sequence=sequence))
    beside = np.r_[0:22, 29:44]
    assert error[:, 23:28].max() > 0.05
    assert error[:, beside].max() < 0.02
    flags = moved.flags & Flag.SMEAR > 0
    assert flags[:, 23:28].any(1).all()
    assert not (shoot(scene, smeared).flags & Flag.SMEAR).any()


def test_phase_images_are_exposed_sequentially() -> None:
    """An approaching wall: the four samples measure it at four ranges."""
    speed = 2.0

    def pose(t: float) -> np.ndarray:
        T = np.eye(4)
        T[2, 3] = speed * t
        return T

    sequence = Sequence(10, 1, 30.0, pose)
    model = replace(MODEL, camera=Pinhole(8, 8, 57.0, 57.0, 4.0, 4.0), falloff=0.0)
    seen = ranges(wall(3.0), Effects.none(smear=True), model=model, sequence=sequence)[4, 4]
    times = (np.arange(4) - 1.5) / 4 * model.integration_s
    r = 3.0 - speed * times
    phase = 2 * np.pi * r / model.period_m
    d = np.cos(phase - np.arange(4) * np.pi / 2) / r**2
    expected = np.angle((d[0] - d[2]) + 1j * (d[1] - d[3])) / (2 * np.pi) * model.period_m
    assert seen == pytest.approx(np.mod(expected, model.period_m), abs=1e-4)
    assert abs(seen - 3.0) > 3e-4


@pytest.mark.parametrize("name", ["sr4000", "kinect2", "pico-flexx"])
def test_factory_correction_leaves_less_than_1_mm(name: str) -> None:
    model = camera_model(name)
    small = replace(model.camera, width=120, height=100, cx=60.0, cy=50.0)
    model = replace(model, camera=small)
    effects = Effects().without(
        "shot_noise", "scatter", "multipath", "thermal_drift", "under_exposure", "saturation"
    )
    correction = sensor.factory_correction(model, effects)
    for z in (1.1, 2.9):
        rendered = shoot(wall(z), effects, model=model)
        frame = rendered.frame
        depth = corrected_depth(correction, frame.camera, frame.depth, frame.depth_kind)
        error = (depth - rendered.depth).astype(float)
        before = (frame.depth - rendered.depth).astype(float)
        assert np.sqrt((error**2).mean()) < 0.001
        assert np.sqrt((before**2).mean()) > 2 * np.sqrt((error**2).mean())


def test_rendering_is_independent_of_threads_and_other_frames() -> None:
    scene, sequence = build("corner")
    model = replace(camera_model("sr4000"), camera=MODEL.camera)

    def take(index: int, seed: int = 0) -> tuple[bytes, ...]:
        rendered = render(scene, sequence, model, index, seed=seed)
        frame = rendered.frame
        return (
            frame.depth.tobytes(),
            frame.amplitude_image.tobytes(),
            frame.confidence_image.tobytes(),
            rendered.flags.tobytes(),
        )

    with threads(1):
        one = take(3)
    with threads(2):
        take(1)
        assert take(3) == one
    assert take(3, seed=1)[0] != one[0]


def test_ifm_states_correct_noise() -> None:
    model = replace(camera_model("ifm-o3r"), camera=MODEL.camera)
    effects = Effects.none(shot_noise=True)
    seen = stack(wall(2.0, 0.3), effects, 40, model=model)
    stated = shoot(wall(2.0, 0.3), effects, model=model).frame.sigma_image
    assert np.median(stated) == pytest.approx(np.median(seen.std(0, ddof=1)), rel=0.1)
