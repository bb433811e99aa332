"""papers/004: TERCOM against fading memory over flat and rough land, under four readings of the drift.

The paper's land is not given. Here it is a real map whose heights about their mean are scaled until TERCOM alone, in
flights of their own and without drift, matches as often as the paper's TERCOM did; fading memory is not looked at.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.random import SeedSequence
from numpy.typing import NDArray

from terranav.core.errors import ConfigError
from terranav.experiment.montecarlo import Failure, Interval, bootstrap, monte_carlo
from terranav.experiment.papers import _p004_flights as flights
from terranav.experiment.papers.outcome import Claim, Figure, Reproduction, Series, Setup, Table, Verdict
from terranav.kernels.fading_memory import recall
from terranav.kernels.tercom import correlation_surface
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]
Land = Literal["flat", "rough"]

TITLE = "Terrain aided navigation using fading memory (Feng, Shen and Chang, 2003)"
MAIN = "none"
LADDER = np.geomspace(0.04, 1.0, 9)
PILOT_RUNS = 8, 40  # least and most flights that choose the relief; as many as there are runs between them
PAPER_MATCH = {"flat": (0.4738, 0.8347), "rough": (0.8652, 0.9403)}
PAPER_CEP_M = {"flat": (87.39, 34.15), "rough": (35.44, 35.26)}
BINS_M = np.arange(0.0, 601.0, 20.0)


@dataclass(frozen=True)
class Misses:
    """Distances from the truth [m] of one case, (runs, fixes, 2): TERCOM and fading memory."""

    metres: FloatArray

    @property
    def matched(self) -> FloatArray:
        """(runs, fixes, 2) whether each counts as correct, 0 or 1."""
        return (self.metres <= flights.MATCH_M).astype(np.float64)

    def rate(self, method: int) -> Interval:
        """Share of correct matches."""
        return bootstrap(self.matched[:, :, method])

    def cep(self, method: int) -> Interval:
        """Median distance [m]."""
        return bootstrap(self.metres[:, :, method], np.median)

    def rate_gain(self) -> Interval:
        """Fading memory's share less TERCOM's, of the same flights."""
        return bootstrap(self.matched[:, :, 1] - self.matched[:, :, 0])

    def cep_gain(self) -> Interval:
        """TERCOM's median distance less fading memory's, of the same flights [m]."""
        return bootstrap(self.metres, _median_gap)


@dataclass(frozen=True)
class Study:
    """All cases: the two lands under each reading of the drift, and the ladder of reliefs without drift."""

    factors: dict[Land, float]
    cases: dict[tuple[Land, str], Misses]
    ladder: list[Misses]
    relief_m: FloatArray  # (ladder,)
    land_relief_m: dict[Land, float]
    failures: list[Failure]


def reproduce(setup: Setup) -> Reproduction:
    """Run papers/004 again.

    Parameters
    ----------
    setup : Setup
        `maps`: one terrain map in place of the sample DEM; it is resampled to 60 m.

    Raises
    ------
    ConfigError
        More than one map, or one that is no terrain.
    DataError
        A map too small for the flights.
    """
    land = flights.resampled(_chart(setup.maps))
    study = run(land, setup)
    cost = measure(land)
    scenario = (
        f"{land.name} resampled to 60 m. {setup.runs} straight flights of {flights.EPOCHS} readings at 4 Hz and "
        f"{flights.SPEED_MPS:.0f} m/s, anywhere on it and in any direction; noise 15 m (radar) and 3 m (barometer); "
        f"search area 6 x 6 km; both methods give a cell's centre after {', '.join(map(str, flights.FIXES))} readings. "
        "Initial errors are drawn with 2 km per axis and drawn again where they leave the search area: a quarter "
        "would, and a match rate of 94 % could not be. The paper's land is not given: heights are scaled about their "
        f"mean by {study.factors['flat']:.2f} (flat, {study.land_relief_m['flat']:.0f} m 1-sigma along a track) and "
        f"{study.factors['rough']:.2f} (rough, {study.land_relief_m['rough']:.0f} m), where TERCOM alone, without "
        f"drift and in {_pilots(setup)} other flights, matches as often as the paper's. How the drift of 5 m/s acts is "
        "not said: " + "; ".join(flights.READINGS.values()) + " are each run on the same flights."
    )
    return Reproduction(
        "004", TITLE, scenario, setup.runs, _tables(study, cost), _claims(study, cost), _figures(study), study.failures
    )


def run(land: Map, setup: Setup) -> Study:
    """All flights over a land of 60 m cells."""
    seeds = SeedSequence(setup.seed).spawn(2)
    factors = _factors(land, seeds[0], setup)
    reliefs = {key: flights.relieved(land, factor) for key, factor in factors.items()}
    ladder = [flights.relieved(land, float(factor)) for factor in LADDER]

    def work(_: int, seed: SeedSequence) -> dict[Any, FloatArray]:
        flight = flights.draw(land, np.random.default_rng(seed))
        seen = {reading: flights.indicated(land, flight, reading) for reading in flights.READINGS}
        found: dict[Any, FloatArray] = {}
        for key, chart in reliefs.items():
            height = flights.measured(chart, flight)
            for reading, each in seen.items():
                found[key, reading] = _both(chart, each, height)
            found[key] = np.array(flights.relief_m(chart, flight))
        for i, chart in enumerate(ladder):
            found[i] = _both(chart, seen[MAIN], flights.measured(chart, flight))
            found[i, "relief"] = np.array(flights.relief_m(chart, flight))
        return found

    seed = int(seeds[1].generate_state(1)[0])
    results, failures = monte_carlo(work, setup.runs, seed=seed, executor=setup.executor, on_run=setup.on_run)

    def gathered(key: Any) -> FloatArray:
        return np.array([result[key] for result in results])

    return Study(
        factors,
        {(key, reading): Misses(gathered((key, reading))) for key in reliefs for reading in flights.READINGS},
        [Misses(gathered(i)) for i in range(len(ladder))],
        np.array([gathered((i, "relief")).mean() for i in range(len(ladder))]),
        {key: float(gathered(key).mean()) for key in reliefs},
        failures,
    )


def measure(land: Map) -> dict[str, dict[str, float]]:
    """Time [s] of one fix of each method, minimum of 15 interleaved repeats, and what it keeps [bytes]."""
    flight = flights.draw(land, np.random.default_rng(0))
    seen, height = flights.indicated(land, flight, MAIN), flights.measured(land, flight)
    axis = flights.lattice()
    surface, spare = np.zeros((axis.size, axis.size)), np.empty((axis.size, axis.size))
    part = slice(0, flights.PROFILE)
    readings = np.stack([height[part], np.ones(flights.PROFILE)], axis=1)

    def batch() -> None:
        correlation_surface(land.values, seen.frames[part], readings, (axis, axis), False, False, surface, spare)
        surface.argmin()

    def recursive() -> None:
        recall(land.values, seen.frames[0], (axis, axis), (height[0], 1.0), flights.ALPHA, surface, spare)
        spare.argmin()

    times = _fastest([batch, recursive])
    profile = 3.0 * readings[:, 0].nbytes  # heights, latitudes, longitudes
    cells = float(axis.size**2)
    return {
        "TERCOM, all 48 readings for each fix": {
            "time": times[0], "squares": flights.PROFILE * cells, "bytes": profile + surface.nbytes,
        },
        "TERCOM, sliding: the newest square added, the 49th taken away": {
            "time": float("nan"), "squares": cells, "bytes": (flights.PROFILE + 1.0) * surface.nbytes,
        },
        "fading memory": {"time": times[1], "squares": cells, "bytes": float(surface.nbytes)},
    }  # fmt: skip


def _chart(maps: Sequence[Map]) -> Map:
    """The user's terrain map, or the sample DEM."""
    if not maps:
        from terranav.maps.sample_dem import sample_map

        return sample_map()
    if len(maps) > 1 or maps[0].kind != "terrain":
        kinds = ", ".join(chart.kind for chart in maps)
        raise ConfigError(f"papers/004 is given maps of kind {kinds}, expected one of kind terrain")
    return maps[0]


