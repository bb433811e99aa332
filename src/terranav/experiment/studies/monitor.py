"""Monitor: how soon is a false GNSS found out, and how often is an honest one accused?

Each run is an hour of flight (`monitor_world`). Over the whole hour GNSS is honest, and every alarm is a false one.
Then, from a time drawn between a quarter and three quarters of the hour, GNSS is false in each of the ways of ATTACKS,
in a direction that is drawn, until it is flagged, LONGEST_S at most; the monitor begins with all that it had learned
till then. Beside them stand a pull at 2 m/s that only the map is asked about, and one that goes on since the flight
began, so that the monitor has never seen an honest reading. GNSS tells no velocity: a spoofer would pull that as well.

Cases: synthetic ground, the sample DEM, and of a folder of real data the flattest square of an alpine foreland and the
helicopter days of `real_flights`, whose GNSS was received in flight, with an INS added about it; all with an INS as
told and one that is 1.5 times worse in everything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator, SeedSequence
from numpy.typing import NDArray

from terranav.core.earth import offset_m, shift
from terranav.core.recording import Recording
from terranav.core.records import Epoch, Estimate
from terranav.experiment.gnss import alarms_of, estimates_of, readings_of, watched
from terranav.experiment.registry import make_estimator
from terranav.experiment.run import run
from terranav.experiment.studies import real_flights
from terranav.experiment.studies.monitor_report import report
from terranav.experiment.studies.monitor_world import (
    ATTACKS,
    FROM_START,
    MAP_ALONE,
    SYNTHETIC,
    TOLD_SIGMA_M,
    Attack,
    Box,
    Synthetic,
    gnss_error_m,
    recorded,
    wandering,
    worse,
)
from terranav.experiment.studies.real_flights import FlightCase, flight_cases
from terranav.experiment.studies.sources import MapSource, data_folder
from terranav.experiment.studies.study import Plan, Setup, Study
from terranav.experiment.studies.tracks import INS
from terranav.ins.drift import add_drift
from terranav.integrity.gnss import GnssMonitor, GnssState, GnssStatus

FloatArray = NDArray[np.float64]

ESTIMATOR = "marginalized"
WORSE = (1.0, 1.5)
LONGEST_S = 900.0
BEGUN_S = 60.0  # the monitor that asks the map alone starts so long before a pull
TERRAIN = (("kind", "terrain"),)


@dataclass(frozen=True)
class GroundCase:
    """Flights over one ground with an INS that is so many times worse than told."""

    source: MapSource
    factor: float = 1.0
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def ground(self) -> str:
        """'synthetic rough'."""
        return self.source.name

    @property
    def name(self) -> str:
        """'synthetic rough, INS x 1.5'."""
        return f"{self.ground}, INS x {self.factor:g}"

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        return {"name": self.name, "map": self.source.facts(), "ins": repr(INS), "settings": dict(self.settings)}

    def flown(self, rng: Generator) -> tuple[Recording, FloatArray]:
        """A recording and the errors (n, 2) of an honest GNSS [m]."""
        rec = recorded(wandering(self.source, rng), INS, self.factor, rng)
        return rec, gnss_error_m(rec.time_s, rng)


@dataclass(frozen=True)
class HelicopterCase:
    """The first hour of a helicopter day; what GNSS said there is the honest one."""

    flight: FlightCase
    factor: float = 1.0

    @property
    def ground(self) -> str:
        """The same for all days."""
        return "helicopter survey"

    @property
    def name(self) -> str:
        """'helicopter survey 20210120, INS x 1'."""
        return f"{self.ground} {self.flight.name.removeprefix('flight ')}, INS x {self.factor:g}"

    @property
    def source(self) -> MapSource:
        """The survey's map."""
        return self.flight.source

    @property
    def settings(self) -> tuple[tuple[str, Any], ...]:
        """Of the estimator."""
        return self.flight.settings

    def facts(self) -> Mapping[str, Any]:
        """What its figures depend on."""
        return {**self.flight.facts(), "name": self.name}

    def flown(self, rng: Generator) -> tuple[Recording, FloatArray]:
        """A recording; its GNSS has errors enough of its own."""
        rec = add_drift(real_flights.true_track(self.flight.path), worse(INS, self.factor), rng)
        return replace(rec, ins=INS), np.zeros((len(rec), 2))


@dataclass(frozen=True)
class Flight:
    """What a monitor sees of a flight, and where GNSS would say that the vehicle is, were it honest."""

    epochs: Sequence[Epoch]
    estimates: Sequence[Estimate]
    time_s: FloatArray
    lat_deg: FloatArray
    lon_deg: FloatArray

    def watched(
        self, monitor: GnssMonitor, state: GnssState, first: int, lat_deg: FloatArray, lon_deg: FloatArray
    ) -> Any:
        """States of a monitor from an epoch on, as long as there are positions of GNSS."""
        last = first + len(lat_deg)
        readings = readings_of(self.time_s[first:last], lat_deg, lon_deg, TOLD_SIGMA_M)
        return watched(monitor, state, self.epochs[first:last], self.estimates[first:last], readings)


