"""terranav cue: will the ground come too near, and which way is clear?"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    from terranav.app.ahead import Span
    from terranav.core.recording import Recording
    from terranav.maps.map import Map
    from terranav.planning.cue import Cue, CueSettings


@options.reads_maps
def cue(
    *,
    recording: options.Recording,
    maps: options.Maps = None,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="See `terranav estimators`.")] = "marginalized",
    margin: Annotated[float, typer.Option(metavar="M", help="Least clearance above ground, in m.")] = 150.0,
    lookahead: Annotated[float, typer.Option(metavar="S", help="How far to look ahead, in s.")] = 120.0,
    threshold: Annotated[float, typer.Option(metavar="P", help="Probability that is a warning.")] = 0.01,
    altitude_sigma: Annotated[float, typer.Option(metavar="M", help="1-sigma of the altitude, in m.")] = 5.0,
    bank: Annotated[float, typer.Option(metavar="DEG", help="Bank of an evasive turn.")] = 30.0,
    at: Annotated[
        float | None, typer.Option(metavar="S", help="Cue at this time of the recording; else at its last epoch.")
    ] = None,
    seed: options.Seed = 0,
    as_json: options.Json = False,
    ins: options.Ins = "",
    drift: options.Drift = "",
    drift_seed: options.DriftSeed = 0,
    first: options.First = None,
    geoid: options.Geoids = None,
    map_options: options.MapOptions,
) -> int:
    """Terrain avoidance cueing: run an estimator, look ahead from where it is, and list the warnings of the flight."""
    from terranav.app.ahead import Flight
    from terranav.app.console import OK, show_json, working
    from terranav.app.given import Given
    from terranav.app.mapping import geoids_from
    from terranav.experiment.run import run
    from terranav.planning.cue import CueSettings

    grids = geoids_from(geoid or ())
    settings = CueSettings(margin, lookahead, threshold, altitude_sigma, bank_deg=bank)
    rec, charts, told = Given(recording, maps or (), map_options, ins, drift, drift_seed, first).read()
    ground, row = _ground(charts), _row_at(rec, at)
    with working("flying"):
        result = run(estimator, rec, charts, seed=seed, ins=told, geoid=grids)
        flight = Flight(rec, result, ground, settings)
        now, spans = flight.cue(row), flight.timeline()
    time_s = float(rec.time_s[row])
    if as_json:
        show_json(_as_json(time_s, now, spans, settings))
    else:
        _show(rec.name, time_s, now, spans, settings)
    return OK


def _ground(charts: tuple[Map, ...]) -> Map:
    """The map to keep clear of."""
    from terranav.core.errors import DataError

    found = next((chart for chart in charts if chart.kind in ("terrain", "bathymetry")), None)
    if found is None:
        kinds = ", ".join(chart.kind for chart in charts) or "none at all"
        raise DataError(f"--map: maps are of kind {kinds}, expected one of terrain or bathymetry to keep clear of")
    return found


def _row_at(rec: Recording, at_s: float | None) -> int:
    """The epoch at a time of the recording, or the last one before it."""
    import numpy as np

    from terranav.core.checks import finite

    if at_s is None:
        return len(rec) - 1
    finite("--at", at_s, minimum=float(rec.time_s[0]), maximum=float(rec.time_s[-1]))
    return int(np.searchsorted(rec.time_s, at_s, side="right")) - 1


def _as_json(time_s: float, now: Cue, spans: list[Span], settings: CueSettings) -> dict[str, Any]:
    """Everything, for machines."""
    from dataclasses import asdict

    return {
        "settings": asdict(settings),
        "cue": {"time_s": time_s, **asdict(now), "peak": now.peak},
        "timeline": [asdict(span) for span in spans],
    }


def _show(name: str, time_s: float, now: Cue, spans: list[Span], settings: CueSettings) -> None:
    """The cue and the timeline, for people."""
    from rich import box
    from rich.table import Table

    from terranav.app.console import show, show_pairs
    from terranav.app.words import NOTHING, duration, number

    left, right = (_turn(value, side) for value, side in ((now.left_deg, "left"), (now.right_deg, "right")))
    climb = "no rate known to be clear" if math.isnan(now.climb_mps) else f"{now.climb_mps:.1f} m/s"
    ahead = f"{settings.lookahead_s:g} s ahead, margin {settings.margin_m:g} m, probability {settings.threshold:g}"
    show_pairs(
        [
            ("recording", name),
            ("cue", f"at {time_s:g} s: {now.state} ({ahead})"),
            ("too near", f"in {duration(now.time_to_s)}" if math.isfinite(now.time_to_s) else NOTHING),
            ("unknown", f"from {duration(now.unknown_from_s)} ahead" if _doubtful(now) else NOTHING),
            ("peak", number(now.peak)),
            ("turn", f"{left}, {right}"),
            ("climb", climb),
        ]
    )
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for head in ("from", "to", "ahead", "too near in", "peak"):
        table.add_column(head, justify="left" if head == "ahead" else "right")
    for span in spans:
        times = (f"{span.from_s:g} s", f"{span.to_s:g} s")
        table.add_row(*times, span.state, duration(span.nearest_s), number(span.peak))
    show(table)


def _doubtful(now: Cue) -> bool:
    """Whether the map leaves something open before the ground is known to be too near."""
    return math.isfinite(now.unknown_from_s) and not now.unknown_from_s >= now.time_to_s


def _turn(turn_deg: float, side: str) -> str:
    """A turn to one side in words."""
    if math.isnan(turn_deg):
        return f"{side}: none known to be clear"
    return f"{side}: {turn_deg:g} deg" if turn_deg else f"{side}: none needed"