def _factors(land: Map, seed: SeedSequence, setup: Setup) -> dict[Land, float]:
    """Factors of relief at which TERCOM, without drift, matches as often as the paper's: interpolated on the ladder."""
    charts = [flights.relieved(land, float(factor)) for factor in LADDER]

    def work(_: int, seed: SeedSequence) -> FloatArray:
        flight = flights.draw(land, np.random.default_rng(seed))
        seen = flights.indicated(land, flight, MAIN)
        misses = [flights.tercom_misses(chart, seen, flights.measured(chart, flight)) for chart in charts]
        return np.asarray(np.mean(np.array(misses) <= flights.MATCH_M, axis=1))

    results, _failures = monte_carlo(work, _pilots(setup), seed=int(seed.generate_state(1)[0]), executor=setup.executor)
    rates = np.maximum.accumulate(np.mean(results, axis=0))
    rates += 1e-9 * np.arange(rates.size)  # strictly rising
    wanted = {key: np.interp(pair[0], rates, np.log(LADDER)) for key, pair in PAPER_MATCH.items()}
    return {"flat": float(np.exp(wanted["flat"])), "rough": float(np.exp(wanted["rough"]))}


def _pilots(setup: Setup) -> int:
    """Flights that choose the relief."""
    return min(max(setup.runs, PILOT_RUNS[0]), PILOT_RUNS[1])


