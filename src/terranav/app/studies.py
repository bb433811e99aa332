"""Papers' studies side by side: each in a process of its own, because much of a study is Python and holds the GIL."""

from __future__ import annotations

import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from typing import Any

from terranav.app.console import complain, one_line
from terranav.app.reproduction import Attempt
from terranav.core.errors import ConfigError, DataError, DataWarning, TerranavError
from terranav.experiment.papers.outcome import Setup
from terranav.experiment.papers.registry import reproduce, title

OnRun = Callable[[str, int, int], None]  # paper, runs done, runs of the study at hand
Work = Callable[[str, Setup], Attempt]


def attempts(
    numbers: Sequence[str], setup: Setup, processes: int = 1, on_run: OnRun | None = None
) -> Iterator[Attempt]:
    """Reproduce papers, and give what came of each as soon as it is done.

    Parameters
    ----------
    numbers : sequence of str
        Papers, in the order in which they are begun.
    setup : Setup
        Without `on_run`.
    processes : int, >= 1
        How many papers at the same time. With 1 they run here, one after the other.
    on_run : callable, optional
        Called with (paper, runs done, runs) after each run.
    """
    if min(processes, len(numbers)) > 1:
        yield from side_by_side(tried, numbers, setup, processes, on_run)
        return
    for number in numbers:
        yield tried(number, _reporting(setup, number, on_run))


def tried(number: str, setup: Setup) -> Attempt:
    """Run one paper's study; an exception becomes its outcome."""
    name = ""
    start_s = time.perf_counter()
    try:
        name = title(number)
        found = reproduce(number, setup)
        return Attempt(number, found.title, time.perf_counter() - start_s, found)
    except Exception as error:  # noqa: BLE001  one paper's failure must not cost the others
        return Attempt(
            number,
            name,
            time.perf_counter() - start_s,
            error=one_line(error if isinstance(error, TerranavError) else f"{type(error).__name__}: {error}"),
            traceback=traceback.format_exc(),
            refused=isinstance(error, (ConfigError, DataError)),
        )


def side_by_side(
    work: Work, numbers: Sequence[str], setup: Setup, processes: int, on_run: OnRun | None = None
) -> Iterator[Attempt]:
    """`work(number, setup)` for each number in a new process, so many at a time, in the order in which they end.

    A process that is killed costs its own paper only. Whoever stops reading ends those that still run.
    """
    context = get_context("spawn")
    waiting = list(numbers)
    running: dict[Connection, tuple[str, Any, float]] = {}
    warned: set[str] = set()
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                number = waiting.pop(0)
                here, there = context.Pipe(duplex=False)
                process = context.Process(target=_child, args=(work, number, setup, there), daemon=True)
                process.start()
                there.close()
                running[here] = number, process, time.perf_counter()
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                number, process, start_s = running[ready]
                message = _received(ready)
                if isinstance(message, tuple):
                    if on_run is not None:
                        on_run(number, *message)
                elif isinstance(message, str):
                    if message not in warned:
                        warned.add(message)
                        complain(message, "warning")
                else:
                    process.join()
                    del running[ready]
                    ready.close()
                    died = f"its process ended with status {process.exitcode} before it was done"
                    yield message or Attempt(number, "", time.perf_counter() - start_s, error=died)
    finally:
        for _, process, _ in running.values():
            process.terminate()


def _received(source: Connection) -> Any:
    """The next message of a process; None when it ended without one."""
    try:
        return source.recv()
    except EOFError:
        return None


def _child(work: Work, number: str, setup: Setup, there: Connection) -> None:
    """A process: sends (done, all) after each run, texts of warnings, and at last the Attempt."""
    lock = threading.Lock()

    def send(message: Any) -> None:
        with lock:
            there.send(message)

    def warned(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if issubclass(category, DataWarning):
            send(str(message))

    warnings.showwarning = warned
    warnings.simplefilter("always", DataWarning)
    try:
        send(work(number, _reporting(setup, number, lambda _, done, of: send((done, of)))))
    except (KeyboardInterrupt, BrokenPipeError):
        return  # stopped, or nobody is left to tell


def _reporting(setup: Setup, number: str, on_run: OnRun | None) -> Setup:
    """The setup with the callback of one paper."""
    if on_run is None:
        return setup
    return replace(setup, on_run=lambda done, of: on_run(number, done, of))


@dataclass(frozen=True)
class Bars:
    """Progress: what is called after each run, and a context in which the bars make room for other output."""

    on_run: OnRun | None = None
    aside: Callable[[], AbstractContextManager[Any]] = nullcontext


@contextmanager
def progress() -> Iterator[Bars]:
    """One bar with the time left for each paper that is running, on stderr; nothing when stderr is no terminal.

    A paper may make several studies of runs one after the other: its bar starts again for each.
    """
    if not sys.stderr.isatty():
        yield Bars()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
    from rich.progress import TimeElapsedColumn as Spent
    from rich.progress import TimeRemainingColumn as Left

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("runs, left:"), Left())
    bars = Progress(
        *columns,
        TextColumn("spent:"),
        Spent(),
        console=Console(file=sys.stderr),
        transient=True,
        redirect_stdout=False,  # what is shown there may go to a file
        speed_estimate_period=120.0,
    )
    at: dict[str, tuple[TaskID, int, int]] = {}

    def on_run(paper: str, done: int, of: int) -> None:
        bar, before, study = at.get(paper, (None, 0, 1))
        if bar is not None and done <= before:
            bars.remove_task(bar)
            bar, study = None, study + 1
        if bar is None:
            bar = bars.add_task(f"paper {paper}" + (f", study {study}" if study > 1 else ""), total=of)
        bars.update(bar, completed=done, visible=done < of)
        at[paper] = bar, done, study

    @contextmanager
    def aside() -> Iterator[None]:
        bars.stop()
        yield
        bars.start()

    with bars:
        yield Bars(on_run, aside)
