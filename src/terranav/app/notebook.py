"""How a Map, a Recording and a Result show themselves in a notebook.

`import terranav` inside IPython registers `html_of` by the names of the types, so that neither matplotlib nor this
module is imported before something is shown.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from html import escape
from typing import TYPE_CHECKING, Any

from terranav.app.listing import map_pairs, recording_pairs
from terranav.app.words import distance, duration, percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from terranav.core.recording import Recording
    from terranav.experiment.result import Result
    from terranav.maps.map import Map


def html_of(shown: Map | Recording | Result) -> str:
    """An object of terranav as HTML that brings everything with it."""
    by_name: dict[str, Callable[[Any], str]] = {"Map": map_html, "Recording": recording_html, "Result": result_html}
    return by_name[type(shown).__name__](shown)


def map_html(chart: Map) -> str:
    """The map as a shaded relief beside what it is."""
    from terranav.app.style import new_figure, styled
    from terranav.app.trackmap import dress, shade

    frame = chart.bounds_deg
    with styled():
        figure = new_figure(4.2, 5.2)
        axes = figure.subplots()
        shade(axes, chart, frame)
        axes.set(xlim=(frame[1], frame[3]), ylim=(frame[0], frame[2]))
        dress(axes, frame)
    return _beside(figure, map_pairs(chart.info()))


def recording_html(rec: Recording) -> str:
    """The track and the readings beside what is in the recording."""
    from terranav.app.style import INS, MAIN, TRUTH, new_figure, styled, time_axis

    with styled():
        figure = new_figure(1.9 * (1 + len(rec.readings)), 5.2)
        panels = figure.subplots(1 + len(rec.readings), 1, squeeze=False)[:, 0]
        if rec.has_truth:
            panels[0].plot(rec.columns["true_lon_deg"], rec.columns["true_lat_deg"], color=TRUTH, label="true")
        panels[0].plot(rec.lon_deg, rec.lat_deg, "--", color=INS, label="indicated")
        panels[0].set(xlabel="longitude [deg]", ylabel="latitude [deg]")
        panels[0].legend(fontsize=8)
        time, label = time_axis(rec.time_s, float(rec.time_s[0]))
        for axes, key in zip(panels[1:], rec.readings, strict=True):
            axes.plot(time, rec.columns[key], ".", color=MAIN, markersize=2.5)
            axes.set_ylabel(key)
        panels[-1].set_xlabel(label if rec.readings else "longitude [deg]")
    return _beside(figure, recording_pairs(rec))


def result_html(result: Result) -> str:
    """Error and claim against time beside the figures of the run."""
    import numpy as np

    from terranav.app.style import INS, MAIN, new_figure, status_ribbon, styled, time_axis

    with styled():
        figure = new_figure(3.4, 5.8)
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[4, 0.6])
        time, label = time_axis(result.time_s, float(result.time_s[0]))
        claim = 2.0 * np.sqrt(np.trace(result.cov_m2, axis1=1, axis2=2))
        top.fill_between(time, 1e-3, claim, color=MAIN, alpha=0.14, linewidth=0, label="claimed 2σ")
        lowest = np.percentile(claim, 2)
        if result.has_truth:
            error = np.hypot(*result.error_m.T)
            top.plot(time, np.hypot(*result.indicated_error_m.T), "--", color=INS, label="INS alone")
            top.plot(time, error, color=MAIN, label=result.estimator)
            lowest = min(lowest, np.nanpercentile(error, 5))
        top.set(yscale="log", ylabel="error [m]")
        top.set_ylim(bottom=0.7 * max(float(lowest), 0.5))
        top.legend(loc="upper left", ncols=3, fontsize=8)
        status_ribbon(bottom, time, [("", result.status)])
        bottom.set_xlabel(label)
    return _beside(figure, _result_pairs(result))


def _result_pairs(result: Result) -> list[tuple[str, str]]:
    """The figures of a run in words."""
    metrics = result.metrics()
    pairs = [
        ("result", f"{result.estimator} over {result.name}: {len(result)} epochs"),
        ("first fix", duration(metrics["first_fix_s"])),
        ("at the end", str(result.status[-1]).replace("_", " ")),
    ]
    if not result.has_truth:
        return pairs
    fixed = result.metrics(after_first_fix=True)
    return [
        *pairs,
        ("DRMS", f"{distance(metrics['drms_m'])}, from the first fix on {distance(fixed['drms_m'])}"),
        ("R95", f"{distance(metrics['r95_m'])}, from the first fix on {distance(fixed['r95_m'])}"),
        ("in 95 %", percent(metrics["contained_95"])),
        ("lost", duration(metrics["lost_s"])),
    ]


def _beside(figure: Figure, pairs: Iterable[tuple[str, str]]) -> str:
    """A picture beside a table of names and texts, as HTML that brings everything with it."""
    from terranav.app.style import png

    data = base64.b64encode(png(figure, dpi=80)).decode()
    rows = "".join(
        f'<tr><td style="text-align:left;opacity:.65;white-space:nowrap">{escape(name)}</td>'
        f'<td style="text-align:left">{escape(text)}</td></tr>'
        for name, text in pairs
    )
    return (
        '<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start">'
        f'<img style="max-width:100%" alt="" src="data:image/png;base64,{data}">'
        f'<table style="max-width:34em">{rows}</table></div>'
    )
