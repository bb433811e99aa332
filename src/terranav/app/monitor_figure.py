"""The picture of a GNSS that was watched: how far it was from the map-aided position, the limit, and what was said."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from terranav.app.monitoring import Monitored
from terranav.app.style import INS, MAIN, OTHERS, TRUTH, new_figure, styled, time_axis
from terranav.app.words import distance
from terranav.integrity.gnss import GnssStatus

FloatArray = NDArray[np.float64]

COLOURS = {
    GnssStatus.CONSISTENT: "#45a583",
    GnssStatus.SUSPECT: "#f3c14b",
    GnssStatus.SPOOFED: "#cc4433",
    GnssStatus.JAMMED: "#2f343a",
    GnssStatus.UNKNOWN: "#ccd4db",
}
MOST = 4.0  # a limit so many times larger than the difference and `limit_m` is off the picture


def monitor_picture(found: Monitored) -> Figure:
    """Difference and limit over time, above a ribbon of the status."""
    watch = found.watch
    time, label = time_axis(watch.time_s, found.start_s)
    with styled():
        figure = new_figure(5.2)
        panels = figure.subplot_mosaic([["off"], ["said"]], height_ratios=[5.0, 0.7], sharex=True)
        axes, ribbon = panels["off"], panels["said"]
        limit = np.where(np.isfinite(watch.threshold_m), watch.threshold_m, np.nan)
        axes.plot(time, limit, color=INS, lw=1.4, label="limit: an alarm from here on")
        axes.plot(time, watch.difference_m, color=MAIN, lw=1.2, label="GNSS from the map-aided position")
        if found.pull_mps:
            off = found.pull_mps * np.maximum(watch.time_s - found.pull_from_s, 0.0)
            axes.plot(time, off, color=TRUTH, lw=1.0, ls="--", label=f"GNSS pulled away at {found.pull_mps:g} m/s")
            flagged = found.flagged
            if flagged is not None:
                at = float(np.interp(flagged.from_s, watch.time_s, time))
                off_m = found.pull_mps * (flagged.from_s - found.pull_from_s)
                axes.axvline(at, color=OTHERS[0], lw=1.2)
                axes.annotate(f"flagged: {distance(off_m)} off ", (at, off_m), color=OTHERS[0], va="bottom", ha="right")
        shown = watch.difference_m[np.isfinite(watch.difference_m)]
        high = max(float(shown.max()) if shown.size else 0.0, found.monitor.limit_m)
        axes.set(xlim=(time[0], time[-1]), ylim=(0.0, min(1.05 * high, MOST * found.monitor.limit_m)), ylabel="metres")
        axes.legend(loc="upper left")
        _ribbon(ribbon, found, time)
        ribbon.set_xlabel(label)
    return figure


def _ribbon(axes: Axes, found: Monitored, time: FloatArray) -> None:
    """One coloured bar: what was said of GNSS."""
    said = found.watch.status
    edges = np.append(time, time[-1] + (np.median(np.diff(time)) if time.size > 1 else 1.0))
    first = np.flatnonzero(np.append(True, said[1:] != said[:-1]))
    last = np.append(first[1:], said.size)
    for i, j in zip(first.tolist(), last.tolist(), strict=True):
        axes.barh(0, edges[j] - edges[i], 0.7, edges[i], linewidth=0, color=COLOURS[GnssStatus(str(said[i]))])
    used = [status for status in GnssStatus if status.value in said]
    handles = [axes.barh(0, 0, 0, label=status.value, linewidth=0, color=COLOURS[status]) for status in used]
    axes.set_yticks([0], ["GNSS"])
    axes.grid(visible=False)
    axes.legend(handles=handles, loc="lower left", bbox_to_anchor=(0, 1), ncols=5, borderpad=0, fontsize=9)
