"""Changes that the documentation site makes to the Markdown pages."""

from __future__ import annotations

import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import reference

ROOT = Path(__file__).resolve().parents[1]
# Documents in the root of the project become pages of the site too.
ROOT_PAGES = ("ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
# Bars of norms: MathML spaces them as relations.
_BAR = ">&#x0007C;</mo>"
_CODE = re.compile(r"(^```.*?^```|`[^`\n]+`)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the documents of the root."""
    for name in ROOT_PAGES:
        text = (ROOT / name).read_text(encoding="utf-8")
        text = re.sub(r"\]\(docs/", "](", text).replace("](README.md", "](index.md")
        text = re.sub(r"\[([^\]]+)\]\((?:LICENSE|NOTICE)\)", r"`\1`", text)  # no pages
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in the tables; point links to the root's documents at their pages; set equations.

    MathML needs no script, so the site shows its equations offline.
    """
    pieces = _CODE.split(reference.filled(markdown))  # code at the odd places is left alone
    return "".join(piece if k % 2 else _text(piece) for k, piece in enumerate(pieces))


def _text(text: str) -> str:
    text = text.replace("](../README.md", "](index.md").replace("](../", "](")
    text = re.sub(r"\$\$(.+?)\$\$", lambda m: _mathml(m[1].strip(), "block"), text, flags=re.DOTALL)
    return re.sub(r"\$([^$\s](?:[^$\n]*[^$\s])?)\$", _inline, text)


def _inline(found: re.Match[str]) -> str:
    # In a span, as Markdown takes an element that it does not know for a block.
    return f"<span>{_mathml(found[1], 'inline')}</span>"


def _mathml(tex: str, display: str) -> str:
    return convert(tex, display=display).replace(_BAR, f' lspace="0" rspace="0"{_BAR}')
