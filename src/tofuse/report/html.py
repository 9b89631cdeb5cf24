"""`report.html`: the result for a human reader, in one file without external resources."""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofuse._version import __version__
from tofuse.files.atomic import write_text
from tofuse.report.extras import ReportExtras
from tofuse.report.policy import secured
from tofuse.report.sections import sections
from tofuse.results.types import Reconstruction

if TYPE_CHECKING:
    from jinja2 import Template


def write_report(result: Reconstruction, path: Path, extras: ReportExtras) -> None:
    """Write the report to `path`, atomically.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    write_text(path, secured(readable(render(result, extras))))


def render(result: Reconstruction, extras: ReportExtras) -> str:
    """Return the report as HTML."""
    values: dict[str, Any] = sections(result, extras)
    from jinja2.utils import htmlsafe_json_dumps

    scene, player = values.pop("scene"), values.pop("player")
    return template("report.html.j2").render(
        **values,
        version=__version__,
        style=asset("style.css"),
        script=script(),
        first_images={} if player is None else {k: v[0] for k, v in player["images"].items()},
        first_description="" if player is None else player["descriptions"][0],
        last_picture=0 if player is None else len(player["index"]) - 1,
        player_json=None if player is None else htmlsafe_json_dumps(player),
        scene_json=None if scene is None else htmlsafe_json_dumps(scene),
    )


def readable(text: str) -> str:
    """Return text with a mark for each byte of a file's name that is not UTF-8."""
    return re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text)


# Files of the pages' script; each uses functions of the previous ones.
SCRIPTS = (
    "bytes.js",
    "eye.js",
    "gestures.js",
    "painter.js",
    "section.js",
    "measure.js",
    "overlay.js",
    "cameras.js",
    "timeline.js",
    "viewer.js",
    "frames.js",
    "main.js",
)


def script() -> str:
    """Return the script of a page with a 3D view."""
    parts = "\n".join(asset(f"js/{name}") for name in SCRIPTS)
    return f'"use strict";\n(() => {{\n{parts}}})();'


def asset(name: str) -> str:
    """Return the text of a file in `templates`."""
    folder = resources.files("tofuse.report") / "templates"
    return (folder / name).read_text(encoding="utf-8")


@cache
def template(name: str) -> Template:
    """Return the template of that name."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(asset(name))
