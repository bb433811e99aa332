"""Papers/002: terrain and gravity, point-mass filters mixed by kurtosis weights, against their joint likelihood.

The flights are in `_p002_cases`; this module runs them, compares, and says what became of the paper's claims.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import GRAVITY_MPS2
from terranav.experiment.montecarlo import Failure, Interval, bootstrap, monte_carlo
from terranav.experiment.papers._p002_cases import (
    DURATION_S,
    FED_BACK,
    GRAVITY,
    JOINT,
    MIX,
    MODES,
    OWN,
    POSITION,
    SPEED_MPS,
    TERRAIN,
    Case,
    Flown,
    Terms,
    cases,
    fly,
)
from terranav.experiment.papers.outcome import Claim, Figure, Reproduction, Series, Setup, Table, Verdict

FloatArray = NDArray[np.float64]

TITLE = "Hybrid of terrain and gravity by kurtosis weights (W. Lee, Y. M. Yoo, S. Yun, C. G. Park)"

PAPER = {
    "A": {TERRAIN: (14.23, 15.03), GRAVITY: (61.24, 43.20), MIX: (8.29, 10.06)},
    "B": {TERRAIN: (58.17, 93.27), GRAVITY: (24.91, 52.98), MIX: (21.74, 48.67)},
}
#: label of a reading of the paper, and what it changes
OPEN_POINTS: tuple[tuple[str, Terms], ...] = (
    (
        "VRW as a velocity walk, 5 ug in an hour: 0.177 m/s/sqrt(h)",
        Terms(accel_walk_mps_per_sqrt_h=5e-6 * GRAVITY_MPS2 * 3600),
    ),
    ("initial velocity error of 0.1 m/s", Terms(velocity_sigma_mps=0.1)),
    ("gravity noise of 1 mGal, as flown gravimeters have", Terms(gravity_sigma_mgal=1.0)),
)
IN_MAP = Terms(noise_in="map")


@dataclass(frozen=True)
class Study:
    """The runs of both cases under the same terms."""

    runs: dict[str, list[Flown]]

    def mean_m(self, case: str, mode: str) -> FloatArray:
        """(runs,) mean horizontal error of each run [m]."""
        return np.array([float(run.error_m[mode].mean()) for run in self.runs[case]])

    def best_single(self, case: str) -> str:
        """The single map with the smaller mean error over all runs."""
        return min((TERRAIN, GRAVITY), key=lambda mode: float(self.mean_m(case, mode).mean()))

    def gain(self, case: str, mode: str, than: str | None = None) -> Interval:
        """Paired difference of mean errors, `mode` minus `than` (the best single map unless said) [m]."""
        return bootstrap(self.mean_m(case, mode) - self.mean_m(case, than or self.best_single(case)))


class _Campaign:
    """Runs studies one after another and reports their progress as one."""

    def __init__(self, setup: Setup, flights: tuple[Case, Case]) -> None:
        self._setup, self._flights = setup, flights
        few, half = max(2, setup.runs // 5), max(2, setup.runs // 2)
        self.runs = {"main": 4 * setup.runs, "open": half, "few": few}
        self._all = 2 * (4 * setup.runs + 2 * half + len(OPEN_POINTS) * few)
        self._before = 0
        self.failures: list[Failure] = []

    def fly(self, terms: Terms, size: str, *, readings: bool = False) -> Study:
        """Fly both cases under these terms."""
        found = {}
        for i, case in enumerate(self._flights):
            runs, failed = monte_carlo(
                lambda _, seeds, case=case: fly(case, terms, seeds, readings=readings),  # type: ignore[misc]
                self.runs[size],
                seed=2 * self._setup.seed + i,
                executor=self._setup.executor,
                on_run=self._progress,
            )
            self._before += self.runs[size]
            self.failures += failed
            found[case.name] = runs
        return Study(found)

    def _progress(self, done: int, _: int) -> None:
        if self._setup.on_run is not None:
            self._setup.on_run(self._before + done, self._all)


def reproduce(setup: Setup) -> Reproduction:
    """Fly both cases and judge the paper's claims.

    Parameters
    ----------
    setup : Setup
        The main comparison takes 4 x setup.runs paired runs of each case, the readings of open points fewer.

    Returns
    -------
    Reproduction

    Raises
    ------
    DataError
        A map of another kind, one too small for the flight, maps that do not overlap.
    """
    flights = cases(setup.maps, setup.seed)
    campaign = _Campaign(setup, flights)
    main = campaign.fly(Terms(), "main")
    mixes = campaign.fly(Terms(), "open", readings=True)
    in_map = campaign.fly(IN_MAP, "open")
    points = [(label, campaign.fly(terms, "few")) for label, terms in OPEN_POINTS]
    return Reproduction(
        paper="002",
        title=TITLE,
        scenario=_scenario(flights, campaign),
        runs=campaign.runs["main"],
        tables=(
            *[_case_table(case, main) for case in flights],
            _mix_table(mixes),
            _points_table([("as above", main), ("noise as an error of the map's cells", in_map), *points]),
        ),
        claims=(*[_figures_claim(case, main) for case in flights], _mix_claim(main), _joint_claim(main, in_map)),
        figures=tuple(_figure(case, main) for case in flights),
        failures=tuple(campaign.failures),
    )


def _scenario(flights: Sequence[Case], campaign: _Campaign) -> str:
    """What was flown, and how the open points were read."""
    gravity = "; ".join(
        f"{case.name}: {case.gravity.name}"
        if case.gravity is not None
        else f"{case.name}: drawn for each run, {case.gravity_std_mgal:g} mGal, correlation "
        f"{case.gravity_correlation_m / 1e3:g} km"
        for case in flights
    )
    land = "; ".join(f"{case.name}: {case.land}" for case in flights)
    return (
        f"{DURATION_S:g} s at {SPEED_MPS:g} m/s, straight and level 3 km above ground, a reading of each kind a second."
        f" Terrain of 3 arcsec ({land}), noise 10 m; gravity anomaly of 30 arcsec ({gravity}), noise 0.01 mGal; both "
        "noises drawn anew for each reading, the v_t of eq. 1. INS of Table 1 (25 ug, 0.003 deg/h, 0.0015 deg/sqrt(h), "
        "'5 ug/sqrt(hr)' read as 5 ug/sqrt(Hz)), 200 m initial error on each axis, no initial velocity error or tilt, "
        "by its error model on position level: a straight and level flight excites nothing else. Duration, speed, both "
        "fields and the place are ours: the paper does not state them. "
        f"Paired runs of each case: {campaign.runs['main']}; for open points {campaign.runs['open']} or "
        f"{campaign.runs['few']}."
    )


def _case_table(case: Case, study: Study) -> Table:
    """Tables 2 and 3 beside ours."""
    rows = []
    for mode in MODES:
        paper = PAPER[case.name].get(mode)
        flown = study.runs[case.name]
        errors = np.stack([run.error_m[mode] for run in flown])
        nees = float(np.mean([run.nees[mode] for run in flown]))
        rows.append(
            (
                mode,
                f"{paper[0]:.2f}" if paper else "-",
                bootstrap(study.mean_m(case.name, mode)).text(2),
                f"{paper[1]:.2f}" if paper else "-",
                f"{errors.std():.2f}",
                f"{np.mean(errors[:, -1]):.2f}",
                f"{nees:.1f}",
            )
        )
    share = float(np.mean([run.weight_terrain.mean() for run in study.runs[case.name]]))
    return Table(
        f"Case {case.name} ({case.land}): horizontal error [m]; the mix weighs terrain {100 * share:.0f} % on average",
        ("mode", "paper mean", "mean (95 %)", "paper std", "std", "at the end", "NEES (2)"),
        tuple(rows),
    )


def _mix_table(study: Study) -> Table:
    """Every reading of the weighting logic."""
    what = {
        MIX: "values of the density over one area for all maps, each filter on its own",
        OWN: "values of the density over each filter's own grid",
        POSITION: "position under the density (Gaussian: 3)",
        FED_BACK: "as the first, the mix is the next prior of both filters",
    }
    rows = [
        (mode, meaning, *[bootstrap(study.mean_m(case, mode)).text(2) for case in ("A", "B")])
        for mode, meaning in what.items()
    ]
    return Table("Readings of eqs. 11-14: mean error [m]", ("mix", "kurtosis of", "case A", "case B"), tuple(rows))


def _points_table(studies: Sequence[tuple[str, Study]]) -> Table:
    """Every reading of noise and INS: the mean error of each mode in both cases."""
    rows = []
    for label, study in studies:
        for case in ("A", "B"):
            runs = len(study.runs[case])
            means = [f"{study.mean_m(case, mode).mean():.2f}" for mode in MODES]
            rows.append((label, case, str(runs), *means, study.gain(case, JOINT).text(2)))
    head = ("reading", "case", "runs", *MODES, "joint - best single (95 %)")
    return Table("Readings of noise and INS: mean error [m]", head, tuple(rows))


def _figures_claim(case: Case, study: Study) -> Claim:
    """The order of the three modes of Table 2 or 3; the sizes are told, the order judged."""
    best, worst = (TERRAIN, GRAVITY) if case.name == "A" else (GRAVITY, TERRAIN)
    singles, mixed = study.gain(case.name, best, worst), study.gain(case.name, MIX, best)
    means = " / ".join(bootstrap(study.mean_m(case.name, mode)).text(2) for mode in (TERRAIN, GRAVITY, MIX))
    held = [singles.high < 0.0, mixed.high < 0.0]
    verdict: Verdict = "holds" if all(held) else "holds in part" if any(held) else "does not hold"
    why = (
        f"{best} minus {worst} {singles.text(2)} m: {_means(singles)}; mix minus {best} {mixed.text(2)} m: "
        f"{_means(mixed)}. The order is judged; the sizes depend on land and gravity, which the paper shows but does "
        "not give."
    )
    paper = " / ".join(f"{PAPER[case.name][mode][0]:.2f}" for mode in (TERRAIN, GRAVITY, MIX))
    land = "rough" if case.name == "A" else "flat"
    text = f"{land} terrain (case {case.name}): mean error of terrain / gravity / both, mix < {best} < {worst}"
    return Claim(text, f"{paper} m", f"{means} m", verdict, why)


def _means(gain: Interval) -> str:
    """What a paired difference says."""
    return "better" if gain.high < 0.0 else "worse" if gain.low > 0.0 else "no difference beyond chance"


def _mix_claim(study: Study) -> Claim:
    """Whether the mix beats the best single map, and how it fares against the joint likelihood."""
    gains = {case: study.gain(case, MIX) for case in ("A", "B")}
    rival = {case: study.gain(case, MIX, JOINT) for case in ("A", "B")}
    won = [gain.high < 0.0 for gain in gains.values()]
    verdict: Verdict = "holds" if all(won) else "holds in part" if any(won) else "does not hold"
    ours = "; ".join(f"{case} {gain.text(2)} m, {_means(gain)}" for case, gain in gains.items())
    against = "; ".join(f"{case} {gain.text(2)} m, {_means(gain)}" for case, gain in rival.items())
    why = (
        "A weighted sum of two posteriors lies between them: it averages their errors, which helps where both are of "
        "one size and independent, but it never intersects them as their product does, and of a posterior that says "
        f"nothing it keeps a part. Against the joint likelihood: {against}."
    )
    return Claim("the kurtosis mix beats the best single map", "-5.94 m (A), -3.17 m (B)", ours, verdict, why)


def _joint_claim(study: Study, in_map: Study) -> Claim:
    """Whether the joint likelihood is at most the best single map, under both readings of the noise."""
    gains = {case: study.gain(case, JOINT) for case in ("A", "B")}
    others = {case: in_map.gain(case, JOINT) for case in ("A", "B")}
    held = [gain.high <= 0.0 for gain in (*gains.values(), *others.values())]
    verdict: Verdict = "holds" if all(held) else "holds in part" if any(held) else "does not hold"
    ours = "; ".join(f"{case} {gain.text(2)} m, {_means(gain)}" for case, gain in gains.items())
    other = "; ".join(f"{case} {gain.text(2)} m, {_means(gain)}" for case, gain in others.items())
    nees = {case: float(np.mean([run.nees[TERRAIN] for run in in_map.runs[case]])) for case in ("A", "B")}
    why = (
        f"With the noise as an error of the map's cells: {other}. A map's own error stays where it is and passes for "
        "relief, while the filter takes it for noise of the readings: with terrain alone the NEES, 2 when honest, is "
        f"then {nees['A']:.1f} (A) and {nees['B']:.1f} (B), and where the land has hardly more relief than the map has "
        "error the joint pays for that."
    )
    text = "our rival: the joint likelihood is at most the best single map in both cases (paired)"
    return Claim(text, "not in the paper", ours, verdict, why)


def _figure(case: Case, study: Study) -> Figure:
    """Figure 6 or 7: horizontal error against time, mean over runs."""
    series = []
    for mode in MODES:
        errors = np.stack([run.error_m[mode] for run in study.runs[case.name]])
        time_s = np.arange(errors.shape[1], dtype=np.float64)
        low, high = np.percentile(errors, [25.0, 75.0], axis=0)
        series.append(Series(mode, time_s, errors.mean(axis=0), low, high))
    number, runs = 6 if case.name == "A" else 7, len(study.runs[case.name])
    return Figure(
        f"case_{case.name.lower()}",
        f"Horizontal error of case {case.name} (Figure {number}): mean over {runs} runs, middle half",
        "time [s]",
        "horizontal error [m]",
        tuple(series),
        log_y=True,
    )
