"""The scenes: one module for each group, whose function `plan` builds it."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.lab.scenes import box, rail, room, torso
    from tofuse.lab.scenes.torso import HAIR, SHIRT, SKIN, TROUSERS

__getattr__, __dir__, __all__ = face(__name__, __file__)
