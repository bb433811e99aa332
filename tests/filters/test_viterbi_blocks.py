"""Memory that is used again: never while anything refers to it."""

from __future__ import annotations

import gc
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from terranav.filters import _blocks

SHAPE = (123, 457)


def address(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_memory_is_used_again_once_nothing_refers_to_it() -> None:
    one = _blocks.empty(SHAPE)
    one[:] = 7.0
    view, where = one[3:, ::2], address(one)
    del one
    gc.collect()
    other = _blocks.empty(SHAPE)
    assert address(other) != where  # the view still needs it
    other[:] = 1.0
    assert (view == 7.0).all()
    del view
    gc.collect()
    third = _blocks.empty(SHAPE)
    assert address(third) == where
    assert third.shape == SHAPE
    assert third.dtype == np.dtype(np.float64)
    assert third.flags.writeable


def test_another_shape_or_type_gets_memory_of_its_own() -> None:
    del_me = _blocks.empty(SHAPE)
    del del_me
    other = _blocks.empty((457, 123)), _blocks.empty(SHAPE, np.uint8), _blocks.empty((0, *SHAPE), np.uint8)
    assert [(one.shape, one.dtype.itemsize) for one in other] == [((457, 123), 8), (SHAPE, 1), ((0, *SHAPE), 1)]


def test_arrays_pickle_and_the_pool_is_bounded() -> None:
    many = [_blocks.empty(SHAPE) for _ in range(2 * _blocks.KEPT)]
    many[0][:] = 3.0
    assert (pickle.loads(pickle.dumps(many[0])) == 3.0).all()
    del many
    gc.collect()
    assert len(_blocks._waiting) == _blocks.KEPT


def test_small_and_large_arrays_are_not_kept() -> None:
    for shape in ((10, 10), (1000, 1000)):
        before = list(_blocks._waiting)
        del_me = _blocks.empty(shape)
        assert del_me.flags.owndata
        del del_me
        assert all(old is new for old, new in zip(before, _blocks._waiting, strict=True))


def test_threads_do_not_share_memory() -> None:
    def work(mark: int) -> bool:
        whole = True
        for _ in range(200):
            mine = _blocks.empty(SHAPE)
            mine[:] = mark
            whole &= bool((mine == mark).all())
        return whole

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(4)))
