"""terranav cue: will the ground come too near, and which way is clear?"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from terranav.app.commands import options

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from terranav.core.recording import Recording
    from terranav.core.records import Estimate
    from terranav.experiment.result import Result
    from terranav.maps.map import Map
    from terranav.planning.cue import Cue, CueSettings

    FloatArray = NDArray[np.float64]

MOST_CUES = 600  # of the timeline; a longer flight is looked at less often


def cue(
    *,
    recording: options.Recording,
    maps: options.Maps = None,
    estimator: Annotated[str, typer.Option(metavar="NAME", help="See `terranav estimators`.")] = "pointmass",
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
    map_kind: options.MapKinds = None,
    map_sigma: options.MapSigmas = None,
    map_crs: options.MapCrs = None,
    map_variable: options.MapVariables = None,
    map_unit: options.MapUnits = None,
) -> int:
    """Terrain avoidance cueing: run an estimator, look ahead from where it is, and list the warnings of the flight."""
    from terranav.app.console import OK, show_json, working
    from terranav.app.given import Given
    from terranav.experiment.run import run
    from terranav.planning.cue import CueSettings

    settings = CueSettings(margin, lookahead, threshold, altitude_sigma, bank_deg=bank)
    map_options = {
        "kind": map_kind, "sigma": map_sigma, "crs": map_crs, "variable": map_variable, "unit": map_unit
    }  # fmt: skip
    rec, charts, told = Given(recording, maps or (), map_options, ins, drift, drift_seed, first).read()
    ground, row = _ground(charts), _row_at(rec, at)
    with working("flying"):
        result = run(estimator, rec, charts, seed=seed, ins=told)
        flight = Flight(rec, result, ground, settings)
        now, spans = flight.cue(row), flight.timeline()
    time_s = float(rec.time_s[row])
    if as_json:
        show_json(_as_json(time_s, now, spans, settings))
    else:
        _show(rec.name, time_s, now, spans, settings)
    return OK


@dataclass(frozen=True)
class Span:
    """Neighbouring epochs with the same state."""

    from_s: float
    to_s: float
    state: str
    nearest_s: float  # shortest time to the ground coming too near, NaN where none
    peak: float


class Flight:
    """A flown recording that can be looked ahead from at every epoch."""

    def __init__(self, rec: Recording, result: Result, chart: Map, settings: CueSettings) -> None:
        self._rec, self._result, self._chart, self._settings = rec, result, chart, settings
        self._velocity = _velocity(rec)

    def cue(self, row: int, *, evade: bool = True) -> Cue:
        """The cue at one epoch."""
        from terranav.planning.cue import cue as look_ahead

        north, east, down = self._velocity[row].tolist()
        return look_ahead(self._estimate(row), (north, east, down), self._chart, self._settings, evade=evade)

    def timeline(self) -> list[Span]:
        """What the look-ahead said over the whole flight."""
        spans: list[Span] = []
        for row in range(0, len(self._rec), max(1, math.ceil(len(self._rec) / MOST_CUES))):
            time_s, found = float(self._rec.time_s[row]), self.cue(row, evade=False)
            here = Span(time_s, time_s, str(found.state), found.time_to_s, found.peak)
            if spans and spans[-1].state == here.state:
                before = spans.pop()
                nearest, peak = _least(before.nearest_s, here.nearest_s), -_least(-before.peak, -here.peak)
                here = Span(before.from_s, time_s, here.state, nearest, peak)
            spans.append(here)
        return spans

    def _estimate(self, row: int) -> Estimate:
        from terranav.core.records import Estimate, Status

        result = self._result
        return Estimate(
            float(result.time_s[row]),
            float(result.lat_deg[row]),
            float(result.lon_deg[row]),
            float(result.alt_m[row]),
            result.ins_error_m[row],
            result.cov_m2[row],
            Status(str(result.status[row])),
        )


def _least(one: float, other: float) -> float:
    """The smaller number, NaN only where both are."""
    return min((value for value in (one, other) if not math.isnan(value)), default=math.nan)


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


def _velocity(rec: Recording) -> FloatArray:
    """(n, 3) north, east, down: as indicated, where a reading is missing from the indicated positions [m/s]."""
    import numpy as np

    from terranav.core.earth import offset_m
    from terranav.core.errors import DataError
    from terranav.core.recording import VELOCITY

    told = np.full((len(rec), 3), np.nan)
    for axis, key in enumerate(VELOCITY):
        if key in rec.columns:
            told[:, axis] = rec.columns[key]
    if np.isfinite(told).all():
        return told
    if len(rec) < 2:
        raise DataError(f"{rec.name}: one epoch without {', '.join(VELOCITY)}, expected a velocity or two epochs")
    north, east = offset_m(rec.lat_deg[0], rec.lon_deg[0], rec.lat_deg, rec.lon_deg)
    rates = np.gradient(np.stack([north, east, -rec.alt_m], axis=1), rec.time_s, axis=0)
    return np.where(np.isfinite(told), told, rates)


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
