"""The commands. Heavy imports happen in the functions, when a command runs."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import fields
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console
from rich.table import Table

from tofuse.apps.cli import options as cli
from tofuse.apps.cli.progress import emit, escaped, progress_for
from tofuse.engine.errors import InputError
from tofuse.engine.quantities import count, percent
from tofuse.engine.results import Reason, Reconstruction
from tofuse.engine.stopwatch import timing

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from tofuse.apps.jobs import Options
    from tofuse.apps.viewer import LiveMap, ReportServer
    from tofuse.engine.arrays import Bool
    from tofuse.engine.graph import Optimisation, PoseGraph, certificate
    from tofuse.engine.progress import Progress

_Options = TypeVar("_Options", bound="DataclassInstance")

_SEVERITY_COLORS = {"severe": "red", "warning": "yellow", "note": "cyan"}
_NAME_WIDTH = 14  # width of the column of names
_STATUS_COLORS = {True: "green", False: "red", None: "yellow"}
_NOT_WITH_RIG = (
    *("view", "loops", "guess", "moving", "object"),
    *("average_still", "camera", "no_report", "profile", "mirrors", "factor", "prior"),
)
VERDICT_COLORS = {"good": "green", "degraded": "yellow", "failed": "red", "note": "cyan"}


def from_arguments(cls: type[_Options], arguments: cli.Command, **overrides: Any) -> _Options:
    """Make a dataclass of options from the arguments with the names of its fields.

    Fields without an argument keep their defaults; `overrides` override both.
    """
    if isinstance(arguments, cli.Written) and arguments.overwrite and arguments.out is None:
        raise InputError("requires --out", where="--overwrite", remedy="pass --out as well")
    names = [f.name for f in fields(cls) if hasattr(arguments, f.name)]
    return cls(**{name: getattr(arguments, name) for name in names} | overrides)


def make_console() -> Console:
    """Return a console for results on standard output, without wrapping or highlighting."""
    return Console(highlight=False, soft_wrap=True)


def show(
    arguments: cli.Json | cli.JsonLines | cli.Batch,
    data: dict[str, Any],
    *lines: Any,
    status: int = 0,
) -> int:
    """Print a result, with --json `data` and else `lines`, and return the exit status."""
    if isinstance(arguments, cli.Written):
        data = {**data, "out": None if arguments.out is None else str(arguments.out)}
        if arguments.out is not None:
            lines = (*lines, escaped(f"see {_page_of(arguments.out)}"))
    if arguments.json:
        emit(data)
    else:
        _print_lines(*lines)
    return status


def _print_lines(*lines: Any) -> None:
    console = make_console()
    for line in lines:
        console.print(line)


def warning_lines(warnings: Iterable[str]) -> list[str]:
    """Return warnings as lines to print."""
    return [f"[yellow]warning:[/] {escaped(warning)}" for warning in warnings]


def progress_unless_json(arguments: cli.Json) -> AbstractContextManager[Progress]:
    """The progress of a command whose --json prints a single object."""
    from tofuse.engine.progress import Silent

    return nullcontext(Silent()) if arguments.json else progress_for(as_json=False)


def run(arguments: cli.Run) -> int:
    """``tofuse run``."""
    from tofuse.apps.cli import stage_times
    from tofuse.formats.recordings import unzipped
    from tofuse.formats.rigs import rig_file_in

    in_folder = len(arguments.inputs) == 1 and rig_file_in(unzipped(arguments.inputs[0]))
    if arguments.rig is not None or in_folder:
        return _run_rig(arguments)
    if arguments.view:
        return _run_live(arguments)
    for is_set, name in ((arguments.port is not None, "--port"), (arguments.no_open, "--no-open")):
        if is_set:
            raise InputError("requires --view", where=name, remedy="pass --view as well")
    with stage_times.process_watch() as watch:
        with timing("imports"):
            from tofuse.apps.jobs import run as run_pipeline

            options = run_options(arguments)
        with progress_for(as_json=arguments.json) as progress:
            result = run_pipeline(arguments.inputs, options, progress)
        status = _finished(result, arguments.out, arguments)
    if arguments.profile:
        stage_times.print_at_exit(watch, len(result.diagnostics.frames), result.threads)
    return status


def _finished(result: Reconstruction, out: Path, arguments: cli.JsonLines) -> int:
    """Print a result, and return the exit status."""
    from tofuse.apps.jobs import exit_status

    print_result(result, out, as_json=arguments.json)
    return exit_status(result)


def run_options(arguments: cli.Run) -> Options:
    """Return the options of ``tofuse run``."""
    from tofuse.apps.jobs import Options

    return from_arguments(Options, arguments)


def _run_rig(arguments: cli.Run) -> int:
    """``tofuse run --rig``, or of a folder with a rig.json."""
    from tofuse.apps.rigs import run_rig

    options = run_options(arguments)
    for name in _NOT_WITH_RIG:
        if getattr(arguments, name) != getattr(type(arguments), name):
            option = f"--{name.replace('_', '-')}"
            raise InputError("can't be used with a rig", where=option, remedy="leave it out")
    with progress_for(as_json=arguments.json) as progress:
        rig_result = run_rig(arguments.rig, arguments.inputs, options, progress=progress)
    return _finished(rig_result.result, arguments.out, arguments)


def _run_live(arguments: cli.Run) -> int:
    """Run and show the reconstruction live; then show the result until Ctrl-C."""
    from tofuse.apps.jobs import exit_status
    from tofuse.apps.jobs import run as run_pipeline
    from tofuse.apps.results import folders
    from tofuse.apps.viewer import LiveView, address, serve, stop
    from tofuse.engine.progress import CombinedProgress

    for name in ("profile", "no_report"):
        if getattr(arguments, name):
            option = f"--{name.replace('_', '-')}"
            raise InputError("can't be used with --view", where=option, remedy="leave one out")
    options = run_options(arguments)
    folders.check_output(arguments.out, overwrite=arguments.overwrite)  # before a browser opens
    server = serve(arguments.port)
    try:
        _show(address(server), arguments)
        live = LiveView(server)
        with progress_for(as_json=arguments.json) as progress:
            result = run_pipeline(arguments.inputs, options, CombinedProgress(progress, live))
        print_result(result, arguments.out, as_json=arguments.json)
        with _report_server(arguments.out) as report:
            live.finish(report.address)
            _show(report.address, arguments)
            _wait()
    finally:
        stop(server)
    return exit_status(result)


def view(arguments: cli.View) -> int:
    """``tofuse view``."""
    with _report_server(arguments.result, arguments.port) as server:
        _show(server.address, arguments)
        _wait()
    return 0


def _report_server(folder: Path, port: int | None = None) -> ReportServer:
    """Serve the report of a result, with the images of its recording where it still exists."""
    from tofuse.apps.viewer import FrameImages, ReportServer, report_pages

    pages, images = report_pages(folder), None
    try:
        images = FrameImages.of(folder)
    except InputError as error:
        print(f"only small images of some frames are shown: {error}", file=sys.stderr)
    return ReportServer(pages, images, port)


def _show(address: str, arguments: cli.Page) -> None:
    """Print the address of a page, and open it in the browser."""
    import webbrowser

    print(f"see {address}", file=sys.stderr, flush=True)
    if not arguments.no_open:
        webbrowser.open(address)


def _wait() -> None:
    """Wait for Ctrl-C."""
    with _stop_on_signal() as stopped:
        print("press Ctrl-C to stop", file=sys.stderr, flush=True)
        while not stopped.wait(0.5):
            pass


def register(arguments: cli.Register) -> int:
    """``tofuse register``."""
    from tofuse.apps.pairs import (
        PairOptions,
        pair_exit_status,
        pair_json,
        pair_words,
        register_files,
    )

    options = from_arguments(PairOptions, arguments)
    with progress_unless_json(arguments) as progress:
        result = register_files(arguments.source, arguments.target, options, progress)
    data = pair_json(result)
    head, tail = pair_words.decision(result)
    color = _STATUS_COLORS[result.registration.believed]
    found = pair_words.lines(result)
    width = max(_NAME_WIDTH, *(len(name) for name, _ in found))
    return show(
        arguments,
        data,
        f"[bold {color}]{head.lower()}[/]" + (f": {escaped(tail)}" if tail else ""),
        *(
            escaped(f"{title:<{width}}  {row}".rstrip())
            for name, value in found
            for title, row in zip_longest([name], value.split("\n"), fillvalue="")
        ),
        *warning_lines(data["warnings"]),
        status=pair_exit_status(result),
    )


def judge(arguments: cli.Judge) -> int:
    """``tofuse judge``."""
    from tofuse.apps.jobs import judging
    from tofuse.apps.results import run_json

    options = from_arguments(judging.JudgeOptions, arguments)
    with progress_unless_json(arguments) as progress:
        judgement = judging.judge_files(
            [arguments.recording], arguments.trajectory, options, progress
        )
    consistencies = (("given", judgement.consistency), ("refined", judgement.refined_consistency))
    texts = [
        f"{name} {1e3 * c.rms_m:.1f} mm rms, {percent(c.inlier_ratio)} inliers"
        for name, c in consistencies
        if c is not None
    ]
    codes = {reason.code for reason in judgement.reasons}
    contradicted = judgement.verdict == "failed" or "inconsistent_poses" in codes
    return show(
        arguments,
        run_json.plain(judgement.to_dict()),
        *_verdict_lines(judgement.verdict, judgement.reasons),
        escaped(judging.sentence(judgement, arguments.trajectory.name)),
        *([f"map consistency: {'; '.join(texts)}"] if texts else []),
        status=3 if contradicted else 0,
    )


def merge(arguments: cli.Merge) -> int:
    """``tofuse merge``."""
    from tofuse.apps.jobs import merging

    options = from_arguments(merging.MergeOptions, arguments, seed=arguments.seed or 0)
    with progress_for(as_json=arguments.json) as progress:
        result = merging.merge_files(arguments.results, options, progress)
    return _finished(result, arguments.out, arguments)


def locate(arguments: cli.Locate) -> int:
    """``tofuse locate``."""
    from tofuse.apps.jobs import locating

    options = from_arguments(locating.LocateOptions, arguments)
    with progress_unless_json(arguments) as progress:
        located = locating.locate_files(arguments.result, arguments.input, options, progress)
    data = locating.locations_json(located, arguments.result, arguments.input)
    lines = []
    for frame in located:
        head, color = ("accepted", "green") if frame.accepted else ("rejected", "red")
        lines.append(f"[bold {color}]{head}[/] {escaped(locating.sentence(frame))}")
    lines.append(f"{data['accepted']} of {len(located)} frames located")
    return show(arguments, data, *lines, status=0 if data["accepted"] == len(located) else 3)


def print_result(result: Reconstruction, out: Path, *, as_json: bool) -> None:
    """Print a summary of a result, or with `as_json` one JSON line."""
    from tofuse.apps.report import session_words
    from tofuse.apps.results import folders, run_json
    from tofuse.engine.frames import frame_ranges
    from tofuse.engine.results import accuracy_card

    d = result.diagnostics
    sessions = session_words.session_sentences(result)
    counts = {s: sum(f.status == s for f in d.frames) for s in ("tracked", "predicted", "lost")}
    skipped = sum(f.status == "skipped" for f in d.frames)
    closures = sum(p.accepted for p in d.loops)
    if as_json:
        emit(
            {
                "event": "result",
                "out": str(out),
                "verdict": d.verdict,
                "accuracy": run_json.plain(run_json.accuracy_json(d.accuracy)),
                "reasons": run_json.reasons_json(d.reasons),
                "frames": {**counts, "skipped": skipped},
                "loops": closures,
                "sessions": sessions,
                "points": len(result.cloud),
                "seconds": round(sum(d.seconds.values()), 2),
            }
        )
        return
    parts = [f"{counts['tracked']} of {len(d.frames)} frames tracked"]
    parts += [f"{counts[s]} {s}" for s in ("predicted", "lost") if counts[s]]
    parts += [f"{skipped} unreadable"] if skipped else []
    parts += [f"{count(closures, 'loop')} closed"]
    parts += [count(len(result.cloud), "point")]
    components = [
        f"and {_page_of(out / folders.component_name(number))}, for "
        f"{frame_ranges.in_words(component.frames)}"
        for number, component in enumerate(result.components)
        if component.result is not None and not component.connected
    ]
    card = accuracy_card.SEPARATOR.join(accuracy_card.card(result))
    console = make_console()
    for line in _verdict_lines(d.verdict, d.reasons):
        console.print(line)
    for line in (*sessions, card, ", ".join(parts), f"see {_page_of(out)}", *components):
        console.print(line, markup=False)


def _page_of(folder: Path) -> Path:
    """Return the page in the folder of a result; the folder if there is none."""
    pages = (folder / name for name in ("report.html", "card.html"))
    return next((page for page in pages if page.is_file()), folder)


def _verdict_lines(verdict: str, reasons: Sequence[Reason]) -> list[str]:
    """Return the verdict, and its reasons with what to do about them."""
    from tofuse.engine.results import verdicts

    lines = [f"[bold {VERDICT_COLORS[verdict]}]{verdict}[/]"]
    for reason in verdicts.ranked(reasons):
        level = verdicts.REASONS[reason.code][0]
        lines.append(f"  [{VERDICT_COLORS[level]}]{level}:[/] {escaped(reason.text)}")
        if reason.remedy:
            lines.append(f"    [dim]{escaped(reason.remedy)}[/]")
    return lines


def inspect(arguments: cli.Inspect) -> int:
    """``tofuse inspect``."""
    from tofuse.apps.inspection import inspect_recording
    from tofuse.formats.recordings import Opening

    recording = Opening.of(arguments.inputs, arguments).open()
    inspection = inspect_recording(recording, turning=arguments.object, quick=arguments.quick)
    width = max(map(len, inspection.facts))
    lines = [f"[bold]{n:<{width}}[/]  {escaped(value)}" for n, value in inspection.facts.items()]
    lines += warning_lines(inspection.notes)
    for finding in inspection.findings:
        color = _SEVERITY_COLORS[finding.severity]
        lines.append(f"[{color}]{finding.severity}:[/] {finding.code}: {escaped(finding.text)}")
        lines.append(f"  {escaped(finding.remedy)}")
    if not inspection.findings:
        lines.append(f"[green]No{' other' if inspection.notes else ''} problems found.[/]")
    return show(arguments, inspection.to_dict(), *lines)


def convert(arguments: cli.Convert) -> int:
    """``tofuse convert``."""
    from tofuse.formats.export import convert as convert_recording
    from tofuse.formats.export import convert_to
    from tofuse.formats.recordings import Opening

    recording = Opening.of(arguments.inputs, arguments).open()
    if arguments.to == "native":
        conversion = convert_recording(recording, arguments.out)
    else:
        conversion = convert_to(recording, arguments.out, arguments.to)
    _print_lines(
        f"{count(conversion.frames, 'frame')} in {escaped(str(conversion.folder))}",
        *warning_lines((*recording.warnings, *conversion.warnings)),
    )
    return 0


def record(arguments: cli.Record) -> int:
    """``tofuse record``."""
    from tofuse.apps.live import device_named, is_installed, known_devices
    from tofuse.apps.live import record as record_stream
    from tofuse.formats.files import staging

    if arguments.device is None:
        table = Table("camera", "needs", "")
        for name, kind in known_devices().items():
            installed = "installed" if is_installed(kind) else "not installed"
            table.add_row(name, f"pip install {kind.package[0]}", installed)
        _print_lines(table)
        return 0
    if arguments.out is None:
        raise InputError("is missing", where="--out", remedy="pass a new folder")
    staging.check_new(arguments.out)  # before a camera is started
    options = dict(part.partition("=")[::2] for part in arguments.set or ())
    with (
        device_named(arguments.device, options).open() as stream,
        _stop_on_signal() as stopped,
        progress_for(as_json=False) as progress,
        _live_map(arguments) as live_map,
    ):
        progress.stage("recording (Ctrl-C stops)", arguments.frames)
        recorded = record_stream(
            stream,
            arguments.out,
            seconds=arguments.seconds,
            frames=arguments.frames,
            stopped=stopped.is_set,
            progress=lambda _: progress.advance(),
            seen=None if live_map is None else live_map.offer,
        )
    warnings = [f"{count(recorded.dropped, 'frame')} dropped: the disk was too slow"]
    _print_lines(
        f"{count(recorded.frames, 'frame')} in {escaped(str(recorded.folder))}",
        *warning_lines(warnings if recorded.dropped else []),
        *warning_lines([recorded.ended_by] if recorded.ended_by != "asked" else []),
    )
    return 0


@contextmanager
def _live_map(arguments: cli.Record) -> Iterator[LiveMap | None]:
    """Yield a map that is shown in the browser, if that is asked for."""
    from tofuse.apps.viewer import LiveMap, LiveView, address, serve, stop

    if not arguments.view:
        yield None
        return
    server = serve(arguments.port)
    try:
        _show(address(server), arguments)
        with LiveMap(LiveView(server)) as live_map:
            yield live_map
    finally:
        stop(server)


@contextmanager
def _stop_on_signal() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C or SIGTERM sets; a second signal terminates the process."""
    event = threading.Event()

    def request_stop(number: int, frame: object) -> None:
        signal.signal(number, previous[number])
        event.set()

    numbers: list[int] = [signal.SIGINT, signal.SIGTERM]
    previous = {number: signal.signal(number, request_stop) for number in numbers}
    try:
        yield event
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def evaluate(arguments: cli.Evaluate) -> int:
    """``tofuse evaluate``."""
    from tofuse.apps.jobs import evaluate as evaluate_poses

    evaluation = evaluate_poses(
        arguments.estimate,
        arguments.reference,
        recording=arguments.recording,
        reference_error_m=arguments.reference_error,
    )
    data, error, interval = evaluation.to_dict(), evaluation.error, evaluation.ate_interval_m
    for note in evaluation.notes:
        print(f"note: {note}", file=sys.stderr)
    table = Table.grid(padding=(0, 2))
    table.add_row(
        "poses compared", f"{error.associated} ({percent(error.coverage)} of the reference)"
    )
    rms = maximum = "too few poses"
    if error.associated > 1:
        rms = f"{error.ate_rms_m:.4f} m, {data['rotation_rms_deg']:.3f} deg"
        maximum = f"{error.ate_max_m:.4f} m"
    table.add_row("ATE rms", rms)
    if interval is not None:
        table.add_row("true ATE within", f"{interval[0]:.4f} to {interval[1]:.4f} m")
    table.add_row("ATE maximum", maximum)
    for r in error.relative:
        value = "too few poses"
        if r.pairs:
            angle = r.to_dict()["rotation_rms_deg"]
            value = f"{r.translation_rms_m:.4f} m, {angle:.3f} deg"
        table.add_row(f"RPE over {count(r.frames, 'frame')}", value)
    if evaluation.consistency is not None:
        m = data["map_consistency"]
        value = "no two images overlap enough"
        if m["rms_m"] is not None:
            value = f"{m['rms_m']:.5f} m rms, {m['inlier_share']:.4f} inliers, {m['pairs']} pairs"
        table.add_row("map consistency", value)
    return show(arguments, data, table)


