"""`batch.csv` and `batch.html`: the outcome of the jobs that have ended, updated after each."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from urllib.parse import quote

from tofuse.apps.batch.folder import BatchFolder, Record
from tofuse.apps.batch.jobs import Job
from tofuse.engine.quantities import length
from tofuse.formats.files import atomic, locked

COLUMNS = (
    *("name", "recording", "options", "state", "verdict", "position_m", "relative", "frames"),
    *("posed", "seconds", "starts", "peak_bytes", "host", "status", "reason"),
)
_REFRESH_S = 5  # interval at which the page reloads


def write_table(jobs: Sequence[Job], folder: BatchFolder) -> None:
    """Write both tables from the records in the folder, under a lock.

    Parameters
    ----------
    jobs
        All jobs of the batch.
    folder
        Its folder.

    Raises
    ------
    OutputError
        If they can't be written; earlier ones are unchanged then.
    """
    with locked(folder.lock("-table")):
        records = [(job, folder.record(job)) for job in jobs]
        ended = [(job, record) for job, record in records if record is not None and record.ended]
        atomic.write_text(folder.csv, _csv(ended))
        running = sum(record is not None and record.state == "running" for _, record in records)
        atomic.write_text(folder.html, _html(ended, len(jobs), running, folder))


def _csv(ended: Sequence[tuple[Job, Record]]) -> str:
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for job, record in ended:
        about = {"recording": job.recording, "options": " ".join(job.arguments)}
        writer.writerow({**vars(record), "name": job.name, **about})
    return buffer.getvalue()


def _html(
    ended: Sequence[tuple[Job, Record]], total: int, running: int, folder: BatchFolder
) -> str:
    from tofuse.apps.report import html

    rows = [_row(job, record, folder) for job, record in ended]
    counts = Counter(row["tone"] for row in rows)
    failed = sum(record.state == "failed" for _, record in ended)
    facts = [
        ("Recordings", f"{total}"),
        ("Good", f"{counts['good']}"),
        ("Degraded", f"{counts['degraded']}"),
        ("Failed", f"{counts['failed'] - failed}"),
        ("No result", f"{failed}"),
    ]
    if len(ended) < total:
        facts.append(("Pending", f"{total - len(ended)}"))
    seconds = sum(record.seconds or 0 for _, record in ended)
    facts.append(("Total time", duration(seconds)))
    return html.page(
        "batch.html.j2",
        title=folder.path.name,
        facts=facts,
        rows=rows,
        running=running,
        refresh=_REFRESH_S if len(ended) < total else None,
    )


def _row(job: Job, record: Record, folder: BatchFolder) -> dict[str, str | int]:
    """Return the texts of a job that has ended; `tone` is its colour: good, degraded or failed."""
    done = record.state == "done"
    accuracy = ""
    if record.position_m is not None:
        accuracy = f"±{length(record.position_m)}"
        accuracy += "" if record.relative is None else f" ({100 * record.relative:.2g} %)"
    elif done:
        accuracy = "no bound"  # not finite, or not assessed
    has_report = (folder.result(job) / "report.html").is_file()
    picture = folder.picture(job)
    return {
        "name": job.name,
        "recording": job.recording,
        "options": " ".join(job.arguments),
        "report": f"{quote(job.name)}/report.html" if done and has_report else "",
        "picture": quote(f"{picture.parent.name}/{picture.name}")
        if done and picture.is_file()
        else "",
        "verdict": record.verdict if done else "no result",
        "tone": record.verdict if done else "failed",
        "accuracy": accuracy,
        "frames": "" if record.frames is None else f"{record.posed} of {record.frames}",
        "seconds": "" if record.seconds is None else duration(record.seconds),
        "memory": "" if record.peak_bytes is None else f"{record.peak_bytes / 1e6:.0f} MB",
        "starts": record.starts,
        "reason": record.reason,
    }


def duration(seconds: float) -> str:
    """Return a duration as text: "4.2 s", "3 min 20 s", "2 h 5 min"."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, remainder = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {remainder} s"
