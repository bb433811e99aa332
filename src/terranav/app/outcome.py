"""What one command found: a recording, the maps, and the result of each estimator, with the figures people ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import offset_m
from terranav.core.errors import StateError, TerranavError

if TYPE_CHECKING:
    from terranav.core.ins_grade import InsGrade
    from terranav.core.recording import Recording
    from terranav.core.records import Prior
    from terranav.experiment.result import Result
    from terranav.maps.map import Map
    from terranav.planning.bound import Bound

FloatArray = NDArray[np.float64]

BASELINE = "ins"
NAVIGATOR = "marginalized"
_OF_READINGS = ("bias_sigma", "outlier_share", "outlier_scale", "blur_cells")
#: sqrt of the 95 % quantile of chi-square with two degrees of freedom: half an axis of the 95 % ellipse over its sigma
ELLIPSE_95 = math.sqrt(-2.0 * math.log(0.05))


@dataclass(frozen=True)
class Outcome:
    """A run of one or more estimators over one recording.

    Attributes
    ----------
    recording : Recording
    maps : tuple of Map
    results : mapping of estimator name to Result, in the order asked for
    ins : InsGrade
        What the estimators were told of the INS.
    seed : int
    since_s : float
        Seconds at the start that the metrics leave out.
    command : str
        As it was typed, for the report.
    asked : str
        The estimator that `run` was asked for; empty to let the most accurate one stand for all.
    """

    recording: Recording
    maps: tuple[Map, ...]
    results: Mapping[str, Result]
    ins: InsGrade
    seed: int = 0
    since_s: float = 0.0
    command: str = ""
    asked: str = ""
    _cache: dict[str, dict[str, float]] = field(default_factory=dict, repr=False, compare=False)

    @cached_property
    def main(self) -> str:
        """The estimator that the verdict and the pictures are about."""
        if self.asked:
            return self.asked
        aided = [name for name in self.results if name != BASELINE] or list(self.results)

        def rank(name: str) -> tuple[bool, float]:
            drms = self.metrics(name)["drms_m"]
            return (math.isnan(drms), drms)

        return min(aided, key=rank)

    @property
    def duration_s(self) -> float:
        """From the first epoch to the last [s]."""
        return float(self.recording.time_s[-1] - self.recording.time_s[0])

    def metrics(self, name: str) -> dict[str, float]:
        """`Result.metrics` of one estimator, the first `since_s` seconds left out, and bound_drms_m over the same."""
        if name not in self._cache:
            figures = self.results[name].metrics(since_s=self.since_s)
            self._cache[name] = {**figures, "bound_drms_m": self.bound_drms_m(self.since_s)}
        return self._cache[name]

    def metrics_after_fix(self, name: str) -> dict[str, float]:
        """The same from the estimator's first fix on; NaN when there was none."""
        key = f"{name} after its fix"
        if key not in self._cache:
            figures = self.results[name].metrics(since_s=self.since_s, after_first_fix=True)
            since_s = float(np.maximum(self.since_s, figures["first_fix_s"]))  # NaN when there was none
            self._cache[key] = {**figures, "bound_drms_m": self.bound_drms_m(since_s)}
        return self._cache[key]

    @cached_property
    def bound(self) -> Bound | None:
        """Cramer-Rao bound along the true track; None where there is none to compute, as without truth."""
        from terranav.planning.bound import bound

        try:
            return bound(self.recording, self.maps, self.ins, prior=self._prior, **self._noise_settings)
        except TerranavError:
            return None

    @property
    def _prior(self) -> Prior | None:
        """What the estimators were told of the error at the start, from what the results keep."""
        from terranav.core.records import Prior

        told = next(
            (result.provenance["prior"] for result in self.results.values() if "prior" in result.provenance), None
        )
        return None if told is None else Prior(**told)

    @property
    def _noise_settings(self) -> dict[str, Any]:
        """What `marginalized` was told of the readings, if it was among the estimators: the bound is of its model."""
        for label in sorted(self.results, key=lambda one: one != self.asked):
            made = self.results[label].provenance.get("estimator") or {}
            if made.get("name") == NAVIGATOR:
                told = made.get("settings") or {}
                told = told.get("estimator", told)  # within its integrity monitor
                return {key: told[key] for key in _OF_READINGS if key in told}
        return {}

    def bound_drms_m(self, since_s: float) -> float:
        """Least DRMS that an estimator could have from so many seconds after the start on [m], NaN without a bound."""
        if self.bound is None:
            return math.nan
        time_s = self.recording.time_s
        later = self.bound.drms_m[(time_s - time_s[0] >= since_s) & np.isfinite(self.ins_distance_m)]
        return float(np.sqrt(np.mean(later**2))) if later.size else math.nan

    @cached_property
    def watched(self) -> bool:
        """Whether an integrity monitor watched any estimator."""
        return any(result.watched for result in self.results.values())

    def first_fix_s(self, name: str) -> float:
        """Seconds from the start to the first converged epoch, NaN when there is none."""
        return float(self.metrics(name)["first_fix_s"])

    def final_error_m(self, name: str) -> float:
        """Distance of the last estimate from the truth [m], NaN when it is not known."""
        return float(np.hypot(*self.results[name].error_m[-1]))

    def final_claim_m(self, name: str) -> float:
        """Half the long axis of the last claimed 95 % ellipse [m]."""
        return ELLIPSE_95 * float(np.sqrt(np.linalg.eigvalsh(self.results[name].cov_m2[-1])[-1]))

    def final_correction_m(self, name: str) -> float:
        """How far the last estimate moved the indicated position [m]."""
        return float(np.hypot(*self.results[name].ins_error_m[-1]))

    def status_at_end(self, name: str) -> str:
        """Status of the last epoch."""
        return str(self.results[name].status[-1])

    @cached_property
    def ins_distance_m(self) -> FloatArray:
        """(n,) distance of the indicated from the true position [m], NaN where it is not known."""
        try:
            north, east = self.recording.ins_error_m().T
        except StateError:
            return np.full(len(self.recording), np.nan)
        return np.asarray(np.hypot(north, east))

    def ins_r95_m(self, since_s: float) -> float:
        """95th percentile of the INS error from so many seconds after the start on [m], NaN where it is not known."""
        time_s = self.recording.time_s
        later = self.ins_distance_m[time_s - time_s[0] >= since_s]
        later = later[np.isfinite(later)]
        return float(np.percentile(later, 95.0)) if later.size else math.nan

    @property
    def initial_ins_error_m(self) -> float:
        """Distance of the first indicated position from the true one [m]."""
        return float(self.ins_distance_m[0])

    @property
    def final_ins_error_m(self) -> float:
        """Distance of the last indicated position from the true one [m]."""
        return float(self.ins_distance_m[-1])

    @cached_property
    def track_km(self) -> float:
        """Length of the track, true where that is known [km]."""
        columns = self.recording.columns
        prefix = "true_" if self.recording.has_truth else ""
        lat, lon = columns[f"{prefix}lat_deg"], columns[f"{prefix}lon_deg"]
        known = np.isfinite(lat) & np.isfinite(lon)
        lat, lon = lat[known], lon[known]
        return float(np.hypot(*offset_m(lat[:-1], lon[:-1], lat[1:], lon[1:])).sum() / 1000.0)

    def readings_of(self, kind: str) -> tuple[FloatArray, FloatArray]:
        """Times [s] and values [the map's unit and sign] of what was measured of a kind, raw readings made ready."""
        from terranav.sensors.ready import ready

        found = [
            (epoch.time_s, reading.value)
            for epoch in ready(self.recording.epochs())
            for reading in epoch.measurements
            if reading.kind == kind
        ]
        times, values = np.array(found).reshape(-1, 2).T
        return times, values

    def as_json(self) -> dict[str, Any]:
        """Everything a machine wants to know of the outcome; the arrays are in the result files."""
        from terranav import __version__
        from terranav.app import reasons
        from terranav.app.words import verdict

        return {
            "terranav": __version__,
            "command": self.command,
            "verdict": verdict(self),
            "recording": {
                "name": self.recording.name,
                "epochs": len(self.recording),
                "duration_s": self.duration_s,
                "track_km": self.track_km,
                "has_truth": self.recording.has_truth,
                "readings": list(self.recording.readings),
            },
            "maps": [described(entry) for entry in self.maps],
            "ins": vars(self.ins),
            "seed": self.seed,
            "since_s": self.since_s,
            "estimator": self.main,
            "metrics": self.metrics(self.main),
            "estimators": {
                name: {
                    **self.metrics(name),
                    "final_m": self.final_error_m(name),
                    "after_fix": self.metrics_after_fix(name),
                    "final_95_m": self.final_claim_m(name),
                    "status": self.status_at_end(name),
                    "reasons": reasons.as_json(self.results[name]),
                }
                for name in self.results
            },
        }


def described(entry: Map) -> dict[str, Any]:
    """What identifies a map, for people and machines."""
    return {
        "name": entry.name,
        "kind": entry.kind,
        "unit": entry.unit,
        "rows": entry.shape[0],
        "cols": entry.shape[1],
        "cell_m": entry.cell_m,
        "sigma": entry.sigma,
        "source": entry.source,
        "checksum": entry.checksum,
    }
