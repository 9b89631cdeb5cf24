"""The views of the recording: the effect of the filters on one, and samples of all."""

from __future__ import annotations

from tofuse.files.memory import give_back
from tofuse.recordings.frames import RangeFrame
from tofuse.report import thumbnails, words
from tofuse.report.pictures import FATES, KINDS, depth_range, draw
from tofuse.report.section_frames import frame_text
from tofuse.report.subject import Subject, Values

_THUMBNAIL, _FILTER = 220, 320  # px


def filters(s: Subject) -> Values:
    """Return one frame after each filter (figure 3.2), and the fractions removed."""
    removed, steps = s.result.diagnostics.removed, s.extras.filter_steps
    counts: dict[str, tuple[int, int]] = {}  # points removed, of all; a filter may be used twice
    shown = []
    if steps:
        raw = steps[0][1]
        limits = thumbnails.depth_limits(raw)
        framing = thumbnails.Framing.around(raw.points.astype(float), (_FILTER, 240))
        previous = raw
        for k, (name, frame) in enumerate(steps):
            if k:
                num_removed = len(previous) - len(frame)
                fraction = words.percent(num_removed / len(previous) if len(previous) else None)
                text = f"removed {fraction} ({num_removed:,} points), {len(frame):,} are left"
                if not num_removed and name not in removed:
                    text = f"corrects; {words.count(len(frame), 'point')}"
                before = counts.get(name, (0, 0))
                counts[name] = (before[0] + num_removed, before[1] + len(previous))
            else:
                text = words.count(len(frame), "point")
            pictures = []
            if isinstance(frame, RangeFrame):
                removed_mask = None
                if k and isinstance(previous, RangeFrame):
                    removed_mask = previous.valid & ~frame.valid
                depth = thumbnails.depth_image(frame, limits, removed_mask, _FILTER)
                pictures.append(thumbnails.data_uri(depth))
            pictures.append(thumbnails.data_uri(thumbnails.cloud_image(frame, limits, framing)))
            shown.append({"name": name, "text": text, "images": pictures})
            previous = frame
    note = ""
    if steps:
        low, high = thumbnails.depth_limits(steps[0][1])
        note = (
            f"Frame {steps[0][1].index} after each filter; colours from dark (near, "
            f"{words.length(low)}) to bright (far, {words.length(high)})."
        )
        if isinstance(steps[0][1], RangeFrame):
            note += (
                " Grey pixels have no measurement, pink ones were removed by this filter. Below: "
                "the points from above and to the side."
            )
    # Corrections remove nothing.
    names = [*removed, *(n for n in counts if n not in removed and counts[n][0])]
    rows = []
    for name in names:
        num_removed, num_points = counts.get(name, (0, 0))
        fraction = words.percent(num_removed / num_points) if num_points else "–"
        rows.append((name, words.percent(removed.get(name)), fraction))
    return {"filter_rows": rows, "filter_steps": shown, "filter_note": note}


def clouds(s: Subject) -> Values:
    """Return samples of the recording, if its views are clouds."""
    frames = s.extras.clouds
    depth_ranges = [thumbnails.depth_limits(f) for f in frames if len(f)]
    limits = (0.0, 1.0)
    if depth_ranges:
        limits = (min(low for low, _ in depth_ranges), max(high for _, high in depth_ranges))
    samples = []
    for frame in frames:
        framing = thumbnails.Framing.around(frame.points.astype(float), (_THUMBNAIL, 165))
        image = thumbnails.cloud_image(frame, limits, framing)
        samples.append({"index": frame.index, "image": thumbnails.data_uri(image)})
    note = "Sample views before filtering, from above and to the side."
    if depth_ranges:
        note += (
            f" Depth from dark ({words.length(limits[0])}) to bright ({words.length(limits[1])})."
        )
    return {"clouds": samples, "clouds_note": note}


def player(s: Subject) -> Values:
    """Return the images of frames, with the status of each."""
    shown = draw(s.result.diagnostics.samples)
    give_back()
    if not shown:
        return {"player": None, "player_kinds": [], "player_note": "", "fates": []}
    records = {r.index: r for r in s.result.diagnostics.frames}
    kinds = [kind for kind in KINDS if kind in shown[0].images]
    low, high = depth_range(s.result.diagnostics.samples)
    note = f"Range from dark ({words.length(low)}) to bright ({words.length(high)})."
    if len(shown) < len(records):
        note = f"{len(shown):,} of {len(records):,} frames have images here. " + note
    return {
        "player": {
            "index": [p.index for p in shown],
            "descriptions": [
                frame_text(records[p.index], s.result.components) if p.index in records else ""
                for p in shown
            ],
            "status": [records[p.index].status if p.index in records else "" for p in shown],
            "images": {kind: [p.uri(kind) for p in shown] for kind in kinds},
        },
        "player_kinds": [(kind, KINDS[kind]) for kind in kinds],
        "player_note": note,
        "fates": [("#{:02x}{:02x}{:02x}".format(*color), text) for color, text in FATES.values()],
    }