def _both(chart: Map, seen: flights.Seen, height_m: FloatArray) -> FloatArray:
    """(fixes, 2) misses of both methods [m]."""
    pair = flights.tercom_misses(chart, seen, height_m), flights.fading_misses(chart, seen, height_m)
    return np.stack(pair, axis=1)


def _median_gap(metres: FloatArray, axis: Any) -> FloatArray:
    """Median of TERCOM's distances less that of fading memory's."""
    return np.asarray(np.median(metres[..., 0]) - np.median(metres[..., 1]))


def _fastest(works: Sequence[Callable[[], None]]) -> list[float]:
    """Least time of each [s], the repeats interleaved so that all meet the same machine."""
    times = np.full((15, len(works)), np.inf)
    for work in works:
        work()
    for row in times:
        for i, work in enumerate(works):
            began = time.perf_counter()
            work()
            row[i] = time.perf_counter() - began
    return [float(each) for each in times.min(axis=0)]


def _tables(study: Study, cost: dict[str, dict[str, float]]) -> list[Table]:
    """Match rate and CEP under each reading; computing and storage."""
    rows = []
    for reading, words in flights.READINGS.items():
        for land in ("flat", "rough"):
            case = study.cases[land, reading]
            rows.append((
                words, land, *(case.rate(m).text(1, 100.0) for m in (0, 1)), case.rate_gain().text(1, 100.0),
                *(case.cep(m).text(0) for m in (0, 1)),
            ))  # fmt: skip
    paper = [
        (
            "the paper", land, *(f"{100.0 * rate:.2f}" for rate in PAPER_MATCH[land]),
            f"{100.0 * (PAPER_MATCH[land][1] - PAPER_MATCH[land][0]):.2f}",
            *(f"{cep:.2f}" for cep in PAPER_CEP_M[land]),
        )
        for land in ("flat", "rough")
    ]  # fmt: skip
    costs = [
        (
            name,
            f"{entry['squares'] / 1e3:.0f}",
            "-" if np.isnan(entry["time"]) else f"{1e6 * entry['time']:.0f}",
            f"{entry['bytes'] / 1e3:.0f}",
        )
        for name, entry in cost.items()
    ]
    heads = ("drift", "land", "match TERCOM [%]", "match fading [%]", "gain [%]", "CEP TERCOM [m]", "CEP fading [m]")
    return [
        Table("Table 1: correct matches (within 85 m) and CEP, by reading of the drift", heads, (*paper, *rows)),
        Table(
            "Computing and storage of one fix, 101 x 101 cells",
            ("method", "squares [1000]", "time [us]", "kept [kB]"),
            tuple(costs),
        ),
    ]


