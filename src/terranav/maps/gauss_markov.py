"""Second-order Gauss-Markov processes and fields by Van Loan's method: the terrain and the motion of papers/001.

Power spectrum and autocorrelation (papers/001 eq. 1, whose print has lost the factors; Brown and Hwang, Introduction to
Random Signals and Applied Kalman Filtering, 3rd ed., section 5.6), with w the natural frequency:

    S(jw') = 2 sqrt(2) w^3 sigma^2 / (w'^4 + w^4)
    R(d) = sigma^2 exp(-w |d| / sqrt(2)) [cos(w d / sqrt(2)) + sin(w |d| / sqrt(2))]

State model (eqs. 2 and 3) x' = F x + G u, u white of unit density, x = (value, slope):

    F = [[0, 1], [-w^2, -sqrt(2) w]],  G = [0, sqrt(2 sqrt(2) w^3) sigma]'

The stationary state has the covariance diag(sigma^2, w^2 sigma^2). Van Loan, IEEE Trans. AC-23 (1978): with
exp([[-F, G G'], [0, F']] d) = [[., B], [0, C]] the transition matrix is Phi = C' and the step's noise is Q = C' B; then
x[k+1] = Phi x[k] + chol(Q) n, n standard normal (eq. 4).

A field has the covariance R(north) R(east) / sigma^2: the process along the rows and along the columns. The value alone
of eq. 4 is an ARMA(2, 1) series, which needs one normal number a cell instead of four; its coefficients follow from Phi
and Q, and it starts in its stationary distribution, so that the covariance is exact from the first cell to the last.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm, solve_discrete_lyapunov

from terranav.core.checks import finite
from terranav.core.earth import metres_per_degree
from terranav.core.errors import ConfigError
from terranav.core.kinds import kind_named
from terranav.core.memory import need
from terranav.maps.map import Map

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class GaussMarkov:
    """A stationary second-order Gauss-Markov process.

    Attributes
    ----------
    sigma : float
        1-sigma of its value [any unit], > 0.
    omega : float
        Natural frequency [rad/m] or [rad/s], > 0.

    Raises
    ------
    ConfigError
        When one is not positive and finite.
    """

    sigma: float
    omega: float

    def __post_init__(self) -> None:
        finite("gauss_markov sigma", self.sigma, above=0.0)
        finite("gauss_markov omega", self.omega, above=0.0)

    def autocorrelation(self, distance: ArrayLike) -> FloatArray:
        """R(d) of the module's docstring, of the shape of `distance` [m or s]; [unit^2]."""
        phase = self.omega * np.abs(np.asarray(distance, dtype=np.float64)) / math.sqrt(2.0)
        return np.asarray(self.sigma**2 * np.exp(-phase) * (np.cos(phase) + np.sin(phase)))

    def van_loan(self, step: float) -> tuple[FloatArray, FloatArray]:
        """Transition matrix Phi (2, 2) and noise covariance Q (2, 2) of one step [m or s] (papers/001 eqs. 2-4)."""
        w = self.omega
        dynamics = np.array([[0.0, 1.0], [-(w**2), -math.sqrt(2.0) * w]])
        noise = np.diag([0.0, 2.0 * math.sqrt(2.0) * w**3 * self.sigma**2])
        whole = expm(np.block([[-dynamics, noise], [np.zeros((2, 2)), dynamics.T]]) * step)
        transition = whole[2:, 2:].T
        covariance = transition @ whole[:2, 2:]
        return transition, 0.5 * (covariance + covariance.T)

    def profile(self, rng: Generator, count: int, step: float, *, from_rest: bool = False) -> FloatArray:
        """One realisation by eq. 4.

        Parameters
        ----------
        rng : Generator
        count : int
            Samples, >= 1.
        step : float [m or s], > 0
        from_rest : bool
            Start at value and slope zero instead of in the stationary distribution.

        Returns
        -------
        state : (count, 2)
            Value [unit] and its derivative [unit per m or s].
        """
        transition, covariance = self.van_loan(finite("gauss_markov step", step, above=0.0))
        factor = np.linalg.cholesky(covariance)
        normal = rng.standard_normal((int(finite("gauss_markov count", count, minimum=1)), 2))
        state = np.empty_like(normal)
        state[0] = 0.0 if from_rest else np.array([self.sigma, self.omega * self.sigma]) * normal[0]
        for k in range(1, len(state)):
            state[k] = transition @ state[k - 1] + factor @ normal[k]
        return state


def gauss_markov_field(
    rng: Generator, rows: int, cols: int, processes: tuple[GaussMarkov, GaussMarkov], spacing: float
) -> FloatArray:
    """A zero-mean field with the covariance R_down(rows apart) R_across(columns apart).

    Parameters
    ----------
    rng : Generator
    rows, cols : int
    processes : (down, across)
        Along a column and along a row; give one of them the sigma of the field and the other a sigma of one.
    spacing : float
        Between neighbours [m].

    Returns
    -------
    field : (rows, cols) [unit]

    Raises
    ------
    ConfigError
        When it does not fit into the memory that is left.
    """
    need(8.0 * rows * cols, f"gauss_markov field of {rows} x {cols} cells")
    out = np.empty((rows, cols))
    _fill(rng, processes, spacing, 0.0, out)
    return out


