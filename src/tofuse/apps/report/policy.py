"""Content security policy of the pages: they run only their inline scripts and load nothing else.

Names in recordings are text. Should a template ever output them as markup, the browser runs no
script whose hash is not in the policy, and sends no requests.
"""

from __future__ import annotations

import base64
import hashlib
import re

# Values of attributes may contain characters that end a tag elsewhere.
_SCRIPT = re.compile(
    r"""<script(?P<attributes>(?:[^"'>]|"[^"]*"|'[^']*')*)>(?P<body>.*?)</script[\s/>]""",
    re.S | re.I,
)
_DATA = re.compile(r"""\btype\s*=\s*["']?application/(?:ld\+)?json""", re.I)
_HEAD = re.compile(r"<meta\s+charset=[^>]*>", re.I)


def script_hashes(html: str) -> list[str]:
    """Return the hashes of a page's inline scripts as in a policy, in order, each once."""
    bodies = [
        match["body"]
        for match in _SCRIPT.finditer(html)
        if not _DATA.search(match["attributes"]) and "src=" not in match["attributes"].lower()
    ]
    # Browsers hash scripts with normalised line ends.
    texts = [body.replace("\r\n", "\n").replace("\r", "\n").encode() for body in bodies]
    digests = [base64.b64encode(hashlib.sha256(text).digest()).decode() for text in texts]
    return list(dict.fromkeys(f"'sha256-{digest}'" for digest in digests))


def secured(html: str) -> str:
    """Return a page with its policy in the head.

    Everything filled into its template must be escaped: any script in the page is allowed.
    """
    scripts = " ".join(script_hashes(html)) or "'none'"
    policy = (
        f"default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; "
        "img-src 'self' data: blob:; font-src data:; base-uri 'none'; form-action 'none'"
    )
    meta = f'\n<meta http-equiv="Content-Security-Policy" content="{policy}">'
    head = _HEAD.search(html)
    return html if head is None else html[: head.end()] + meta + html[head.end() :]