def _claims(study: Study, cost: dict[str, dict[str, float]]) -> list[Claim]:
    """Each claim with its verdict under all readings together."""
    claims = []
    lands: tuple[Land, Land] = ("flat", "rough")
    for land in lands:
        gains = {reading: study.cases[land, reading].rate_gain() for reading in flights.READINGS}
        ours = " -> ".join(study.cases[land, MAIN].rate(m).text(1, 100.0) for m in (0, 1))
        paper = " -> ".join(f"{100.0 * rate:.2f} %" for rate in PAPER_MATCH[land])
        claims.append(
            Claim(f"fading memory matches more often over {land} land", paper, f"{ours} %", *_judged(gains, 100.0, "%"))
        )
    for land in lands:
        gains = {reading: study.cases[land, reading].cep_gain() for reading in flights.READINGS}
        ours = " -> ".join(study.cases[land, MAIN].cep(m).text(0) for m in (0, 1))
        paper = " -> ".join(f"{cep:.2f} m" for cep in PAPER_CEP_M[land])
        what = "has a smaller CEP" if land == "flat" else "has no larger CEP"
        verdict = _judged(gains, 1.0, "m", equal_will_do=land == "rough")
        claims.append(Claim(f"fading memory {what} over {land} land", paper, f"{ours} m", *verdict))
    batch, sliding, fading = cost.values()
    claims.append(
        Claim(
            "less computing and storage",
            "no figure",
            f"{batch['time'] / fading['time']:.0f} times faster a fix; {fading['bytes'] / 1e3:.0f} kB kept",
            "holds in part",
            f"a fix after every reading costs 1/{batch['squares'] / fading['squares']:.0f} of the squares of a TERCOM "
            f"that correlates its whole profile anew, and 1/{sliding['bytes'] / fading['bytes']:.0f} of the storage "
            "of one that slides; but a TERCOM that gives one fix for every 48 readings computes as many squares a "
            f"reading, and keeps {(batch['bytes'] - fading['bytes']) / 1e3:.0f} kB beside the surface",
        )
    )
    return claims


def _judged(gains: dict[str, Interval], scale: float, unit: str, *, equal_will_do: bool = False) -> tuple[Verdict, str]:
    """Verdict on a gain under the readings, and what each says."""
    better = [reading for reading, gain in gains.items() if gain.low > 0.0 or (equal_will_do and gain.high >= 0.0)]
    worse = [reading for reading, gain in gains.items() if gain.high < 0.0]
    verdict: Verdict = "holds" if len(better) == len(gains) else "holds in part" if better else "does not hold"
    each = "; ".join(f"{flights.READINGS[key]}: {gain.text(1, scale)} {unit}" for key, gain in gains.items())
    lag = " (a constant drift smears the memory: its mean age of 16 s puts the fix 117 m behind)" if worse else ""
    turned = f"; reversed under: {', '.join(flights.READINGS[key] for key in worse)}{lag}" if worse else ""
    return verdict, f"gain by reading, paired: {each}{turned}"


def _figures(study: Study) -> list[Figure]:
    """Figures 3 and 4, histograms of the error, and the match rate against the relief."""
    centres = 0.5 * (BINS_M[1:] + BINS_M[:-1])
    names = ("TERCOM", "fading memory")
    figures = []
    for number, land in ((3, "flat"), (4, "rough")):
        for reading in (MAIN, "constant"):
            metres = study.cases[land, reading].metres  # type: ignore[index]
            shares = [
                np.histogram(np.minimum(metres[:, :, m], BINS_M[-1] - 1.0), BINS_M)[0] / metres[:, :, m].size
                for m in (0, 1)
            ]
            series = [Series(name, centres, 100.0 * share) for name, share in zip(names, shares, strict=True)]
            title = f"Fig. {number}: errors over {land} land, {flights.READINGS[reading]} (last bar: all beyond)"
            figures.append(Figure(f"errors_{land}_{reading}", title, "error [m]", "share [%]", tuple(series), "bars"))
    rates = [[misses.rate(m) for misses in study.ladder] for m in (0, 1)]
    lines = [
        Series(
            name,
            study.relief_m,
            *(100.0 * np.array([getattr(rate, key) for rate in row]) for key in ("value", "low", "high")),
        )
        for name, row in zip(names, rates, strict=True)
    ]
    title = "Correct matches against the relief, without drift"
    figures.append(
        Figure("match_by_relief", title, "1-sigma of heights along the track [m]", "correct [%]", tuple(lines))
    )
    return figures
