"""`tofuse card`: a camera over many results, with and without drift."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from posed_results import made_result
from tofuse.apps.card.drift import drift_of, holm
from tofuse.apps.card.making import SIGNIFICANCE, make_card
from tofuse.apps.cli.program import main
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.errors import InputError
from written_run_json import change_run

CAMERA = Pinhole(48, 36, 40.0, 41.0, 23.0, 18.0)
DAY = 86400.0
SIGMAS = {
    "focal": 0.001,
    "offset": 0.002,
    "center_x": 0.001,
    "center_y": 0.001,
    "distortion": 0.002,
}


def session(
    folder: Path,
    day: float,
    focal: float = 0.0,
    *,
    seed: int = 0,
    about: dict[str, Any] | None = None,
    corrections: list[dict[str, Any]] | None = None,
    camera: Pinhole = CAMERA,
) -> Path:
    """A result of a day that states errors of the camera, 0 but for the focal length."""
    folder.mkdir(parents=True)
    result = made_result(folder, camera, config={"corrections": corrections or []})
    path = folder / "scan" / "camera.json"
    stated = {"sensor": "ifm O3R (ToF)", "serial": "17"} if about is None else about
    path.write_text(json.dumps(json.loads(path.read_text()) | stated))
    rng = np.random.default_rng(seed)
    estimates = {name: [sigma * rng.normal(), sigma] for name, sigma in SIGMAS.items()}
    estimates["focal"][0] += focal
    change_run(result, refinement={"suspicion": {"estimates": estimates}})
    os.utime(folder / "scan", (day * DAY, day * DAY))
    return result


def campaign(folder: Path, drift: float = 0.0, count: int = 8) -> list[Path]:
    """Results on every tenth day, of a focal length that drifts by a fraction."""
    return [
        session(folder / f"{k}", 20_000 + 10 * k, drift * k / (count - 1), seed=k)
        for k in range(count)
    ]


def test_drift_is_found_and_stated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = campaign(tmp_path, 0.01)
    out = tmp_path / "card"
    arguments = ["card", *map(str, results[::-1]), "--out", str(out)]
    assert main(arguments) == 3
    text = " ".join(capsys.readouterr().out.split())
    assert "8 results of ifm O3R (ToF), serial number 17, 48 x 36 pixels" in text
    assert "Drift: the focal length of this camera changes with time." in text
    data = json.loads((out / "card.json").read_text())
    assert data["changed"] == ["focal"]
    assert data["camera"] == {"name": "ifm O3R (ToF)", "serial": "17", "size": [48, 36]}
    assert [s["name"] for s in data["sessions"]] == [str(r) for r in results]
    found = data["quantities"]["focal"]
    # The true focal length is 1 / (1 + error) of the stated one.
    assert found["change"] == pytest.approx(40 / 1.01 - 40, abs=3 * found["change_sigma"])
    assert found["change_sigma"] == pytest.approx(40 * 0.001 * np.sqrt(12 / 8), rel=0.5)
    assert found["p"] < 0.001
    page = (out / "card.html").read_text()
    assert "<figcaption>Focal length, px: <strong>changes</strong>" in page
    assert "2024-10-04 to 2024-12-13" in page
    assert "http:" not in page.replace("http://www.w3.org", "")
    assert "https:" not in page
    assert main(arguments) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert main([*arguments, "--overwrite", "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["changed"] == ["focal"]


def test_no_drift_is_not_found(tmp_path: Path) -> None:
    card = make_card(campaign(tmp_path))
    assert card.changed == []
    assert card.sentence.startswith("No drift")
    assert set(card.drifts) == set(SIGMAS)
    offset = card.drifts["offset"]
    assert abs(offset.mean) < 4 * offset.sigma
    assert offset.sigma == pytest.approx(0.002 / np.sqrt(8), rel=0.6)


def test_two_results_are_compared_by_their_sigmas(tmp_path: Path) -> None:
    pair = [session(tmp_path / f"{k}", 20_000 + k, 0.02 * k, seed=k) for k in range(2)]
    card = make_card(pair)
    assert card.changed == ["focal"]
    assert card.drifts["focal"].change is None
    # Nothing is known of time.
    assert card.sentence == (
        "Drift, or unlike places: the focal length differs between the results."
    )
    assert [row[-1] for row in card.rows if row[0] == "Focal length"] == ["differs"]
    assert any("twice their sigmas" in warning for warning in card.warnings)


def test_two_results_show_no_drift_but_no_difference(tmp_path: Path) -> None:
    pair = [session(tmp_path / f"{k}", 20_000 + k, seed=k) for k in range(2)]
    sentence = make_card(pair).sentence
    assert sentence == "No quantity differs between the results by more than its uncertainty."


def test_what_a_run_corrected_belongs_to_the_camera(tmp_path: Path) -> None:
    corrected = {"part": "camera-errors", "focal": 0.05, "offset_m": 0.02, "focal_sigma": 0.001}
    multipath = {"part": "multipath", "strength": [0.3, 0.05]}
    noise = {"part": "noise", "model": {"name": "mine", "range": {"a": 0.001, "b": 0.002}}}
    result = session(tmp_path / "a", 20_000, corrections=[corrected, multipath, noise])
    first, _ = make_card([result, session(tmp_path / "b", 20_001)]).sessions
    assert first.values["focal"][0] == pytest.approx(40 / 1.05, rel=0.005)
    assert first.values["offset"] == (pytest.approx(-0.02, abs=0.008), 0.002)
    assert first.values["multipath"] == (0.3, 0.05)
    assert first.noise == ("mine", 0.001, 0.002)
    assert first.by_file


@pytest.mark.parametrize(
    ("about", "message"),
    [
        ({"sensor": "ifm O3R (ToF)", "serial": "18"}, "serial number 18, 48 x 36 pixels, and"),
        ({"sensor": "MESA SR4000", "serial": "17"}, "MESA SR4000"),
        ({"sensor": "ifm O3R (ToF)"}, "pass the results of one camera"),
    ],
)
def test_mixture_of_cameras_is_refused(
    tmp_path: Path, about: dict[str, Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    results = [session(tmp_path / "a", 20_000), session(tmp_path / "b", 20_001, about=about)]
    assert main(["card", *map(str, results)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_two_results_of_the_same_frames_are_refused(tmp_path: Path) -> None:
    first, second = campaign(tmp_path, count=2)
    again = first.parent / "again"
    shutil.copytree(first, again)
    with pytest.raises(InputError, match="is of the same recording as"):
        make_card([first, second, again])


def test_results_without_estimates(tmp_path: Path) -> None:
    results = [session(tmp_path / "a", 20_000, about={}), session(tmp_path / "b", 20_001, about={})]
    change_run(results[1], refinement=None)
    card = make_card(results)
    assert card.sentence.startswith("Nothing can be tested")
    assert "1 of 2 results state no estimates of the camera" in card.warnings
    assert any("no serial number" in warning for warning in card.warnings)
    change_run(results[0], refinement=None)
    with pytest.raises(InputError, match="states no estimates of its camera"):
        make_card(results)


def test_results_with_a_severe_fault_are_left_out(tmp_path: Path) -> None:
    results = campaign(tmp_path, count=3)
    severe = {"code": "phase_wrap", "severity": "severe", "text": "", "remedy": "", "evidence": {}}
    change_run(results[1], findings=[severe])
    card = make_card(results)
    assert card.drifts["focal"].results == 2
    assert f"{results[1]} is left out: its recording has a severe fault (phase_wrap)" in (
        card.warnings
    )
    for result in results:
        change_run(result, findings=[severe])
    with pytest.raises(InputError, match="severe fault"):
        make_card(results)


def test_a_lens_with_distortion_has_the_focal_length_of_its_file(tmp_path: Path) -> None:
    lens = BrownConrady(48, 36, 40.0, 41.0, 23.0, 18.0, k1=-0.3)
    card = make_card([session(tmp_path / f"{k}", 20_000 + k, camera=lens) for k in range(2)])
    assert card.drifts["focal"].mean == pytest.approx(40, abs=0.2)


def test_trend_is_a_weighted_regression() -> None:
    rng = np.random.default_rng(0)
    t, s = np.sort(rng.uniform(0, 10, 12)), rng.uniform(0.5, 2, 12)
    y = 3 + 0.4 * t + s * rng.normal(size=12)
    found = drift_of(t, y, s, trend=True)
    (slope, _), C = np.polyfit(t, y, 1, w=1 / s, cov="unscaled")
    assert found.change == pytest.approx(slope * np.ptp(t))
    rest = ((y - np.polyval(np.polyfit(t, y, 1, w=1 / s), t)) / s) @ (
        (y - np.polyval(np.polyfit(t, y, 1, w=1 / s), t)) / s
    )
    scale = max(1.0, rest / 10)
    assert found.change_sigma == pytest.approx(np.sqrt(C[0, 0] * scale) * np.ptp(t))
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])


@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_false_alarms_are_as_rare_as_stated_whatever_the_scatter(spread: float) -> None:
    rng = np.random.default_rng(1)
    t, s = np.arange(8.0), np.ones(8)
    draws = spread * rng.normal(size=(2000, 8))
    p = np.array([drift_of(t, y, s, trend=True).p_alone for y in draws])
    assert (p < SIGNIFICANCE).mean() < 1.3 * SIGNIFICANCE
    # A single date has no trend: then it is the scatter that counts.
    assert drift_of(0 * t, draws[0], s, trend=True).change is None


@pytest.mark.parametrize("spread", [1.0, 3.0])
def test_detectable_change_is_found_as_often_as_stated(spread: float) -> None:
    rng = np.random.default_rng(2)
    t, s = np.linspace(0, 1, 12), np.ones(12)
    draws = spread * rng.normal(size=(1000, 12))
    limit = np.median([drift_of(t, y, s, trend=True).detectable(2) for y in draws])
    found = [drift_of(t, y + limit * t, s, trend=True).p_alone < SIGNIFICANCE / 2 for y in draws]
    assert np.mean(found) == pytest.approx(0.95, abs=0.04)
    # Four times as many results find half the change, and more, as they know their scatter better.
    few = drift_of(t, draws[0], s, trend=True)
    assert 0.4 < few.detectable(2, 4) / few.detectable(2) < 0.5


@pytest.mark.parametrize("results", [4, 6])
def test_few_results_find_a_change_as_often_as_stated(results: int) -> None:
    """Whatever their scatter happens to be."""
    t, s = np.linspace(0, 1, results), np.ones(results)
    limit = drift_of(t, np.zeros(results), s, trend=True).detectable(2)
    draws = np.random.default_rng(4).normal(size=(1000, results)) + limit * t
    found = [drift_of(t, y, s, trend=True).p_alone < SIGNIFICANCE / 2 for y in draws]
    assert np.mean(found) == pytest.approx(0.95, abs=0.02)


def test_card_says_which_change_of_the_range_it_would_find(tmp_path: Path) -> None:
    card = make_card(campaign(tmp_path))
    (said,) = [w for w in card.warnings if w.startswith("A change of the range offset is found")]
    offset, tests = card.drifts["offset"], len(card.drifts)
    assert f"from {1e3 * offset.detectable(tests):.1f} mm on; 5.0 mm would take" in said
    times, rest = divmod(int(said.split("would take ")[1].split()[0]), 8)
    assert rest == 0
    assert offset.detectable(tests, times) <= 0.005 < offset.detectable(tests, times - 1)


def test_rising_noise_is_found(tmp_path: Path) -> None:
    results = campaign(tmp_path)
    rng = np.random.default_rng(3)
    for k, result in enumerate(results):
        rms = 0.004 * (1 + 0.1 * k) * rng.uniform(0.95, 1.05, 30)
        frames = json.loads((result / "run.json").read_text())["frames"]
        change_run(result, frames=[frames[0] | {"rms_m": float(each)} for each in rms])
    assert make_card(results).changed == ["rms"]
