"""What the latest readings of one kind were against the map, and what that says.

A normalised innovation squared (NIS) is chi-square with one degree of freedom when all is as told, so the mean of n is
chi-square with n degrees of freedom over n (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking
and Navigation, 2001, section 5.4). One gross error in a window must not speak for the place, so readings are said to
contradict the map when two tests fail at once: the mean, and the number beyond two sigma, which is binomial. That
number is judged as if one reading in ten were so far out, where a normal error has one in twenty-two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc, chdtri  # scipy.stats takes longer to load than a short flight to fly

from terranav.core.records import Epoch, Innovation
from terranav.kernels import integrity as kernels

FloatArray = NDArray[np.float64]

LENGTHS = (8, 20, 60)  # readings; the shortest sees a jump, the longest a sigma that is a little too small
LONGEST = LENGTHS[-1]
CAP = 100.0  # one NIS counts for no more
CLIP = 9.0  # or, where a gross error shall not weigh, no more than this
ALLOWED = 0.1  # share of readings beyond two sigma that is taken for healthy
STUCK = 8  # the same value so many times is a sensor that hangs, if the map varies
LAGS = 4
RESIDUAL, VARIANCE, NOISE, VALUE = range(4)
PLACE, CENTRE = slice(4, 6), slice(6, 8)


@dataclass(frozen=True, slots=True)
class Finding:
    """A test that failed: over how many readings, its figure and its limit."""

    readings: int
    figure: float
    limit: float


@dataclass(frozen=True, slots=True)
class Window:
    """The latest readings of a kind.

    Attributes
    ----------
    kind : str
    rows : (n, 8) float64, oldest first, n <= 60
        Residual, its variance, the part of that which is sensor and map, the reading [the kind's unit]; indicated
        latitude and longitude [deg]; estimated INS error, north and east [m].
    nis : (n,)
        Normalised innovations squared, capped.
    seen : bool
        Whether there ever was a reading of this kind.
    scale : float
        How many times noisier than told the estimator has found them.
    bad, loud, alike : Finding or None
        What `contradiction`, `excess` and `coloured` say of it.
    """

    kind: str
    rows: FloatArray = field(default_factory=lambda: np.zeros((0, 8)))
    nis: FloatArray = field(default_factory=lambda: np.zeros(0))
    seen: bool = False
    scale: float = 1.0
    bad: Finding | None = None
    loud: Finding | None = None
    alike: Finding | None = None

    def __len__(self) -> int:
        return len(self.rows)

    def plus(
        self, innovation: Innovation, value: float, epoch: Epoch, centre_m: FloatArray, false_alarm: float
    ) -> Window:
        """The window with one more reading, tested."""
        told = (innovation.residual, innovation.variance, innovation.noise, value)
        row = np.array((*told, epoch.lat_deg, epoch.lon_deg, *centre_m.tolist()))
        rows, nis = kernels.appended(self.rows, row, LONGEST, CAP)
        tests = contradiction(nis, false_alarm), excess(nis, false_alarm), coloured(rows, false_alarm)
        return Window(self.kind, rows, nis, True, innovation.scale, *tests)

    def cleared(self) -> Window:
        """Nothing seen yet."""
        return Window(self.kind, self.rows[:0], self.nis[:0], self.seen, self.scale)

    def mean_nis(self, readings: int = 20) -> float:
        """Mean over the latest readings, NaN before any."""
        return float(kernels.latest(self.nis, readings)[0])


def contradiction(nis: FloatArray, false_alarm: float) -> Finding | None:
    """Whether the latest readings contradict the map, by the shortest window that says so.

    Parameters
    ----------
    nis : (n,)
        Oldest first.
    false_alarm : float
        Probability, per window, that readings as told fail the stricter of both tests.
    """
    for length in LENGTHS:
        if len(nis) < length:
            return None
        (mean, far), limit = kernels.latest(nis, length), nis_limit(length, false_alarm)
        if mean > limit and far >= count_limit(length, false_alarm):
            return Finding(length, mean, limit)
    return None


def excess(nis: FloatArray, false_alarm: float) -> Finding | None:
    """Whether the mean NIS of the whole window is beyond its chi-square limit, single gross errors counting little."""
    if len(nis) < LENGTHS[0]:
        return None
    mean, limit = float(kernels.clipped_mean(nis, CLIP)), nis_limit(len(nis), false_alarm)
    return Finding(len(nis), mean, limit) if mean > limit else None


def coloured(rows: FloatArray, false_alarm: float) -> Finding | None:
    """Whether successive residuals are alike: Ljung and Box's portmanteau over four lags (Biometrika 65, 1978, eq. 3).

    The figure is the correlation of neighbours; the limit that of the test, were all correlation in one lag.
    """
    n = len(rows)
    if n < LONGEST:
        return None
    rho = kernels.autocorrelation(rows, LAGS, 3.0).tolist()
    q = n * (n + 2) * sum(one**2 / (n - lag) for lag, one in enumerate(rho, 1))
    limit = float(_chi2_quantile(LAGS, false_alarm))
    if not q > limit or rho[0] <= 0.0:  # NaN where all are zero
        return None
    return Finding(n, rho[0], math.sqrt(limit * (n - 1) / (n * (n + 2))))


def stuck(window: Window) -> int:
    """How many times in a row the same value came while the map under the track varied; 0 when the sensor lives."""
    if len(window) < STUCK:
        return 0
    values = window.rows[:, VALUE]
    if values[-1] != values[-2]:
        return 0
    differ = np.flatnonzero(values != values[-1])
    same = len(values) - (int(differ[-1]) + 1 if differ.size else 0)
    if same < STUCK:
        return 0
    latest = window.rows[-same:]
    predicted = latest[:, VALUE] - latest[:, RESIDUAL]
    varies = float(np.ptp(predicted)) > 6.0 * math.sqrt(float(latest[:, NOISE].mean()))
    return same if varies else 0


def noise_factor(nis: FloatArray, readings: int = 20) -> float:
    """How many times larger the sigmas look than they are told, >= 1: from the median, so that outliers do not count.

    The median of chi-square with one degree of freedom is 0.455.
    """
    if len(nis) < LENGTHS[0]:
        return 1.0
    latest = np.sort(nis[-readings:])
    return math.sqrt(max(float(latest[latest.size // 2]) / 0.455, 1.0))


@lru_cache(maxsize=512)
def nis_limit(readings: int, false_alarm: float) -> float:
    """Limit of the mean NIS of so many readings."""
    return _chi2_quantile(readings, false_alarm) / readings


@lru_cache(maxsize=512)
def count_limit(readings: int, false_alarm: float) -> int:
    """Fewest readings beyond two sigma that healthy ones reach with at most this probability."""
    return next(k for k in range(readings + 1) if bdtrc(k, readings, ALLOWED) <= false_alarm) + 1


@lru_cache(maxsize=512)
def _chi2_quantile(freedom: int, beyond: float) -> float:
    return float(chdtri(freedom, beyond))
