"""`tofuse card` with files: read the results, write the card."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tofuse.apps.card.making import Card, make_card
from tofuse.apps.card.page import write_page
from tofuse.apps.results import folders
from tofuse.formats.files import atomic

CARD, PAGE = "card.json", "card.html"


@dataclass(frozen=True)
class CardOptions:
    """The options of ``tofuse card``; see its ``--help``."""

    out: Path | None = None
    overwrite: bool = False


def card_files(results: Sequence[Path], options: CardOptions) -> Card:
    """Make a card, and write it if there is a folder for it; see `make_card` for errors.

    Raises
    ------
    OutputError
        If it can't be written; existing files are then unchanged.
    """
    if options.out is None:
        return make_card(results)
    with folders.OutputFolder(
        options.out, overwrite=options.overwrite, contract=_CONTRACT
    ) as folder:
        card = make_card(results)
        with folder.staging() as staging:
            text = json.dumps(card.to_dict(), indent=1, allow_nan=False)
            atomic.write_text(staging / CARD, text + "\n")
            write_page(card, staging / PAGE)
    return card


def _is_ours(folder: Path) -> bool:
    data = folders.read_json_object(folder / CARD)
    return data is not None and {"schema", "version", "camera", "quantities"} <= set(data)


_CONTRACT = folders.Contract(re.compile(r"card\.(json|html)"), CARD, _is_ours)
