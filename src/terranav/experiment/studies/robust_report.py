"""What the runs of `robust` say: a table for each of its parts, and what was asked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.experiment.montecarlo import Interval
from terranav.experiment.papers.outcome import Table
from terranav.experiment.studies.ensemble import count, of_runs
from terranav.experiment.studies.statistics import clopper_pearson, per_case
from terranav.experiment.studies.study import CaseRuns, Report, Verdict, plain, shown

ASKED_COST, ASKED_SIGMAS, ASKED_NEES, ASKED_DECLARED_S, ASKED_GAIN = 1.10, 3.0, 3.0, 60.0, 0.20

FloatArray = NDArray[np.float64]
Part = tuple[list[Table], list[Verdict], list[dict[str, Any]]]


def report(cases: Sequence[CaseRuns]) -> Report:
    """Tables and verdicts of every part that was run."""
    groups: dict[str, list[CaseRuns]] = {}
    for one in cases:
        groups.setdefault(one.case.what, []).append(one)
    bias = {what: some for what, some in groups.items() if "plain_m2" in some[0].figures}
    wrong = {what: some for what, some in groups.items() if "mse_m2" in some[0].figures}
    rest = [
        part(what, some)
        for name, part in (("declared_s", _kidnapped), ("before_fix", _smoothed))
        for what, some in groups.items()
        if name in some[0].figures
    ]
    parts = [*([_biased(bias)] if bias else []), *([_wrong(wrong)] if wrong else []), *rest]
    return Report(
        [table for tables, _, _ in parts for table in tables],
        [verdict for _, verdicts, _ in parts for verdict in verdicts],
        figures=[fact for _, _, facts in parts for fact in facts],
    )


def pooled_ratio(cases: Sequence[CaseRuns], above: str, below: str) -> Interval:
    """Root of the ratio of the sums of two figures over all runs, drawn together within each case."""
    pairs = per_case([np.stack([one[above], one[below]], axis=1) for one in cases], _means)
    return pairs.over_cases(lambda values, axis: np.exp(np.mean(values, axis=axis)))


def _means(pairs: FloatArray) -> FloatArray:
    """Log of the ratio of root mean squares, of (..., runs, 2)."""
    mean = pairs.mean(axis=-2)
    return np.asarray(0.5 * np.log(mean[..., 0] / mean[..., 1]))


def _biased(groups: dict[str, list[CaseRuns]]) -> Part:
    """RMSE with the bias over that without, and how far off the bias is estimated."""
    rows, verdicts, facts = [], [], []
    for what, cases in groups.items():
        cost = pooled_ratio(cases, "biased_m2", "plain_m2")
        off = np.concatenate([one["bias_off"] for one in cases])
        inside = clopper_pearson(int(np.sum(np.abs(off) <= ASKED_SIGMAS)), len(off))
        worst = float(np.max(np.abs(off)))
        rows.append((what, str(len(cases)), str(len(off)), shown(cost), shown(inside, 1, scale=100.0), f"{worst:.1f}"))
        verdicts += [
            Verdict(f"{what}: RMSE over that without", f"<= {ASKED_COST}", shown(cost), cost.value <= ASKED_COST),
            Verdict(f"{what}: its estimate within {ASKED_SIGMAS:g} sigma", "99.7 % of runs",
                    shown(inside, 1, "%", 100.0), inside.high >= 0.997),
        ]  # fmt: skip
        facts.append({"what": what, "rmse_ratio": plain(cost), "within_3_sigma": plain(inside), "worst_sigmas": worst})
    heads = ("bias", "tracks", "runs", "RMSE with / without", "estimate within 3 sigma [%]", "worst [sigma]")
    return [Table("Bias, paired runs; geometric mean over tracks", heads, tuple(rows))], verdicts, facts


def _wrong(groups: dict[str, list[CaseRuns]]) -> Part:
    """Accuracy, NEES and losses under a wrong model."""
    rows, verdicts, facts = [], [], []
    for what, cases in groups.items():
        runs = sum(one.runs for one in cases)
        rmse = of_runs(cases, "mse_m2", _root_mean)
        nees, within = of_runs(cases, "nees", np.mean), of_runs(cases, "contained_95", np.mean)
        lost, unsaid = count(cases, "lost"), count(cases, "unsaid")
        texts = (shown(rmse, 1), shown(nees), shown(within, 1, scale=100.0), str(lost), str(unsaid))
        rows.append((what, str(len(cases)), str(runs), *texts))
        verdicts += [
            Verdict(f"{what}: runs lost unannounced", "0", str(unsaid), unsaid == 0),
            Verdict(f"{what}: NEES, mean of runs (2 is honest)", f"<= {ASKED_NEES:g}", shown(nees),
                    nees.value <= ASKED_NEES),
        ]  # fmt: skip
        facts.append({"what": what, "runs": runs, "rmse_m": plain(rmse), "nees": plain(nees), "unsaid": unsaid})
    heads = ("wrong", "tracks", "runs", "RMSE [m]", "NEES", "in 95 % [%]", "lost", "unsaid")
    return [Table("Wrong model", heads, tuple(rows))], verdicts, facts


def _kidnapped(what: str, cases: Sequence[CaseRuns]) -> Part:
    """How soon it is said, and whether the position is found again."""
    runs = sum(one.runs for one in cases)
    declared = np.concatenate([one["declared_s"] for one in cases])
    soon = clopper_pearson(int(np.sum(declared <= ASKED_DECLARED_S)), runs)
    found = clopper_pearson(count(cases, "found"), runs)
    near = clopper_pearson(count(cases, "near"), runs)
    found_s = np.concatenate([one["found_s"] for one in cases])
    unsaid = count(cases, "unsaid")
    row = (
        str(len(cases)), str(runs), shown(soon, 0, scale=100.0), f"{_middle(declared):.0f}", f"{declared.max():.0f}",
        shown(near, 0, scale=100.0), shown(found, 0, scale=100.0), f"{_middle(found_s):.0f}", str(unsaid),
    )  # fmt: skip
    heads = (
        "tracks", "runs", "lost in 60 s [%]", "median [s]", "latest [s]", "near [%]", "found [%]",
        "median [s]", "unsaid",
    )  # fmt: skip
    verdicts = [
        Verdict(f"{what}: lost is declared within {ASKED_DECLARED_S:g} s of readings", "100 %",
                shown(soon, 1, "%", 100.0), soon.value == 1.0),
        Verdict(f"{what}: the position is found again", "100 %", shown(found, 1, "%", 100.0), found.value == 1.0),
    ]  # fmt: skip
    fact = {"what": what, "runs": runs, "declared_in_time": plain(soon), "found": plain(found)}
    fact |= {"near": plain(near), "unsaid": unsaid}
    return [Table("Kidnapped: the INS jumps 5 km in mid-flight", heads, (row,))], verdicts, [fact]


def _smoothed(what: str, cases: Sequence[CaseRuns]) -> Part:
    """RMSE of the smoother over that of the filter before the first fix."""
    with_fix = [one for one in cases if one.runs and one["before_fix"].sum() > 0.0]
    if not with_fix:
        return [], [Verdict(f"{what}: RMSE before the first fix", "-20 %", "no fix", None)], []
    kept = pooled_ratio(with_fix, "smoother_m2", "filter_m2")
    gain = Interval(1.0 - kept.value, 1.0 - kept.high, 1.0 - kept.low)
    epochs = np.concatenate([one["before_fix"] for one in with_fix])
    root = [
        float(np.sqrt(sum(one[key].sum() for one in with_fix) / epochs.sum())) for key in ("filter_m2", "smoother_m2")
    ]
    row = (
        str(len(with_fix)), str(len(epochs)), f"{np.median(epochs):.0f}", *(f"{value:.0f}" for value in root),
        shown(gain, 0, scale=100.0),
    )  # fmt: skip
    heads = ("tracks", "runs", "epochs before the fix", "filter, RMSE [m]", "smoother, RMSE [m]", "gain [%]")
    met = gain.value >= ASKED_GAIN
    verdict = Verdict(f"{what}: RMSE before the first fix, below the filter's by", ">= 20 %",
                      shown(gain, 0, "%", 100.0), met)  # fmt: skip
    fact = {"what": what, "runs": len(epochs), "gain": plain(gain)}
    return [Table("Smoothing before the first fix; gain: geometric mean over tracks", heads, (row,))], [verdict], [fact]


def _root_mean(values: FloatArray, axis: Any = None) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(values, axis=axis)))


def _middle(values: FloatArray) -> float:
    """Median where infinity is 'never'; infinite when that is half of them."""
    return float(np.sort(values)[len(values) // 2])
