"""E_H against slope: Table 2 and Figure 6 of papers/003, and eq. 5.

E_H is taken over 10 points, as the paper's 'maximum of EH ... with 10 points': eq. 5 with W = 10 then gives its Table 2
within a factor of two, and with W = 1 a tenth of it. The estimated trace is taken to be the true one ('it is assumed
that the estimated trace is not far from the actual').
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.experiment.papers._p003_world import DEGREE_M, STEP_S, Land, flight, track
from terranav.experiment.papers.outcome import Claim, Figure, Series, Table, Verdict
from terranav.kernels.contours import nearest_points

FloatArray = NDArray[np.float64]

POINTS, SAMPLES, FLIGHTS = 10, 41, 20
SHARES = (0.35, 0.5, 0.65)  # of the map's extent from the south: three traces a map
REACH_M = 3000.0
LEAST_SLOPE = 0.003  # the least of the paper's Table 2
#: Table 2: slope from, to, mean, mean height error [m], mean E_H [deg]
PAPER = (
    ("paper 1/1", 0.01, 0.2, 0.1, 3.0, 0.003),
    ("paper 1/2", 0.0078, 0.2, 0.0841, 3.0, 0.0032),
    ("paper 1/3", 0.0264, 0.2456, 0.1348, 3.0, 0.002),
    ("paper 2/1", 0.1158, 0.3225, 0.2068, 3.0, 0.0012),
    ("paper 3/1", 0.0041, 0.7016, 0.2464, 5.0, 0.0016),
    ("paper 3/2", 0.0037, 0.7234, 0.3043, 5.0, 0.0009),
)


@dataclass(frozen=True)
class Row:
    """One trace: slope, mean height error [m], and E_H (samples,) of one point each, its mean over flights [deg]."""

    name: str
    slope: FloatArray
    height_m: float
    contour_deg: FloatArray

    @property
    def mean_deg(self) -> float:
        """Mean E_H of 10 points."""
        return POINTS * float(self.contour_deg.mean())

    @property
    def reciprocal(self) -> FloatArray:
        """(samples,) 1/slope; level ground counts as LEAST_SLOPE."""
        return np.asarray(1.0 / np.maximum(self.slope, LEAST_SLOPE))

    @property
    def expected_deg(self) -> float:
        """Eq. 5 with K = 1 and W = 10."""
        return POINTS * self.height_m / float(self.slope.mean()) / DEGREE_M


def slopes(places: list[Land], seed: int) -> list[Row]:
    """Three traces a map, each flown 20 times."""
    rows = []
    for i, land in enumerate(places):
        for j, share in enumerate(SHARES):
            way = track(land, SAMPLES, share)
            rng = np.random.default_rng([seed, 3, i, j])
            frame = land.chart.local_frame(float(way.lat_deg[0]), float(way.lon_deg[SAMPLES // 2]))
            metric = np.linalg.inv(np.array([frame.row[1:3], frame.col[1:3]]))
            row, col = land.chart.cells(way.lat_deg, way.lon_deg)
            near, errors = np.empty((FLIGHTS, SAMPLES, 3)), []
            for k in range(FLIGHTS):
                error = flight(way, rng).height_error_m
                nearest_points(land.chart.values, row, col, way.ground_m + error, metric, REACH_M, near[k])
                errors.append(error)
            distance = np.where(np.isnan(near[..., 0]), REACH_M, near[..., 0])
            mean_height = float(np.nanmean(np.abs(errors)))
            rows.append(Row(f"{land.name}/{j + 1}", way.slope, mean_height, distance.mean(axis=0) / DEGREE_M))
    return rows


def slope_table(rows: list[Row]) -> Table:
    """Table 2, the paper's rows first."""
    lines = [
        (
            name,
            f"{low:.4f}~{high:.4f}",
            f"{mean:.4f}",
            f"{error:.1f}",
            f"{10 * error / mean / DEGREE_M:.4f}",
            f"{e_h:.4f}",
        )
        for name, low, high, mean, error, e_h in PAPER
    ]
    for row in rows:
        bound = f"{row.slope.min():.4f}~{row.slope.max():.4f}"
        figures = (f"{row.slope.mean():.4f}", f"{row.height_m:.1f}", f"{row.expected_deg:.4f}", f"{row.mean_deg:.4f}")
        lines.append((row.name, bound, *figures))
    columns = ("map/trace", "slope", "mean slope", "mean height error [m]", "E_H by eq. 5 [deg]", "mean E_H [deg]")
    return Table("Table 2: E_H of 10 points against slope", columns, tuple(lines))


def slope_claim(rows: list[Row]) -> Claim:
    """E_H grows with the reciprocal of the slope."""
    along = [_correlation(row.contour_deg, row.reciprocal) for row in rows]
    scale = [row.mean_deg / row.height_m for row in rows]
    between = _correlation(np.array(scale), np.array([1.0 / row.slope.mean() for row in rows]))
    ratio = [row.mean_deg / row.expected_deg for row in rows]
    good = between > 0.8 and min(along) > 0.5
    ours = (
        f"correlation of ranks {min(along):.2f}..{max(along):.2f} along the traces, {between:.2f} between traces; mean "
        f"E_H is {min(ratio):.2f}..{max(ratio):.2f} times eq. 5"
    )
    why = (
        "eq. 5 divides the means; the mean of the quotients is larger, because level stretches (valley floors, tops) "
        "weigh most in it"
    )
    verdict: Verdict = (
        "holds" if good else ("holds in part" if between > 0.5 or np.median(along) > 0.5 else "does not hold")
    )
    text = "E_H correlates strongly with 1/slope (Figure 6, Table 2, eq. 5)"
    return Claim(text, "0.0032 at slope 0.08 to 0.0009 at 0.30", ours, verdict, why)


def slope_figures(rows: list[Row]) -> list[Figure]:
    """Figure 6, and Table 2 as a picture."""
    middle = rows[min(1, len(rows) - 1)]
    time_s = STEP_S * np.arange(middle.slope.size, dtype=np.float64)
    curve = Series("E_H of a point", time_s, middle.contour_deg)
    factor = float(middle.contour_deg.mean() / middle.reciprocal.mean())
    scaled = Series("1/slope, scaled to the same mean", time_s, factor * middle.reciprocal)
    ours = Series("here", np.array([row.slope.mean() for row in rows]), np.array([row.mean_deg for row in rows]))
    paper = Series("paper", np.array([row[3] for row in PAPER]), np.array([row[5] for row in PAPER]))
    title = f"Figure 6: E_H and the reciprocal of the slope, {middle.name}"
    return [
        Figure("e_h_along", title, "time [s]", "E_H [deg]", (curve, scaled)),
        Figure("e_h_slope", "Table 2: E_H of 10 points", "mean slope", "E_H [deg]", (ours, paper), "points"),
    ]


def _correlation(x: FloatArray, y: FloatArray) -> float:
    """Spearman's correlation of ranks."""
    ranks = np.array([np.argsort(np.argsort(values)) for values in (x, y)], dtype=np.float64)
    return float(np.asarray(np.corrcoef(ranks))[0, 1])
