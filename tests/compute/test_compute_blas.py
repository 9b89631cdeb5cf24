"""BLAS is limited to one thread inside the block, and restored after it."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

import tofuse
from tofuse.engine.compute.thread_pool import one_blas_thread


def counts() -> set[int]:
    found = ThreadpoolController().select(user_api="blas").info()
    return {library["num_threads"] for library in found}


def test_thread_count_is_one_inside_and_restored_after() -> None:
    with threadpool_limits(2):
        before = counts()
        with one_blas_thread():
            assert counts() == {1}
            with one_blas_thread():
                assert counts() == {1}
            assert counts() == {1}
        assert counts() == before


def test_thread_count_is_restored_after_error() -> None:
    with threadpool_limits(2):
        before = counts()
        with pytest.raises(tofuse.RegistrationError):
            tofuse.register(np.ones((20, 3)), np.ones((20, 3)))
        assert counts() == before


def test_limit_lasts_until_last_overlapping_block_ends() -> None:
    with threadpool_limits(2):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert counts() == {1}
        second.__exit__(None, None, None)
        assert counts() == {2}
