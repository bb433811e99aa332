"""Checks for the boundary of the package: each raises one clear line, and nothing inside checks again."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Any, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from terranav.core.errors import ConfigError


def nearest_name(name: str, known: Iterable[str]) -> str:
    """' (did you mean 'x'?)' for the closest known name whatever its case, or an empty text."""
    by_lower = {one.lower(): one for one in known}
    close = difflib.get_close_matches(name.lower(), list(by_lower), n=1, cutoff=0.5)
    return f" (did you mean {by_lower[close[0]]!r}?)" if close else ""


def unknown_name(what: str, name: str, known: Iterable[str]) -> NoReturn:
    """Raise ConfigError for a name that is not among the known ones, offering the nearest."""
    names = sorted(known)
    raise ConfigError(f"unknown {what} {name!r}{nearest_name(name, names)}; known: {', '.join(names)}")


def finite(
    key: str, value: Any, *, minimum: float = -math.inf, maximum: float = math.inf, above: float = -math.inf
) -> float:
    """Return `value` as a finite float with minimum <= value <= maximum and value > above, or raise ConfigError."""
    limits = [
        f">= {minimum:g}" if minimum > -math.inf else "",
        f"> {above:g}" if above > -math.inf else "",
        f"<= {maximum:g}" if maximum < math.inf else "",
    ]
    wanted = " and ".join(["a finite number", *[text for text in limits if text]])
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise ConfigError(f"{key} is {value!r}, expected {wanted}")
    number = float(value)
    if not math.isfinite(number) or not minimum <= number <= maximum or number <= above:
        raise ConfigError(f"{key} is {value!r}, expected {wanted}")
    return number


def covariance(key: str, value: ArrayLike, size: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return `value` as a symmetric positive semidefinite (size, size) float64 array, or raise ConfigError."""
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise ConfigError(f"{key} has shape {matrix.shape}, expected a finite ({size}, {size}) matrix")
    scale = float(np.abs(matrix).max())
    if np.abs(matrix - matrix.T).max() > 1e-9 * scale or np.linalg.eigvalsh(matrix)[0] < -1e-9 * scale:
        raise ConfigError(f"{key} is {matrix.tolist()}, expected a symmetric matrix without negative eigenvalues")
    return 0.5 * (matrix + matrix.T)
