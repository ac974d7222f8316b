"""Tuples of arrays that kernels take as pointers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numba import TypingError, njit
from numpy.typing import NDArray

from preprocess.numerics.kernel_arguments import by_reference


@by_reference
class _Pair(NamedTuple):
    table: NDArray[np.float64]
    counter: NDArray[np.int64]


@njit
def _count(pair):
    pair.counter[0] += pair.table.shape[0] * pair.table.shape[1]


@njit
def _scale(pair, factor):
    for row in range(len(pair.table)):
        values = pair.table[row]
        for column in range(len(values)):
            values[column] *= factor
    _count(pair)
    return pair.table[-1, -1]


@njit
def _ask_for_more(pair):
    return pair.nothing


@pytest.mark.parametrize("shape", [(3, 4), (1, 1), (0, 5)])
def test_kernels_read_and_write_the_arrays_themselves(shape: tuple[int, int]) -> None:
    table = np.arange(1.0, 1 + np.prod(shape)).reshape(shape)
    pair = _Pair(table.copy(), np.zeros(1, np.int64))
    if table.size:
        assert _scale(pair, 0.5) == 0.5 * table[-1, -1]
    else:
        _count(pair)
    np.testing.assert_array_equal(pair.table, 0.5 * table)
    assert pair.counter[0] == table.size


def test_each_call_sees_its_own_arrays() -> None:
    pairs = [_Pair(np.full((2, 2), float(n)), np.zeros(1, np.int64)) for n in range(3)]
    assert [_scale(pair, 2.0) for pair in pairs] == [0.0, 2.0, 4.0]
    assert [int(pair.counter[0]) for pair in pairs] == [4, 4, 4]


def test_other_types_of_array_compile_anew() -> None:
    single = _Pair(np.ones((2, 3), np.float32), np.zeros(1, np.int64))  # type: ignore[arg-type]
    strided = _Pair(np.ones((4, 6))[::2, ::2], np.zeros(1, np.int64))
    for pair in (single, strided):
        assert _scale(pair, 3.0) == 3.0
        assert (pair.table == 3.0).all()


def test_what_is_no_array_is_refused() -> None:
    with pytest.raises(TypingError):
        _count(_Pair("text", np.zeros(1, np.int64)))  # type: ignore[arg-type]


def test_an_unknown_field_is_refused() -> None:
    with pytest.raises(TypingError, match="nothing"):
        _ask_for_more(_Pair(np.zeros((1, 1)), np.zeros(1, np.int64)))
