"""One look for every picture: colours that the colour-blind can tell apart, and figures without global state."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from terranav.core.records import Status

if TYPE_CHECKING:
    from terranav.app.outcome import Outcome

FloatArray = NDArray[np.float64]

TRUTH, INS, MAIN = "#111111", "#d1495b", "#00639c"
OTHERS = ("#b8860b", "#7b4ea3", "#1b8a5a", "#8c564b", "#5f6b76")
BOUND = "#30363c"
BOUND_DASHES = (0, (5, 1.5, 1, 1.5))
STATUS_COLOUR = {  # apart by 27 CIELAB units or more for normal, red-, green- and blue-blind eyes
    Status.SEARCHING.value: "#ccd4db",
    Status.CONVERGED.value: "#45a583",
    Status.DEGRADED.value: "#f3c14b",
    Status.LOST.value: "#cc4433",
    Status.OFF_MAP.value: "#2f343a",
}
USABLE, WITHHELD = "fix usable", "fix withheld"
_RIBBON: dict[str, dict[str, Any]] = {
    **{name: {"color": colour} for name, colour in STATUS_COLOUR.items()},
    USABLE: {"color": MAIN},
    WITHHELD: {"color": "#ffffff", "hatch": "////", "edgecolor": "#9aa3ab"},
}
WIDTH_IN = 10.0

_RC = {
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8a9199",
    "axes.labelcolor": "#333a41",
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "#e3e7ea",
    "grid.linewidth": 0.8,
    "xtick.color": "#555c63",
    "ytick.color": "#555c63",
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
}


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """An empty figure that belongs to no window system."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@contextmanager
def styled() -> Iterator[None]:
    """The look, for a `with` block around the making of a figure."""
    with rc_context(cast("Any", _RC)):
        yield


def png(figure: Figure, dpi: float = 130) -> bytes:
    """A figure as the bytes of a PNG file, the same bytes for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def colours(outcome: Outcome) -> dict[str, str]:
    """One colour for each estimator: the INS and the one the report is about have their own."""
    from terranav.app.outcome import BASELINE

    own = {BASELINE: INS, outcome.main: MAIN if outcome.main != BASELINE else INS}
    rest = [name for name in outcome.results if name not in own]
    return own | {name: OTHERS[i % len(OTHERS)] for i, name in enumerate(rest)}


def time_axis(time_s: FloatArray, start_s: float) -> tuple[FloatArray, str]:
    """Times from the start in a unit that keeps the numbers small, and the axis label."""
    span = float(time_s[-1] - start_s)
    if span > 4 * 3600:
        return (time_s - start_s) / 3600.0, "hours since the start"
    if span > 300:
        return (time_s - start_s) / 60.0, "minutes since the start"
    return time_s - start_s, "seconds since the start"


def nice_length(wanted: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most `wanted`."""
    power = 10.0 ** math.floor(math.log10(wanted))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= wanted * (1 + 1e-9))


def status_ribbon(axes: Axes, time: FloatArray, rows: Sequence[tuple[str, NDArray[np.str_]]]) -> None:
    """Draw one coloured bar per row: what an estimator said its position was worth, or whether a fix was offered."""
    edges = np.append(time, time[-1] + (np.median(np.diff(time)) if time.size > 1 else 1.0))
    used: set[str] = set()
    for row, (_, status) in enumerate(rows):
        first = np.flatnonzero(np.append(True, status[1:] != status[:-1]))
        last = np.append(first[1:], status.size)
        for i, j in zip(first, last, strict=True):
            used.add(str(status[i]))
            axes.barh(row, edges[j] - edges[i], 0.72, edges[i], linewidth=0, **_RIBBON[str(status[i])])
    axes.set_yticks(range(len(rows)), [name for name, _ in rows])
    axes.invert_yaxis()
    axes.grid(visible=False)
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    axes.tick_params(length=0)
    handles = [
        axes.barh(0, 0, 0, label=name.replace("_", " "), linewidth=0, **look)
        for name, look in _RIBBON.items()
        if name in used
    ]
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0, 1), ncols=7, borderpad=0, handlelength=1.2, fontsize=9
    )
