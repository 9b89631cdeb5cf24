"""The pages for a human reader, each a single file without external resources."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from tofuse._version import __version__
from tofuse.apps.report import words
from tofuse.engine import quantities
from tofuse.engine.frames import frame_ranges
from tofuse.formats.files import atomic

# Files of the pages' script; each uses functions of the previous ones.
SCRIPTS = (
    "bytes", "eye", "gestures", "painter", "section", "measure",
    "overlay", "cameras", "timeline", "viewer", "frames", "main",
)  # fmt: skip


def write_page(path: Path, template: str, **values: Any) -> None:
    """Write a page: a template of `templates` with values, which it escapes.

    Raises
    ------
    OutputError
        If the file can't be written; an earlier one is unchanged then.
    """
    atomic.write_text(path, secured(page(template, **values)))


def page(template: str, **values: Any) -> str:
    """Return a page as HTML, with a mark for each byte of a file's name that is not UTF-8."""
    made = _environment().get_template(template)
    text = made.render(version=__version__, style=asset("style.css"), **values)
    return re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text)


def secured(html: str) -> str:
    """Return a page with its content security policy in the head.

    The page runs only its inline scripts, and loads nothing else. Everything filled into its
    template must be escaped: any script in the page is allowed.
    """
    scripts = re.findall("<script>(.*?)</script>", html, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in hashes) or "'none'"
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src 'self' data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
    )
    meta = f'\n<meta http-equiv="Content-Security-Policy" content="{policy}">'
    return re.sub("<meta charset=[^>]*>", lambda head: head[0] + meta, html, count=1)


def script(*, charts: bool = False) -> str:
    """Return the script of a page with a 3D view, and with charts if it has any."""
    files = [f"js/{name}.js" for name in SCRIPTS]
    licence = ""
    if charts:
        files = ["vendor/uPlot.iife.min.js", *files, "js/charts.js"]
        licence = f"/*!\n{asset('vendor/uPlot.LICENSE')}*/\n"
    parts = "\n".join(map(asset, files))
    return f'{licence}"use strict";\n(() => {{\n{parts}}})();'


def asset(name: str) -> str:
    """Return the text of a file in `templates`."""
    folder = resources.files("tofuse.apps.report") / "templates"
    return (folder / name).read_text(encoding="utf-8")


@cache
def _environment() -> Any:
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    loader = FunctionLoader(asset)
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=loader,
    )
    environment.filters |= {
        "metres": quantities.length,
        "signed": words.signed_length,
        "degrees": math.degrees,
        "percent": quantities.percent,
        "duration": words.seconds,
        "sentence": words.sentence,
        "things": quantities.count,
        "more": words.more,
        "coordinates": words.coordinates,
        "frames": lambda ends: words.frame_range(*ends),
        "probability": quantities.probability,
        "ranges": lambda ranges: frame_ranges.numbers(ranges).replace("-", "–"),
        "number": "{:,}".format,
        "css": lambda color: f"rgb{tuple(color)}",
        "pretty": lambda data: json.dumps(data, indent=2, ensure_ascii=False, default=str),
    }
    environment.policies["json.dumps_kwargs"] = {}  # keys in their order
    return environment
