"""What every height sensor's error model shares: bands of noise by height, bias, scale, dropouts, resolution.

    reading = (1 + scale_error) true + bias + drift + noise(band), rounded to the resolution

A reading is NaN where the true height lies in no band (the sensor is unavailable there), and where it drops out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from terranav.core.checks import finite, unknown_name
from terranav.core.errors import ConfigError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Band:
    """Noise of a sensor up to one height: 1-sigma = sigma_m + sigma_fraction * height.

    Attributes
    ----------
    below_m : float
        The band reaches from the end of the band before it to this height [m]; may be infinite.
    sigma_m : float
        Constant part [m].
    sigma_fraction : float
        Part that grows with height [1]: 0.003 is 0.3 % of the height.
    """

    below_m: float = math.inf
    sigma_m: float = 0.0
    sigma_fraction: float = 0.0

    def __post_init__(self) -> None:
        if self.below_m != math.inf:
            finite("band below_m", self.below_m)
        finite("band sigma_m", self.sigma_m, minimum=0.0)
        finite("band sigma_fraction", self.sigma_fraction, minimum=0.0)


@dataclass(frozen=True)
class HeightSensor:
    """Error model of a sensor that measures a height.

    Attributes
    ----------
    bands : tuple of Band
        In ascending order; above the last the sensor is unavailable.
    min_m : float
        Below this true height the sensor is unavailable [m].
    bias_m : float
        Constant error [m].
    scale_error : float
        Constant error of the scale factor [1].
    dropout_probability : float
        Share of readings that are missing, in [0, 1).
    dropout_length : float
        Mean number of consecutive readings that a dropout takes, >= 1; the gaps are a two-state Markov chain.
    resolution_m : float
        Readings are rounded to a multiple of it [m]; 0 for none.

    Raises
    ------
    ConfigError
        Naming the key, the value and what was expected.
    """

    bands: tuple[Band, ...] = (Band(),)
    min_m: float = -math.inf
    bias_m: float = 0.0
    scale_error: float = 0.0
    dropout_probability: float = 0.0
    dropout_length: float = 1.0
    resolution_m: float = 0.0

    #: of the sensor, for messages
    label: ClassVar[str] = "sensor"
    #: name -> keys that a table with `preset = name` starts from
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}

    def __post_init__(self) -> None:
        label = self.label
        if not self.bands or any(not isinstance(band, Band) for band in self.bands):
            raise ConfigError(f"{label} bands is {self.bands!r}, expected at least one Band")
        object.__setattr__(self, "bands", tuple(self.bands))
        tops = [band.below_m for band in self.bands]
        if any(high <= low for low, high in pairwise(tops)):
            raise ConfigError(f"{label} bands end at {tops} m, expected increasing below_m")
        if self.min_m != -math.inf:
            finite(f"{label} min_m", self.min_m, maximum=tops[-1])
        finite(f"{label} bias_m", self.bias_m)
        finite(f"{label} scale_error", self.scale_error, above=-1.0)
        share = finite(f"{label} dropout_probability", self.dropout_probability, minimum=0.0, maximum=0.999)
        # entering a gap more often than after every good reading is impossible
        finite(f"{label} dropout_length", self.dropout_length, minimum=max(1.0, share / (1.0 - share)))
        finite(f"{label} resolution_m", self.resolution_m, minimum=0.0)

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Self:
        """Build the sensor from a TOML table.

        Parameters
        ----------
        table : mapping
            The attributes above, with `bands` as an array of tables; instead of `bands` the keys of a single band may
            stand in the table itself (`sigma_m`, `sigma_fraction`, and `max_m` for its end). `preset` names a published
            set of values that the other keys override.

        Raises
        ------
        ConfigError
            For an unknown key (the nearest known one is offered), an unknown preset or an impossible value.
        """
        own = [entry.name for entry in fields(cls)]
        known = [*own, "sigma_m", "sigma_fraction", "max_m", "preset"]
        for key in table:
            if key not in known:
                unknown_name(f"{cls.label} key", key, known)
        values = dict(table)
        preset = values.pop("preset", None)
        if preset is not None:
            if preset not in cls.presets:
                unknown_name(f"{cls.label} preset", str(preset), cls.presets)
            values = {**cls.presets[preset], **values}
        single = {
            "below_m" if key == "max_m" else key: values.pop(key)
            for key in ("max_m", "sigma_m", "sigma_fraction")
            if key in values
        }
        if single and "bands" in values:
            raise ConfigError(
                f"{cls.label}: bands is given beside sigma_m, sigma_fraction or max_m, expected one or the other"
            )
        if single:
            values["bands"] = (Band(**single),)
        elif "bands" in values:
            values["bands"] = _read_bands(cls.label, values["bands"])
        return cls(**values)

    def sigma(self, true_value: ArrayLike) -> FloatArray:
        """1-sigma of the noise at each true height.

        Parameters
        ----------
        true_value : (n,) or any shape [m]

        Returns
        -------
        ndarray of the same shape [m], NaN where the sensor is unavailable
        """
        height = np.asarray(true_value, dtype=np.float64)
        band = np.searchsorted([band.below_m for band in self.bands], height)
        out_of_reach = (band == len(self.bands)) | (height < self.min_m) | np.isnan(height)
        constant = np.array([*(band.sigma_m for band in self.bands), np.nan])[band]
        fraction = np.array([*(band.sigma_fraction for band in self.bands), np.nan])[band]
        return np.where(out_of_reach, np.nan, constant + fraction * np.maximum(height, 0.0))

    def measure(self, true_value: ArrayLike, rng: Generator, time_s: ArrayLike | None = None) -> FloatArray:
        """Readings of a series of true heights.

        Parameters
        ----------
        true_value : (n,) [m]
        rng : Generator
        time_s : (n,) [s] or None
            Of the readings; None is one a second. Only drifts depend on it.

        Returns
        -------
        (n,) [m], NaN where there is no reading
        """
        height = np.asarray(true_value, dtype=np.float64)
        noise = self.sigma(height) * rng.standard_normal(height.size)
        time = np.arange(float(height.size)) if time_s is None else np.asarray(time_s, dtype=np.float64)
        reading = (1.0 + self.scale_error) * height + self.bias_m + self._drift(time, rng) + noise
        if self.resolution_m > 0.0:
            reading = self.resolution_m * np.round(reading / self.resolution_m)
        return np.where(self._dropped(height.size, rng), np.nan, reading)

    def _drift(self, time_s: FloatArray, rng: Generator) -> FloatArray | float:
        """Slowly varying error (n,) [m]: none here."""
        return 0.0

    def _dropped(self, size: int, rng: Generator) -> NDArray[np.bool_]:
        """Which readings (n,) are missing: a stationary two-state Markov chain."""
        share = self.dropout_probability
        if share == 0.0:
            return np.zeros(size, dtype=bool)
        stay = 1.0 - 1.0 / self.dropout_length
        enter = share / (1.0 - share) / self.dropout_length
        dropped, lost = np.empty(size, dtype=bool), rng.random() < share
        for i, chance in enumerate(rng.random(size).tolist()):
            dropped[i] = lost
            lost = chance < (stay if lost else enter)
        return dropped


def _read_bands(label: str, tables: Any) -> tuple[Band, ...]:
    """Bands from an array of TOML tables (or ready ones)."""
    if not isinstance(tables, Sequence) or isinstance(tables, str) or not tables:
        raise ConfigError(f"{label} bands is {tables!r}, expected an array of tables")
    known = [entry.name for entry in fields(Band)]
    bands = []
    for table in tables:
        if isinstance(table, Band):
            bands.append(table)
            continue
        if not isinstance(table, Mapping):
            raise ConfigError(f"{label} bands holds {table!r}, expected a table with {', '.join(known)}")
        for key in table:
            if key not in known:
                unknown_name(f"{label} band key", key, known)
        bands.append(Band(**table))
    return tuple(bands)
