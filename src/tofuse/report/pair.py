"""`report.html` of one registered pair, a single file without external resources."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tofuse._version import __version__
from tofuse.files.atomic import write_text
from tofuse.report import pair_words, thumbnails, words
from tofuse.report.html import asset, readable, script, template
from tofuse.report.pair_scene import (
    MODES,
    SOURCE,
    TARGET,
    PairScene,
    color_bar,
    packed,
    pair_scene,
    render_modes,
)
from tofuse.report.policy import secured
from tofuse.results.pair import LocalView, PairResult

_TONES = {True: "good", False: "failed", None: "degraded"}
_TITLES = {"before": "Before", "after": "After", "distance": "After, by distance"}


def write_pair_report(result: PairResult, path: Path) -> None:
    """Write the page to `path`.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    write_text(path, secured(readable(render_pair(result))))


def render_pair(result: PairResult) -> str:
    """Return the page as HTML."""
    scene = pair_scene(result)
    head, tail = pair_words.decision(result)
    images = render_modes(scene)
    pictures = {mode: thumbnails.data_uri(image) for mode, image in images.items()}
    return template("pair.html.j2").render(
        title=f"{_short(result.source)} registered to {_short(result.target)}",
        version=__version__,
        style=asset("style.css"),
        script=script(),
        tone=_TONES[result.registration.believed],
        head=head,
        tail=tail,
        facts=_facts(result, scene),
        notes=_notes(result),
        modes=[(mode, _TITLES[mode]) for mode in MODES],
        pictures=[(mode, _TITLES[mode], pictures[mode]) for mode in MODES],
        source_color=_css(SOURCE),
        target_color=_css(TARGET),
        none_color=_css(thumbnails.NO_MEASUREMENT),
        bar=color_bar(),
        ticks=[_mm(scene.cap_m * fraction) for fraction in (0, 0.25, 0.5, 0.75, 1)],
        beyond=words.length(scene.max_distance_m),
        started="the guess" if result.guess is not None else "the identity",
        thinned=_thinned(scene),
        distance=_distance(scene),
        rows=[
            _row(name, view)
            for name, view in (("source", result.source), ("target", result.target))
        ],
        matrix=pair_words.matrix(result),
        # Only numbers and base64 are in it, so nothing can end the script element early.
        scene_json=json.dumps(packed(scene), separators=(",", ":")),
    )


def _facts(result: PairResult, scene: PairScene) -> list[tuple[str, str]]:
    registration = result.registration
    name = "Displacement of the centre" if result.source.center.any() else "Translation"
    facts = [(name, words.length(float(np.linalg.norm(result.moved_m))))]
    facts.append(("Rotation", pair_words.rotation(result).split(" about ")[0]))
    if registration.overlap is not None:
        facts.append(("Overlap", pair_words.percent(registration.overlap)))
    facts.append(("Rms distance", words.length(registration.rms_m)))
    if result.sigma != (None, None):
        facts.append(("Sigma", pair_words.sigma(result)))
    if registration.margin is not None:
        facts.append(("Margin", pair_words.percent(registration.margin)))
    return facts


def _notes(result: PairResult) -> list[tuple[str, str]]:
    """The details: a heading and a sentence each."""
    translation = pair_words.translation(result)
    if displacement := pair_words.moved_center(result):
        translation += f"; {displacement}"
    notes = [
        ("Translation", translation),
        ("Rotation", pair_words.rotation(result)),
        ("Overlap", pair_words.overlap(result)),
    ]
    if result.sigma != (None, None):
        notes.append(("Sigma", f"{pair_words.sigma(result)} ({pair_words.sigma_note(result)})"))
    if free := pair_words.unobservable(result):
        notes.append(("Unobservable", f"{free}, in the axes of the source"))
    if runner_up := pair_words.runner_up(result):
        notes.append(("Runner-up", runner_up))
    return notes


def _row(name: str, local: LocalView) -> dict[str, str]:
    view = local.view
    return {
        "role": name,
        "path": view.path,
        "format": view.format,
        "frame": str(view.index),
        "points": f"{len(view.frame):,}",
    }


def _thinned(scene: PairScene) -> str:
    if scene.shown == scene.total:
        return ""
    return f"{scene.shown:,} of {scene.total:,} points are shown."


def _distance(scene: PairScene) -> str:
    """The median distance between the views where both have a surface, as text."""
    if scene.fraction == 0:
        return f"No point is within {words.length(scene.max_distance_m)} of the other view."
    return (
        f"Median distance {_mm(scene.median_m)}, over the {pair_words.percent(scene.fraction)} of "
        f"the points that are within {words.length(scene.max_distance_m)} of the other view."
    )


def _mm(metres: float) -> str:
    return f"{1000 * metres:.3g} mm"


def _short(local: LocalView) -> str:
    return Path(local.view.name).name or local.view.name


def _css(color: tuple[int, int, int]) -> str:
    return f"rgb{color}"