def plan(setup: Setup) -> Plan:
    """The grounds at hand.

    Raises
    ------
    ConfigError
        A setting that the estimator does not have, or a folder that is not there.
    """
    settings, data = tuple(sorted(setup.settings.items())), data_folder(setup.data)
    sources, notes = [*(Synthetic(ground=name) for name in SYNTHETIC), MapSource()], []
    make_estimator(ESTIMATOR, (sources[-1].open(),), INS, **setup.settings)
    flights: list[FlightCase] = []
    if data is None:
        notes.append("only the sample DEM is at hand: name a folder of real data (--data DIR)")
    else:
        foreland = data / "srtm" / "N48E010.hgt"
        sources += [Box(foreland, TERRAIN)] if foreland.is_file() else []
        flights, why_not = flight_cases(data, setup.settings)
        notes += why_not
    cases = [GroundCase(source, factor, settings) for factor in WORSE for source in sources]
    return Plan([*cases, *(HelicopterCase(flight, factor) for factor in WORSE for flight in flights)], notes)


def run_case(case: GroundCase | HelicopterCase, seeds: SeedSequence) -> dict[str, float]:
    """One flight: see the head of the module."""
    rng = np.random.default_rng(seeds)
    rec, error_m = case.flown(rng)
    estimates = run(ESTIMATOR, rec, [case.source.open()], seed=int(rng.integers(2**31)), **dict(case.settings))
    lat, lon = shift(rec.columns["true_lat_deg"], rec.columns["true_lon_deg"], *error_m.T)
    flight = Flight(list(rec.epochs()), estimates_of(estimates), rec.time_s, lat, lon)
    monitor = GnssMonitor(rec.ins or INS)
    states = list(flight.watched(monitor, monitor.init(), 0, lat, lon))
    figures = _honest(rec.time_s, states)
    first, towards = int(len(rec) * rng.uniform(0.25, 0.75)), rng.uniform(0.0, 2.0 * np.pi)
    for attack in ATTACKS:
        figures |= _attacked(attack, flight, monitor, (states[first - 1], first), towards)
    alone = replace(monitor, horizons_s=())
    before = min(int(np.searchsorted(rec.time_s, rec.time_s[first] - BEGUN_S)), first - 1)
    state = list(flight.watched(alone, alone.init(), before, lat[before:first], lon[before:first]))[-1]
    figures |= _attacked(MAP_ALONE, flight, alone, (state, first), towards)
    return figures | _attacked(FROM_START, flight, monitor, (monitor.init(), 0), towards)


def _honest(time_s: FloatArray, states: Sequence[GnssState]) -> dict[str, float]:
    """Hours, false alarms, and the share of each status."""
    told = np.array([state.verdict.status.value for state in states])
    shares = {f"share:{status.value}": float(np.mean(told == status.value)) for status in GnssStatus}
    alarms = float(len(alarms_of(time_s, states)))
    return {"hours": float(time_s[-1] - time_s[0]) / 3600.0, "false_alarms": alarms, **shares}


def _attacked(
    attack: Attack, flight: Flight, monitor: GnssMonitor, start: tuple[GnssState, int], towards: float
) -> dict[str, float]:
    """How long it took, and how far off GNSS was, when it was flagged; NaN when it was not.

    `start`: the state of the monitor before the attack, and the epoch at which that begins.
    """
    state, first = start
    last = int(np.searchsorted(flight.time_s, flight.time_s[first] + LONGEST_S, side="right"))
    lat, lon = attack.positions(flight.time_s, flight.lat_deg, flight.lon_deg, slice(first, last), towards)
    off = np.hypot(*offset_m(flight.lat_deg[first:last], flight.lon_deg[first:last], lat, lon))
    wanted = GnssStatus.JAMMED if attack.absent else GnssStatus.SPOOFED
    found = {f"{attack.name}:m": np.nan, f"{attack.name}:s": np.nan}
    for i, after in enumerate(flight.watched(monitor, state, first, lat, lon)):
        if after.verdict.status is wanted:
            return {f"{attack.name}:m": float(off[i]), f"{attack.name}:s": float(after.time_s - flight.time_s[first])}
    return found


STUDY = Study(
    "monitor",
    "How soon does the GNSS monitor flag a false GNSS, and how often an honest one?",
    plan,
    run_case,
    report,
    runs=25,
    chunk=1,
)
