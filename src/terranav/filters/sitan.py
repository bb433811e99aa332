"""SITAN: an extended Kalman filter of the two horizontal INS position errors with stochastic linearisation.

Hostetler and Andreas, Nonlinear Kalman Filtering Techniques for Terrain-Aided Navigation, IEEE Trans. AC-28 (1983), and
Hostetler, Optimal Terrain-Aided Navigation Systems (1978), reference 2 of papers/000. Over the region where the error
may lie, a plane is fitted to the map by least squares,

    h(x) = z + g (x - m) + r,    z level, g slope (per metre of error), r what the plane leaves, E r^2 = R_fit

and a reading y updates mean m and covariance P as in a Kalman filter with h linear and R = sensor^2 + map^2 + R_fit:

    S = g P g' + R,  K = P g' / S,  m + K (y - z),  (I - K g) P (I - K g)' + K R K'   (Joseph's form)

What a plane leaves is no white noise along the track: readings closer together than the region is wide meet the same
hill. So R_fit counts once for all readings within one sigma of the error on the ground; on the sample map that takes
successful starts from 200 m and 500 m from 2 in 10 to 6 in 10. On a plane R_fit is zero and this is the Kalman filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from terranav.core.earth import shift
from terranav.core.records import Epoch
from terranav.filters._kalman import Linearised, Plane
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]

# 5 x 5 places from -1.5 to 1.5 sigma along the axes of the error ellipse: their variance is 1.125 sigma^2, about that
# of the error itself, so that the fit is the one over its distribution
_STEPS = np.linspace(-1.5, 1.5, 5)
PATTERN = np.stack(np.meshgrid(_STEPS, _STEPS), axis=-1).reshape(-1, 2)
LEAST_PLACES = 13  # more than half of the 25 must have a map value


@dataclass(frozen=True)
class Sitan(Linearised):
    """SITAN filter.

    It tracks; it does not acquire. Where the initial error spans several hills no plane describes the map: the fit's
    residual then all but switches the readings off (the status stays 'searching'), or the filter settles in a wrong
    valley, which the NIS betrays only once readings contradict it ('degraded', 'lost'). Then it starts over from the
    initial prior and the drift since. papers/000 shows it diverge; use it from a few hundred metres at most, or after a
    fix of another method.

    Attributes
    ----------
    maps : tuple of Map
        One a kind; readings of several kinds at one epoch are used one after the other.
    ins : InsGrade
        How fast the position error grows (`InsGrade.position_growth_m2`).
    gate_sigma : float or None
        A reading further from its prediction than this many sigmas is not used (but judged); None uses all.
    restart : bool
        Start over when lost; without, the filter stays where it is and goes on, as its first publications had it.
    converged_sigma_m : float or None
        1-sigma (largest axis) that counts as a fix; None is the finest map's cell.

    Raises
    ------
    ConfigError
        For a setting out of its range, or two maps of one kind.
    """

    name = "sitan"

    def linearised(self, chart: Map, epoch: Epoch, mean_m: FloatArray, cov_m2: FloatArray) -> tuple[Plane | None, bool]:
        """The plane of `fitted_plane`; off the map where there is none."""
        plane = fitted_plane(chart, epoch, mean_m, cov_m2)
        return plane, plane is None


def fitted_plane(chart: Map, epoch: Epoch, mean_m: FloatArray, cov_m2: FloatArray) -> Plane | None:
    """Least-squares plane through the map over the region where the error may lie; None where the map says nothing.

    Parameters
    ----------
    chart : Map
    epoch : Epoch
        Its indicated position, less an error, is a place on the map.
    mean_m, cov_m2 : (2,) [m], (2, 2) [m^2]
        Of the error. The region reaches at least half a map cell along each axis of the ellipse.
    """
    variance, axes = np.linalg.eigh(cov_m2)
    reach = np.maximum(np.sqrt(np.maximum(variance, 0.0)), 0.5 * chart.cell_m / _STEPS[-1])
    off = (PATTERN * reach) @ axes.T
    error = mean_m + off
    value = chart.sample(*shift(epoch.lat_deg, epoch.lon_deg, -error[:, 0], -error[:, 1]))
    known = np.isfinite(value)
    count = int(known.sum())
    if count < LEAST_PLACES:
        return None
    scale = float(reach.max())
    design = np.column_stack([np.ones(count), off[known] / scale])
    solution, *_ = np.linalg.lstsq(design, value[known], rcond=None)
    rest = value[known] - design @ solution
    return Plane(float(solution[0]), solution[1:] / scale, float(rest @ rest) / (count - 3))
