"""Processes of this machine as an Executor: for runs whose Python code holds the GIL."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from typing import TypeVar

from terranav.core.errors import StateError

T = TypeVar("T")

#: one thread each: every core has a process of its own, and sums that threads share out may differ in the last bit
_ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Processes:
    """New processes, one thread of arithmetic each; they end with this one, however it ends.

    Attributes
    ----------
    workers : int or None
        How many; None is one a core. With 1, too, the work is done in a process of its own, so that it meets the same
        conditions.
    """

    workers: int | None = None

    def unordered(self, work: Callable[[int], T], items: Iterable[int]) -> Iterator[tuple[int, T]]:
        """(item, work(item)) in the order in which they finish; `work` and what it returns must be picklable.

        Raises
        ------
        StateError
            A process ended before its work was done (killed, or out of memory).
        """
        todo = list(items)
        count = min(os.cpu_count() or 1 if self.workers is None else max(self.workers, 1), len(todo))
        if not todo:
            return
        context = multiprocessing.get_context("spawn")  # forked threads and locks of a parent would be half there
        stop = context.Event()
        with _environment():
            pool = ProcessPoolExecutor(count, mp_context=context, initializer=_begin, initargs=(stop,))
            try:
                futures = {pool.submit(work, item): item for item in todo}
                for future in as_completed(futures):
                    yield futures[future], future.result()
            except BrokenProcessPool:
                raise StateError(
                    "a worker process ended before it was done (killed, or out of memory); the same command goes on "
                    "with what is left"
                ) from None
            except BaseException:
                stop.set()  # Ctrl-C, or nobody reads on: what is under way is not waited for
                raise
            finally:
                pool.shutdown(cancel_futures=True)


@contextmanager
def _environment() -> Iterator[None]:
    """The variables that new processes inherit."""
    before = {key: os.environ.get(key) for key in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def _begin(stop: Event) -> None:
    """Begin a worker: threads wait for the parent's end, even by kill -9, and for `stop`, and end this process at once.

    A Ctrl-C, which a terminal sends to all processes, is the parent's business.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None
    for ended in (parent.join, stop.wait):
        threading.Thread(target=_watch, args=(ended,), daemon=True).start()


def _watch(ended: Callable[[], object]) -> None:
    ended()
    os._exit(1)
