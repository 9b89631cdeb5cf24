"""What must be refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import pytest

from tofuse.engine.errors import InputError, TofuseError
from tofuse.formats.recordings.open import open_recording

Error = TypeVar("Error", bound=TofuseError)


def refused(
    says: str,
    *arguments: Any,
    by: Callable[..., object] = open_recording,
    error: type[Error] = InputError,  # type: ignore[assignment]
    **options: Any,
) -> Error:
    """Call a function, which raises an error of one line that matches `says`; return the error."""
    with pytest.raises(error, match=says) as caught:
        by(*arguments, **options)
    assert len(str(caught.value).splitlines()) == 1
    return caught.value
