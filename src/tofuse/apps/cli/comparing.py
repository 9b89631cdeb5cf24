"""``tofuse compare``, ``tofuse repeat`` and ``tofuse card``."""

from __future__ import annotations

from rich.table import Table

from tofuse.apps.cli import options as cli
from tofuse.apps.cli.commands import from_arguments, progress_unless_json, show, warning_lines
from tofuse.apps.cli.progress import escaped

_COLORS = {"pass": "green", "fail": "red", "undecided": "yellow"}
_ROWS = 12  # regions that are printed


def compare(arguments: cli.Compare) -> int:
    """``tofuse compare``."""
    from tofuse.apps.compare import CompareOptions, compare_exit_status, compare_files, millimetres

    options = from_arguments(CompareOptions, arguments)
    with progress_unless_json(arguments) as progress:
        comparison = compare_files(arguments.result, arguments.reference, options, progress)
    head, found, rest = comparison.sentence.partition(": ")
    sentence = escaped(comparison.sentence)
    if color := _COLORS.get(head.lower()) if found else None:
        sentence = f"[bold {color}]{head.lower()}[/]: {escaped(rest)}"
    table = Table.grid(padding=(0, 2))
    table.add_row("region", "verdict", "seen", "mean, mm", "worst, mm", "detection limit, mm")
    seen = [region for region in comparison.regions if region.places]
    for region in sorted(seen, key=lambda r: -abs(r.worst_m))[:_ROWS]:
        verdict = region.verdict if comparison.verdict else "changed" if region.changed else "-"
        table.add_row(
            region.name,
            verdict,
            f"{region.seen:.0%}",
            millimetres(region.mean_m),
            millimetres(region.worst_m),
            millimetres(region.detectable_m),
        )
    return show(
        arguments,
        comparison.to_dict(),
        sentence,
        table,
        *warning_lines(comparison.warnings),
        status=compare_exit_status(comparison),
    )


def repeat(arguments: cli.Repeat) -> int:
    """``tofuse repeat``."""
    from tofuse.apps.compare import RepeatOptions, repeat_files

    options = from_arguments(RepeatOptions, arguments)
    with progress_unless_json(arguments) as progress:
        found = repeat_files(arguments.results, options, progress)
    table = Table.grid(padding=(0, 2))
    table.add_row("standard deviation", "repeatability", "reproducibility", "total", "quantities")

    def text(value: float | None, unit: str) -> str:
        if value is None:
            return "-"
        return f"{1e3 * value:.3g} {'mm' if unit == 'm' else 'mrad'}"

    for c in found.components:
        values = (c.repeatability, c.reproducibility, c.total)
        table.add_row(c.name, *(text(value, c.unit) for value in values), f"{c.quantities:,}")
    bounds = [
        f"{h.name}: {h.share:.1%} of {h.differences:,} differences are within the combined 95 % "
        f"bounds ({h.low:.0%} to {h.high:.0%})"
        for h in found.held
    ]
    sessions = len({session.session for session in found.sessions})
    return show(
        arguments,
        found.to_dict(),
        f"{len(found.sessions)} results of {sessions} session{'s' * (sessions > 1)}, "
        f"{found.common:.0%} of the first surface seen by all",
        table,
        *map(escaped, bounds),
        *warning_lines(found.warnings),
    )


def card(arguments: cli.Card) -> int:
    """``tofuse card``."""
    from tofuse.apps.card import card_files
    from tofuse.apps.results import folders

    found = card_files(arguments.results, from_arguments(folders.OutputOptions, arguments))
    table = Table("quantity", "mean", "scatter", "over the time", "p", "", box=None)
    for row in found.rows:
        table.add_row(*row)
    return show(
        arguments,
        found.to_dict(),
        escaped(f"{len(found.sessions)} results of {found.camera}"),
        escaped(found.sentence),
        table,
        *warning_lines(found.warnings),
        status=3 if found.changed else 0,
    )
