"""Reproduction of chapters 4 and 5 of the thesis, and measures of errors."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.lab.experiments.page import run_experiments

__getattr__, __dir__, __all__ = face(__name__, __file__)
