"""`tofuse experiments`: run the cases, test the statements, write one page and the numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse._version import __version__
from tofuse.apps.results import folders, run_json
from tofuse.engine.errors import InputError
from tofuse.engine.progress import Progress, Silent
from tofuse.lab.experiments import sections
from tofuse.lab.experiments.cases import CASES, DRAWS, METHODS, CaseResult, Run, run_case
from tofuse.lab.experiments.peaks import AXES, SIGMAS_M, PeaksSweep, sweep_peaks
from tofuse.lab.experiments.statements import JudgedStatement, Results, judge_all

if TYPE_CHECKING:
    from jinja2 import Template

_MARKER = "results.json"
_CONTRACT = folders.Contract.of_files(_MARKER, "index.html", keys=("kind", "statements"))
NAMES = (*(case.scene for case in CASES), "peaks")


def run_experiments(
    out: Path,
    *,
    cases: tuple[str, ...] = (),
    seeds: int = 20,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress | None = None,
    limit: int | None = None,
    draws: int = DRAWS,
) -> Path:
    """Reproduce chapters 4 and 5 of the thesis, and write ``index.html`` and ``results.json``.

    Parameters
    ----------
    cases
        Some of `NAMES`; all if empty.
    seeds
        Number of noise seeds of the synthetic case.
    seed
        The first of them, and the seed of the other cases.
    overwrite
        Replace the result of earlier experiments in `out`.
    limit
        Maximum number of raw frames of simulated sequences.
    draws
        See `run_case`.

    Returns
    -------
    The path of the page.

    Raises
    ------
    InputError
        For an unknown case.
    OutputError
        If the folder contains other files, or can't be written.
    """
    progress = progress or Silent()
    for name in cases:
        if name not in NAMES:
            raise InputError(
                f"there is no case {name!r}", where="--cases", remedy=f"use some of {list(NAMES)}"
            )
    selected = cases or NAMES
    start = perf_counter()
    with folders.OutputFolder(out, overwrite=overwrite, contract=_CONTRACT) as folder:
        # BLAS sums depend on its number of threads; ours don't.
        with threadpool_limits(1):
            results = _run_all(selected, seeds, seed, progress, limit, draws)
            judged = judge_all(results, METHODS)
        parameters = {"cases": list(selected), "seeds": seeds, "seed": seed, "draws": draws}
        parameters |= {} if limit is None else {"limit": limit}
        progress.stage("drawing")
        seconds = perf_counter() - start
        page = render(results, judged, parameters, seconds)
        data = results_json(results, judged, parameters, seconds)
        with folder.staging() as staging:
            (staging / "index.html").write_text(page, encoding="utf-8")
            run_json.write_object(staging / _MARKER, data)
    return out / "index.html"


def _run_all(
    selected: tuple[str, ...],
    seeds: int,
    seed: int,
    progress: Progress,
    limit: int | None,
    draws: int,
) -> Results:
    case_results = {
        case.scene: run_case(case, seed, progress, limit=limit, draws=draws)
        for case in CASES
        if case.scene in selected
    }
    peaks = None
    if "peaks" in selected:
        progress.stage("peaks: registering", seeds * len(SIGMAS_M))
        peaks = sweep_peaks(range(seed, seed + seeds), on_finished=progress.advance)
    return Results(case_results, peaks)


def results_json(
    results: Results,
    judged: tuple[JudgedStatement, ...],
    parameters: Mapping[str, Any],
    seconds: float,
) -> dict[str, Any]:
    """Return the content of ``results.json``: SI units, and degrees where a name says so."""
    return {
        "kind": "experiments",
        "schema": 1,
        "version": __version__,
        "parameters": dict(parameters),
        "seconds": {
            "total": round(seconds, 2),
            **{
                name: {k: round(v, 2) for k, v in case.seconds.items()}
                for name, case in results.cases.items()
            },
        },
        "statements": [
            {
                "name": j.statement.name,
                "section": j.statement.section,
                "text": j.statement.quote,
                "findings": {
                    method: {"outcome": f.outcome, "numbers": f.numbers}
                    for method, f in j.findings.items()
                },
            }
            for j in judged
        ],
        "cases": {name: _case_json(case) for name, case in results.cases.items()},
        "peaks": None if results.peaks is None else _peaks_json(results.peaks),
    }


def _case_json(result: CaseResult) -> dict[str, Any]:
    return {
        "section": result.case.section,
        "thesis_stride": result.case.stride,
        "facts": {str(k): _with_string_keys(v) for k, v in result.facts.items()},
        "true_poses": result.perfect.sizes,
        "runs": [_run_json(run) for run in result.runs],
    }


def _with_string_keys(value: Any) -> Any:
    return (
        {str(k): _with_string_keys(v) for k, v in value.items()}
        if isinstance(value, dict)
        else value
    )


def _run_json(run: Run) -> dict[str, Any]:
    data: dict[str, Any] = {
        "method": run.method,
        "guess": run.guess,
        "stride": run.stride,
        "draw": run.draw,
        "frames": len(run.truth),
        "with_pose": run.posed,
        "loop": {"accepted": run.loop[0], "reason": run.loop[1]},
        "verdict": run.verdict,
        "objective": run.objective,
        "seconds": round(run.seconds, 3),
    }
    for name, estimate in (("before", run.before), ("after", run.after)):
        score, model = estimate.score, estimate.model
        data[name] = {
            "ate_rms_m": score.ate_m,
            "rotation_rms_deg": score.rotation_deg,
            "end_error_m": score.end_m,
            "end_error_deg": score.end_deg,
            "axes_rms_m": score.axes_rms_m,
            "drift_m": np.round(score.drift, 5),
            "model": model.sizes,
        }
        if model.box is not None:
            data[name]["box_angles_deg"] = model.box.angles_deg
    return data


def _peaks_json(sweep: PeaksSweep) -> dict[str, Any]:
    def both(values: Any) -> dict[str, Any]:
        return {"sequential": values[:, 0], "optimised": values[:, 1]}

    return {
        "sigma_m": sweep.sigmas,
        "position_m": both(sweep.position),
        "rotation_rad": both(sweep.rotation),
        "axes": list(AXES),
        "axes_mean": both(sweep.axes),
        "axes_spread": both(sweep.axes_std),
    }


def render(
    results: Results,
    judged: tuple[JudgedStatement, ...],
    parameters: Mapping[str, Any],
    seconds: float,
) -> str:
    """Return the page as HTML, without external resources."""
    counts = Counter(j.findings[METHODS[0]].outcome for j in judged)
    return _template().render(
        version=__version__,
        style=_template_text("tofuse.apps.report", "style.css")
        + _template_text("tofuse.lab.experiments", "style.css"),
        judged=judged,
        methods=METHODS,
        counts=counts,
        cases=[sections.case_section(case) for case in results.cases.values()],
        peaks=None if results.peaks is None else sections.peaks_section(results.peaks),
        parameters=parameters,
        strides={case.scene: case.stride for case in CASES},
        minutes=f"{seconds / 60:.1f}",
    )


def _template_text(package: str, name: str) -> str:
    return (resources.files(package) / "templates" / name).read_text(encoding="utf-8")


@cache
def _template() -> Template:
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_template_text("tofuse.lab.experiments", "experiments.html.j2"))
