"""Recordings that can't be opened."""

from __future__ import annotations

from typing import Any

import pytest

from tofuse.engine.errors import InputError
from tofuse.formats.recordings.open import open_recording


def refused(says: str, *paths: Any, **options: Any) -> InputError:
    """Open recordings, which is refused in one line that matches `says`; return the error."""
    with pytest.raises(InputError, match=says) as caught:
        open_recording(*paths, **options)
    assert len(str(caught.value).splitlines()) == 1
    return caught.value
