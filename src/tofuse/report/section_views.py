"""The recording's views: what filters removed from one, and samples of all."""

from __future__ import annotations

from tofuse.recordings.frames import RangeFrame
from tofuse.report import images, words
from tofuse.report.subject import Subject, Values

_THUMBNAIL, _FILTER = 220, 320  # px


def filters(s: Subject) -> Values:
    """Return one frame after each filter (figure 3.2), and the shares removed."""
    removed, steps = s.result.diagnostics.removed, s.extras.filter_steps
    here: dict[str, tuple[int, int]] = {}  # points removed and seen; a name may come twice
    shown = []
    if steps:
        raw = steps[0][1]
        limits = images.depth_limits(raw)
        framing = images.Framing.around(raw.points.astype(float), (_FILTER, 240))
        last = raw
        for k, (name, frame) in enumerate(steps):
            if k:
                gone = len(last) - len(frame)
                part = words.share(gone / len(last) if len(last) else None)
                text = f"removed {part} ({gone:,} points), {len(frame):,} are left"
                before = here.get(name, (0, 0))
                here[name] = (before[0] + gone, before[1] + len(last))
            else:
                text = words.count(len(frame), "point")
            pictures = []
            if isinstance(frame, RangeFrame):
                lost = None
                if k and isinstance(last, RangeFrame):
                    lost = last.valid & ~frame.valid
                depth = images.depth_image(frame, limits, lost)
                pictures.append(images.data_uri(images.shrink(depth, _FILTER)))
            pictures.append(images.data_uri(images.cloud_image(frame, limits, framing)))
            shown.append({"name": name, "text": text, "images": pictures})
            last = frame
    note = ""
    if steps:
        low, high = images.depth_limits(steps[0][1])
        note = (
            f"Frame {steps[0][1].index} after each filter in turn; colours from dark (near, "
            f"{words.length(low)}) to bright (far, {words.length(high)})."
        )
        if isinstance(steps[0][1], RangeFrame):
            note += (
                " In the images grey has no measurement and pink was removed by this filter; "
                "below, the points seen from above and to the side."
            )
    names = [*removed, *(n for n in here if n not in removed)]
    rows = []
    for name in names:
        gone, seen = here.get(name, (0, 0))
        part = words.share(gone / seen) if seen else "–"
        rows.append((name, words.share(removed.get(name)), part))
    return {"filter_rows": rows, "filter_steps": shown, "filter_note": note}


def thumbnails(s: Subject) -> Values:
    """Return samples of the recording."""
    frames = s.extras.thumbnails
    every = [images.depth_limits(f) for f in frames if len(f)]
    limits = (0.0, 1.0)
    if every:
        limits = (min(low for low, _ in every), max(high for _, high in every))
    out = []
    kinds: list[str] = []
    for frame in frames:
        pictures = []
        if isinstance(frame, RangeFrame):
            depth = images.shrink(images.depth_image(frame, limits, None), _THUMBNAIL)
            pictures.append(("range", images.data_uri(depth, jpeg=True)))
            grey = images.amplitude_image(frame)
            if grey is not None:
                small = images.shrink(grey, _THUMBNAIL)
                pictures.append(("amplitude", images.data_uri(small, jpeg=True)))
            if frame.color_image is not None:
                small = images.shrink(frame.color_image, _THUMBNAIL)
                pictures.append(("colour", images.data_uri(small, jpeg=True)))
        else:
            framing = images.Framing.around(frame.points.astype(float), (_THUMBNAIL, 165))
            drawn = images.cloud_image(frame, limits, framing)
            pictures.append(("points from above and to the side", images.data_uri(drawn)))
        kinds.extend(kind for kind, _ in pictures if kind not in kinds)
        out.append({"index": frame.index, "images": pictures})
    note = f"Sample frames before filtering: {', '.join(kinds)}."
    if every:
        note += (
            f" Depth from dark ({words.length(limits[0])}) to bright ({words.length(limits[1])})."
        )
    return {"thumbnails": out, "thumbnails_note": note}
