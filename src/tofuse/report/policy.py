"""What a page of ours may do in a browser: run its own scripts, show what it holds, and no more.

Whatever a recording's names hold is text. Should a template ever let some of it through as markup,
the browser still runs no script of which it was not told the hash, and asks for nothing outside.
"""

from __future__ import annotations

import base64
import hashlib
import re

# Values of attributes may hold what ends a tag elsewhere.
_SCRIPT = re.compile(
    r"""<script(?P<attributes>(?:[^"'>]|"[^"]*"|'[^']*')*)>(?P<body>.*?)</script[\s/>]""",
    re.S | re.I,
)
_DATA = re.compile(r"""\btype\s*=\s*["']?application/(?:ld\+)?json""", re.I)
_HEAD = re.compile(r"<meta\s+charset=[^>]*>", re.I)


def script_hashes(html: str) -> list[str]:
    """Return what a policy calls the inline scripts of a page, in order, each once."""
    bodies = [
        found["body"]
        for found in _SCRIPT.finditer(html)
        if not _DATA.search(found["attributes"]) and "src=" not in found["attributes"].lower()
    ]
    # A browser hashes what it reads, in which there is no carriage return.
    texts = [body.replace("\r\n", "\n").replace("\r", "\n").encode() for body in bodies]
    sums = [base64.b64encode(hashlib.sha256(text).digest()).decode() for text in texts]
    return list(dict.fromkeys(f"'sha256-{each}'" for each in sums))


def secured(html: str) -> str:
    """Return a page of ours, made by a template, with its policy in the head.

    To be given templates with nothing filled in that is not escaped: a script that is in it counts
    as ours.
    """
    scripts = " ".join(script_hashes(html)) or "'none'"
    policy = (
        f"default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; "
        "img-src 'self' data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
    )
    meta = f'\n<meta http-equiv="Content-Security-Policy" content="{policy}">'
    head = _HEAD.search(html)
    return html if head is None else html[: head.end()] + meta + html[head.end() :]