def optimize(arguments: cli.Optimize) -> int:
    """``tofuse optimize``."""
    import numpy as np

    from tofuse.apps.calibration import check_new
    from tofuse.engine.graph import certificate, graph_covariances
    from tofuse.engine.mapping import changed, from_method
    from tofuse.formats.poses import read_g2o, write_g2o

    check_new(arguments.out, overwrite=arguments.overwrite)
    default = "levenberg-marquardt"
    part = {"part": arguments.optimiser or default}
    if part["part"] == default:
        part |= {"robust": arguments.robust or "none", "start": "best"}
    elif arguments.robust is not None:
        raise InputError(f"needs the optimiser {default}", where="--robust")
    where = "--robust" if arguments.robust is not None else "--optimiser"
    config = changed(from_method("default", "range"), {"optimiser": part}, where=where)
    graph = read_g2o(arguments.input)
    solution = config.optimiser.optimise(graph)
    write_g2o(arguments.out, solution.graph)
    certified = certificate.certify(graph_covariances.accepted_only(solution).graph)
    kept = (
        np.ones(len(graph.edges), np.bool_) if solution.weights is None else solution.weights >= 0.5
    )
    data = {
        "out": str(arguments.out),
        "poses": len(graph.ids),
        "edges": len(graph.edges),
        "before": graph.chi2(),
        "after": solution.graph.chi2(),
        "iterations": max(len(solution.objective) - 1, 0),
        "converged": solution.converged,
        "improved": solution.improved,
        "rejected": graph.ids[graph.edges[~kept]].tolist(),
        "certificate": certified and certified.to_dict(),
    }
    return show(arguments, data, *_optimised(graph, solution, kept), *_certified(certified))