def _fill(
    rng: Generator, processes: tuple[GaussMarkov, GaussMarkov], spacing: float, mean: float, out: NDArray[Any]
) -> None:
    """Write a field, float64 or float32; all its noise comes from one number of the generator."""
    from terranav.kernels.gauss_markov import continue_field

    down, across = (_recursion(process, spacing) for process in processes)
    key = np.uint64(rng.integers(0, 2**64 - 1, dtype=np.uint64, endpoint=True))
    # the filters down the columns start in their stationary distribution, correlated along the rows like the field
    seeds = np.empty((2, out.shape[1]))
    copy = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    continue_field(key, 0, across, copy, np.zeros_like(seeds), 0.0, seeds)
    start = np.stack([down[4] * seeds[0], down[5] * seeds[0] + down[6] * seeds[1]])
    continue_field(key, 2, across, down, start, mean, out)


def gauss_markov_map(
    rng: Generator,
    *,
    sigma: float = 20.0,
    omega_rad_per_m: float = 0.01,
    spacing_m: float = 1.0,
    shape: tuple[int, int] = (5001, 5001),
    mean: float = 57.5,
    value_range: tuple[float, float] | None = None,
    kind: str = "terrain",
    centre_deg: tuple[float, float] = (0.0, 0.0),
    map_sigma: float = 0.0,
) -> Map:
    """A second-order Gauss-Markov field as a map; the defaults are the terrain of papers/001, 5 km x 5 km.

    Parameters
    ----------
    rng : Generator
    sigma : float
        1-sigma of the field [kind's unit], > 0.
    omega_rad_per_m : float [rad/m], > 0
        Natural frequency; the correlation falls to 0.66 at 1/omega, and the slope's 1-sigma is sigma omega per axis.
    spacing_m : float [m], > 0
        Between cells, along both axes at the centre.
    shape : (rows, cols), each >= 2
    mean : float [kind's unit]
    value_range : (lowest, highest) or None
        Stretch the field linearly so that its extremes are these, instead of `sigma` and `mean` [kind's unit].
    kind : str
        'terrain', 'bathymetry', 'gravity' or 'magnetic'.
    centre_deg : (latitude, longitude) [deg]
    map_sigma : float
        1-sigma of the map error that estimators are told of [kind's unit].

    Raises
    ------
    ConfigError
        Naming the setting that is out of its range, or the memory that a map of this shape needs and there is not.
    """
    spacing = finite("gauss_markov spacing_m", spacing_m, above=0.0)
    finite("gauss_markov mean", mean)
    if len(shape) != 2 or not all(isinstance(n, (int, np.integer)) and n >= 2 for n in shape):
        raise ConfigError(f"gauss_markov shape is {shape!r}, expected two whole numbers >= 2 (rows, cols)")
    if value_range is not None and not value_range[0] < value_range[1]:
        raise ConfigError(f"gauss_markov value_range is {value_range!r}, expected (lowest, highest)")
    across = GaussMarkov(sigma, omega_rad_per_m)
    processes = (GaussMarkov(1.0, omega_rad_per_m), across)
    field: NDArray[Any]
    if value_range is None:
        need(6.0 * shape[0] * shape[1], f"gauss_markov map of {shape[0]} x {shape[1]} cells")  # and two masks of it
        field = np.empty(shape, np.float32)
        _fill(rng, processes, spacing, mean, field)
        field.setflags(write=False)  # so that the map keeps it instead of a copy
    else:
        need(14.0 * shape[0] * shape[1], f"gauss_markov map of {shape[0]} x {shape[1]} cells")
        field = gauss_markov_field(rng, *shape, processes, spacing)
        low, high = float(field.min()), float(field.max())
        field *= (value_range[1] - value_range[0]) / (high - low)
        field += value_range[1] - float(field.max())
    per_lat, per_lon = (float(v) for v in metres_per_degree(centre_deg[0]))
    down, right = spacing / per_lat, spacing / per_lon
    west, north = centre_deg[1] - 0.5 * shape[1] * right, centre_deg[0] + 0.5 * shape[0] * down
    return Map(
        values=field,
        transform=(right, 0.0, west, 0.0, -down, north),
        kind=kind,
        unit=kind_named(kind).unit,
        sigma=map_sigma,
        source="second-order Gauss-Markov field",
        name="gauss_markov",
    )


def _recursion(process: GaussMarkov, step: float) -> FloatArray:
    """(7,) a1, a2, b0, b1, l11, l21, l22 for `continue_field`: the value of eq. 4 as an ARMA(2, 1) series.

    By Cayley and Hamilton u[k] = y[k] - tr(Phi) y[k-1] + det(Phi) y[k-2] hears of two steps of noise only, and is the
    moving average b0 e[k] + b1 e[k-1] with the same two covariances (the invertible one of the two solutions).
    """
    transition, noise = process.van_loan(step)
    a1, a2 = float(np.trace(transition)), -float(np.linalg.det(transition))
    # u[k] = h n[k] + h (Phi - tr Phi) n[k-1], with h = (1, 0) and n ~ N(0, Q)
    late = transition[0] - a1 * np.array([1.0, 0.0])
    at_zero = float(noise[0, 0] + late @ noise @ late)
    at_one = float(late @ noise[:, 0])
    b0 = math.sqrt(0.5 * (at_zero + math.sqrt(max(at_zero**2 - 4.0 * at_one**2, 0.0))))
    b1 = at_one / b0
    # state (s1, s2) of the filter: s' = A s + g e
    a = np.array([[a1, 1.0], [a2, 0.0]])
    g = np.array([a1 * b0 + b1, a2 * b0])
    factor = np.linalg.cholesky(solve_discrete_lyapunov(a, np.outer(g, g)))
    return np.array([a1, a2, b0, b1, factor[0, 0], factor[1, 0], factor[1, 1]])
