"""Result: the estimates of one run with the truth, the metrics and where they came from; saves and loads."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav.core.checks import finite
from terranav.core.earth import offset_m
from terranav.core.errors import DataError
from terranav.core.recording import Recording
from terranav.core.records import Estimate, FloatArray, Posterior, Status
from terranav.experiment import metrics

_FORMAT = "terranav-result-1"
_PLAIN = ("time_s", "lat_deg", "lon_deg", "alt_m", "status", "nis", "indicated_lat_deg", "indicated_lon_deg")
_TRUTH = ("true_lat_deg", "true_lon_deg")


@dataclass(frozen=True, eq=False)
class Result:
    """The estimates of one run.

    Attributes
    ----------
    estimator : str
        Name of the method.
    time_s : (n,) [s]
    lat_deg, lon_deg : (n,) [deg]
        Corrected position.
    alt_m : (n,) [m]
        Indicated altitude.
    status : (n,) array of str
        Values of `Status`.
    ins_error_m : (n, 2) [m]
        Estimated INS position error, north and east.
    cov_m2 : (n, 2, 2) [m^2]
        Its claimed covariance.
    nis : (n,)
        Normalised innovation squared, NaN where the method has none.
    indicated_lat_deg, indicated_lon_deg : (n,) [deg]
        What the INS said.
    true_lat_deg, true_lon_deg : (n,) [deg] or None
        NaN where the truth is unknown.
    posterior : Posterior or None
        What the method believed at the last epoch, for pictures.
    map_cell_m : float
        Cell size of the finest map, NaN without maps [m].
    provenance : dict
        Versions, seed, settings, checksums, and what was assumed (plain JSON values). 'wall_s', 'command' and
        'platform' say how this run went; the rest is what it takes to make it again.
    name : str
        Of the recording.
    protection_m : (n,) [m]
        Horizontal protection level, NaN where no integrity monitor watched.
    usable : (n,) bool
        Whether the position was offered as a fix; False where none watched.
    reasons : n tuples of texts
        Why each status is what it is, and why a fix was withheld. These three may be left empty: nobody watched.
    """

    estimator: str
    time_s: FloatArray
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_m: FloatArray
    status: NDArray[np.str_]
    ins_error_m: FloatArray
    cov_m2: FloatArray
    nis: FloatArray
    indicated_lat_deg: FloatArray
    indicated_lon_deg: FloatArray
    true_lat_deg: FloatArray | None = None
    true_lon_deg: FloatArray | None = None
    posterior: Posterior | None = None
    map_cell_m: float = math.nan
    provenance: dict[str, Any] = field(default_factory=dict)
    name: str = "recording"
    protection_m: FloatArray = field(default_factory=lambda: np.empty(0))
    usable: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    reasons: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        if len(self.protection_m) == 0:
            object.__setattr__(self, "protection_m", np.full(len(self), np.nan))
        if len(self.usable) == 0:
            object.__setattr__(self, "usable", np.zeros(len(self), dtype=np.bool_))
        if len(self.reasons) == 0:
            object.__setattr__(self, "reasons", ((),) * len(self))

    @classmethod
    def from_estimates(cls, estimator: str, estimates: Sequence[Estimate], rec: Recording, **rest: Any) -> Result:
        """Collect the estimates of every epoch of a recording.

        Parameters
        ----------
        estimator : str
            Name of the method.
        estimates : sequence of Estimate
            One per epoch of `rec`.
        rec : Recording
            Gives the indicated and, where known, the true positions.
        **rest
            posterior, map_cell_m, provenance.
        """
        true_lat_deg, true_lon_deg = (rec.columns[key] if rec.has_truth else None for key in _TRUTH)
        return cls(
            estimator=estimator,
            time_s=np.array([e.time_s for e in estimates]),
            lat_deg=np.array([e.lat_deg for e in estimates]),
            lon_deg=np.array([e.lon_deg for e in estimates]),
            alt_m=np.array([e.alt_m for e in estimates]),
            status=np.array([e.status.value for e in estimates], dtype=np.str_),
            ins_error_m=np.array([e.ins_error_m for e in estimates]),
            cov_m2=np.array([e.cov_m2 for e in estimates]),
            nis=np.array([e.nis for e in estimates]),
            indicated_lat_deg=rec.lat_deg,
            indicated_lon_deg=rec.lon_deg,
            true_lat_deg=true_lat_deg,
            true_lon_deg=true_lon_deg,
            name=rec.name,
            protection_m=np.array([e.protection_m for e in estimates], dtype=np.float64),
            usable=np.array([e.usable for e in estimates], dtype=np.bool_),
            reasons=tuple(e.reasons for e in estimates),
            **rest,
        )

    def __len__(self) -> int:
        return int(self.time_s.size)

    @property
    def has_truth(self) -> bool:
        """Whether the true position is known at any epoch."""
        return self.true_lat_deg is not None and bool(np.isfinite(self.true_lat_deg).any())

    @property
    def watched(self) -> bool:
        """Whether an integrity monitor gave a protection level at any epoch."""
        return not bool(np.isnan(self.protection_m).all())

    @property
    def error_m(self) -> FloatArray:
        """(n, 2) estimate minus truth, north and east [m]; NaN where the truth is unknown."""
        return self._minus_truth(self.lat_deg, self.lon_deg)

    @property
    def indicated_error_m(self) -> FloatArray:
        """(n, 2) INS-indicated minus true position, north and east [m]; NaN where the truth is unknown."""
        return self._minus_truth(self.indicated_lat_deg, self.indicated_lon_deg)

    def metrics(
        self, since_s: float = 0.0, match_m: float | None = None, *, after_first_fix: bool = False
    ) -> dict[str, float]:
        """Figures of the run.

        Parameters
        ----------
        since_s : float
            Leave out the epochs before this many seconds from the start [s].
        match_m : float, optional
            Largest error that counts as a match; sqrt(2) cells of the finest map unless given (papers/004) [m].
        after_first_fix : bool
            Also leave out the epochs before the first 'converged' one; without a fix no epoch is left.

        Returns
        -------
        dict
            n, drms_m, cep_m, r95_m, mean_m, max_m, final_m, match_rate (see `metrics.accuracy`), nees, nees_per_axis,
            contained_95 (see `metrics.consistency`), available, protection_m, misleading (see `metrics.integrity`),
            lost_s (time with status 'lost'), and first_fix_s, which always counts from the start of the run. Without
            truth the accuracy figures are NaN and n is 0.
        """
        start_s = finite("since_s", since_s, minimum=0.0)
        first_fix_s = metrics.first_fix_s(self.time_s, self.status)
        if after_first_fix:
            start_s = math.inf if math.isnan(first_fix_s) else max(start_s, first_fix_s)
        limit_m = math.sqrt(2.0) * self.map_cell_m if match_m is None else finite("match_m", match_m, above=0.0)
        kept = self.time_s - self.time_s[0] >= start_s
        figures = {
            **metrics.accuracy(self.error_m[kept], limit_m),
            **metrics.consistency(self.error_m[kept], self.cov_m2[kept]),
            **metrics.integrity(self.error_m[kept], self.protection_m[kept], self.usable[kept]),
            "first_fix_s": first_fix_s,
            "lost_s": metrics.time_with_status_s(self.time_s[kept], self.status[kept], Status.LOST),
        }
        if math.isnan(limit_m):
            figures["match_rate"] = math.nan
        return figures

    def digest(self) -> str:
        """SHA-256 over the arrays: equal for two runs exactly when they agree to the bit."""
        digest = hashlib.sha256(self.estimator.encode())
        posterior = self.posterior
        grids = [] if posterior is None else [posterior.north_m, posterior.east_m, posterior.weight]
        for array in (*self._columns().values(), *grids):
            digest.update(f"{array.dtype.kind}{array.shape}".encode())
            digest.update("\0".join(array.tolist()).encode() if array.dtype.kind == "U" else array.tobytes())
        digest.update(json.dumps(self._distinct_reasons).encode())
        return digest.hexdigest()

    def save(self, path: str | Path) -> None:
        """Write one self-contained Parquet file that `load` reads back exactly.

        Raises
        ------
        DataError
            When the file cannot be written.
        """
        from terranav.io.results import write_result_table

        facts = {
            "format": _FORMAT,
            "estimator": self.estimator,
            "name": self.name,
            "map_cell_m": None if math.isnan(self.map_cell_m) else self.map_cell_m,
            "provenance": self.provenance,
            "reasons": self._distinct_reasons,
        }
        metadata = {"terranav": json.dumps(facts).encode()}
        if self.posterior is not None:
            metadata |= {f"posterior_{key}": _npy(getattr(self.posterior, key)) for key in Posterior.__slots__}
        write_result_table(path, self._columns(), metadata)

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """Read a result that `save` wrote.

        Raises
        ------
        DataError
            When the file is missing, damaged, or not a saved result.
        """
        from terranav.io.results import read_result_table

        columns, metadata = read_result_table(path)
        try:
            facts = json.loads(metadata["terranav"])
            if facts["format"] != _FORMAT:
                raise DataError(f"{path}: the format is {facts['format']!r}, expected {_FORMAT!r}")
            cell_m = facts["map_cell_m"]
            arrays: dict[str, Any] = {key: columns[key] for key in _PLAIN}
            return cls(
                estimator=facts["estimator"],
                **arrays | {key: columns[key] for key in _TRUTH if key in columns},
                ins_error_m=np.stack([columns["ins_error_north_m"], columns["ins_error_east_m"]], axis=1),
                cov_m2=np.stack([columns[key] for key in _COVARIANCE], axis=1).reshape(-1, 2, 2),
                posterior=_posterior(metadata),
                map_cell_m=math.nan if cell_m is None else cell_m,
                provenance=facts["provenance"],
                name=facts["name"],
                **_integrity(columns, facts.get("reasons", [])),
            )
        except KeyError as error:
            raise DataError(f"{path}: {error.args[0]} is missing, expected a result saved by terranav") from None

    def _minus_truth(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """(n, 2) position minus truth [m]."""
        if self.true_lat_deg is None or self.true_lon_deg is None:
            return np.full((len(self), 2), np.nan)
        return np.stack(offset_m(self.true_lat_deg, self.true_lon_deg, lat_deg, lon_deg), axis=1)

    @property
    def _distinct_reasons(self) -> list[list[str]]:
        """Every set of reasons that occurs, in the order in which they came up; the file's column counts in these."""
        return [list(told) for told in dict.fromkeys(self.reasons)]

    def _columns(self) -> dict[str, NDArray[Any]]:
        """Every array of one value per epoch, as the columns of the saved file."""
        columns: dict[str, NDArray[Any]] = {key: getattr(self, key) for key in _PLAIN}
        columns |= {"ins_error_north_m": self.ins_error_m[:, 0], "ins_error_east_m": self.ins_error_m[:, 1]}
        columns |= dict(zip(_COVARIANCE, self.cov_m2.reshape(-1, 4).T, strict=True))
        columns |= {key: getattr(self, key) for key in _TRUTH if getattr(self, key) is not None}
        code = {told: float(i) for i, told in enumerate(dict.fromkeys(self.reasons))}
        columns |= {
            "protection_m": self.protection_m,
            "usable": self.usable.astype(np.float64),
            "reasons": np.array([code[told] for told in self.reasons], dtype=np.float64),
        }
        return {key: np.ascontiguousarray(value) for key, value in columns.items()}


_COVARIANCE = ("cov_nn_m2", "cov_ne_m2", "cov_en_m2", "cov_ee_m2")


def _integrity(columns: dict[str, NDArray[Any]], reasons: list[list[str]]) -> dict[str, Any]:
    """What the integrity monitor said, from the columns of a saved result; nothing where the file is older."""
    if "protection_m" not in columns:
        return {}
    distinct = [tuple(told) for told in reasons]
    return {
        "protection_m": columns["protection_m"],
        "usable": columns["usable"] != 0.0,
        "reasons": tuple(distinct[int(code)] for code in columns["reasons"].tolist()),
    }


def _npy(array: FloatArray) -> bytes:
    """An array as the bytes of a .npy file."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def _posterior(metadata: dict[str, bytes]) -> Posterior | None:
    """Read the posterior back from the metadata of a saved result."""
    if "posterior_weight" not in metadata:
        return None
    north, east, weight = (
        np.load(io.BytesIO(metadata[f"posterior_{key}"]), allow_pickle=False) for key in ("north_m", "east_m", "weight")
    )
    return Posterior(north, east, weight)