def _optimised(graph: PoseGraph, solution: Optimisation, kept: Bool) -> Iterator[str]:
    yield (
        f"{count(len(graph.ids), 'pose')}, "
        f"{count(len(graph.edges), 'edge')}: squared error {graph.chi2():.6g} "
        f"to {solution.graph.chi2():.6g} in {max(len(solution.objective) - 1, 0)} iterations"
        + ("" if solution.converged else " (not converged)")
    )
    if rejected := int((~kept).sum()):
        yield (
            f"{count(rejected, 'edge')} rejected as inconsistent with the others; "
            f"squared error of the others {graph.chi2(kept):.6g} to {solution.graph.chi2(kept):.6g}"
        )
    for piece in solution.parts if len(solution.parts) > 1 else ():
        yield (
            f"part from vertex {piece.first}: {count(piece.vertices, 'pose')}, "
            f"{count(piece.edges, 'edge')}, "
            f"objective {piece.before:.6g} to {piece.after:.6g}"
        )
    if not solution.improved:
        yield "no improvement: the poses are those of the input"


def _certified(certified: certificate.Certificate | None) -> Iterator[str]:
    if certified is None:
        yield "Whether other poses fit better is not known: the graph is too large."
    elif certified.text:
        yield certified.text
    if certified is not None and not certified.optimal:
        yield (
            "That no other poses fit better is not shown: their squared error is above "
            f"{certified.lower_bound:.6g}."
        )


def export(arguments: cli.Export) -> int:
    """``tofuse export``."""
    from tofuse.apps.export import export as export_result

    for path in export_result(
        arguments.result,
        arguments.formats,
        arguments.out,
        faces=arguments.faces,
        every=arguments.every,
        pinhole=arguments.pinhole,
        voxel_m=arguments.voxel,
        overwrite=arguments.overwrite,
    ):
        print(path)
    return 0
