"""The commands of the laboratory: ``tofuse demo``, ``simulate``, ``plan`` and ``experiments``."""

from __future__ import annotations

from math import inf

from tofuse.apps.cli import options as cli
from tofuse.apps.cli import print_result, progress_for, progress_unless_json, show
from tofuse.engine.errors import InputError
from tofuse.engine.quantities import count

# Colour and exit status of the decisions of a plan, the best first.
_DECISIONS = {"enough": ("green", 0), "undecided": ("yellow", 4), "not enough": ("red", 3)}


def demo(arguments: cli.Demo) -> int:
    """``tofuse demo``."""
    from tofuse.apps.jobs import exit_status
    from tofuse.engine.compute import threads
    from tofuse.lab.demo import FAILURE
    from tofuse.lab.demo import demo as run_demo

    with progress_for(as_json=arguments.json) as progress, threads(arguments.threads):
        result = run_demo(
            FAILURE if arguments.failure else arguments.scene,
            arguments.out,
            method=arguments.method,
            seed=arguments.seed or 0,
            threads=arguments.threads,
            overwrite=arguments.overwrite,
            progress=progress,
        )
    print_result(result, arguments.out, as_json=arguments.json)
    return exit_status(result)


def simulate(arguments: cli.Simulate) -> int:
    """``tofuse simulate``."""
    from tofuse.engine.compute import threads
    from tofuse.lab.demo import simulate_to
    from tofuse.lab.simulation import Passing

    passing = None
    if arguments.with_person is not None:
        passing = Passing("person", arguments.with_person)
    elif arguments.with_box is not None:
        passing = Passing("box", arguments.with_box)
    with progress_for(as_json=False) as progress, threads(arguments.threads):
        frames = simulate_to(
            arguments.scene,
            arguments.out,
            camera=arguments.camera,
            seed=arguments.seed or 0,
            every=arguments.every,
            frames=arguments.frames,
            first=arguments.first or 0,
            texture=not arguments.uniform,
            passing=passing,
            mirror=_size(arguments.mirror),
            without=tuple(w for w in arguments.without.split(",") if w),
            correction=not arguments.no_correction,
            imu=arguments.imu,
            sigma=arguments.sigma,
            progress=progress,
        )
    print(f"{count(frames, 'frame')} in {arguments.out}")
    return 0


def plan(arguments: cli.Plan) -> int:
    """``tofuse plan``."""
    from rich.table import Table

    from tofuse.apps.results import load_result, run_json
    from tofuse.engine.compute import threads
    from tofuse.formats.poses import read_poses
    from tofuse.lab import planning

    poses = times = None
    scan = load_result(arguments.result)
    if arguments.path is not None:
        read = read_poses(arguments.path)
        poses, times = read.poses, read.timestamps
        if read.frames is not None:
            poses = poses[read.frames.argsort(kind="stable")]
    with progress_unless_json(arguments) as progress, threads(arguments.threads):
        expected = planning.expect(
            scan,
            arguments.camera or (),
            poses=poses,
            times=times,
            tolerance_m=arguments.tolerance,
            threads=arguments.threads,
            seed=arguments.seed or 0,
            progress=progress,
        )
    table = Table.grid(padding=(0, 2))
    table.add_row("camera", "bound, mm", "coverage", "frames posed", "")
    for each in expected:
        bound = f"{1e3 * each.bound_m:.1f}" if each.bound_m < inf else "none"
        color, _ = _DECISIONS[each.decision]
        table.add_row(
            each.camera,
            bound,
            f"{each.coverage:.0%}",
            f"{each.posed:.0%}",
            f"[{color}]{each.decision}[/]",
        )
    return show(
        arguments,
        run_json.plain({"tolerance_m": arguments.tolerance, "cameras": [*map(vars, expected)]}),
        table,
        status=next(
            status
            for decision, (_, status) in _DECISIONS.items()
            if any(each.decision == decision for each in expected)
        ),
    )


def _size(text: str | None) -> tuple[float, float] | None:
    """Return width and height of a mirror, m."""
    if text is None:
        return None
    parts = text.lower().split("x")
    try:
        width, height = (float(part) for part in parts)
    except ValueError:
        width = height = 0.0
    if not (0.05 <= width <= 10 and 0.05 <= height <= 10):
        raise InputError(
            f"is {text!r}", where="--mirror", remedy="give width x height in m, such as 0.8x1.2"
        )
    return width, height


def experiments(arguments: cli.Experiments) -> int:
    """``tofuse experiments``."""
    from tofuse.engine.compute import threads
    from tofuse.lab.experiments import run_experiments

    with progress_for(as_json=False) as progress, threads(arguments.threads):
        page = run_experiments(
            arguments.out,
            cases=tuple(c for c in arguments.cases.split(",") if c),
            seeds=arguments.seeds,
            seed=arguments.seed or 0,
            overwrite=arguments.overwrite,
            progress=progress,
        )
    print(f"see {page}")
    return 0
