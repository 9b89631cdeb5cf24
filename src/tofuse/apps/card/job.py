"""`tofuse card` with files: read the results, write the card."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tofuse.apps.card.making import Card, make_card
from tofuse.apps.card.page import write_page
from tofuse.apps.results import folders, run_json

CARD, PAGE = "card.json", "card.html"
_CONTRACT = folders.Contract.of_files(CARD, PAGE, keys=("camera", "quantities"))


def card_files(results: Sequence[Path], options: folders.OutputOptions) -> Card:
    """Make a card, and write it if there is a folder for it; see `make_card` for errors.

    Raises
    ------
    OutputError
        If it can't be written; existing files are then unchanged.
    """
    with options.folder(_CONTRACT) as folder:
        card = make_card(results)
        if folder is not None:
            with folder.staging() as staging:
                run_json.write_object(staging / CARD, card.to_dict())
                write_page(card, staging / PAGE)
    return card
