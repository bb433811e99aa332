"""Where a result came from: versions, seed, settings and checksums, so that it can be made again to the bit."""

from __future__ import annotations

import hashlib
import json
import platform
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from terranav._version import __version__
from terranav.core.protocols import Estimator
from terranav.core.recording import Recording
from terranav.experiment.inputs import Inputs
from terranav.experiment.registry import estimator_name, own_maps

#: packages whose version can change the last bits of a result
_PACKAGES = ("numpy", "numba", "pyproj")


def recording_checksum(rec: Recording) -> str:
    """SHA-256 of a recording's columns, sigmas and INS grade; its name and source do not count."""
    digest = hashlib.sha256()
    for key, values in rec.columns.items():
        digest.update(key.encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    facts = {"ins": None if rec.ins is None else asdict(rec.ins), "sigma": dict(rec.sigma)}
    digest.update(json.dumps(facts, sort_keys=True).encode())
    return digest.hexdigest()


def settings_of(thing: Any) -> dict[str, Any]:
    """Return the settings of an estimator as plain JSON values; a matcher's stand under 'matcher'."""
    if not is_dataclass(thing):
        return {}
    return {
        entry.name: _plain(getattr(thing, entry.name)) for entry in fields(thing) if entry.name not in ("maps", "ins")
    }


def provenance(estimator: Estimator[Any], inputs: Inputs, seed: int) -> dict[str, Any]:
    """Everything that a run's result depends on, as plain JSON values.

    Returns
    -------
    dict
        terranav, versions, platform, command, seed, estimator, ins, prior, maps, recording, assumed.
    """
    rec, name = inputs.rec, estimator_name(estimator)
    return {
        "terranav": __version__,
        "versions": {"python": platform.python_version(), **{package: _version(package) for package in _PACKAGES}},
        "platform": platform.platform(),
        "command": shlex.join(sys.argv),
        "seed": seed,
        "estimator": {"name": name, "settings": settings_of(estimator)},
        "ins": _plain(getattr(estimator, "ins", None)),
        "prior": _plain(inputs.prior),
        "maps": [
            {
                "name": chart.name,
                "kind": chart.kind,
                "sigma": chart.sigma,
                "source": chart.source,
                "checksum": chart.checksum,
            }
            for chart in own_maps(estimator) or inputs.maps
        ],
        "recording": {
            "name": rec.name,
            "epochs": len(rec),
            "source": dict(rec.source),
            "checksum": recording_checksum(rec),
        },
        "assumed": list(inputs.assumed),
    }


def _version(package: str) -> str:
    """Version of an installed package, without importing it."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _plain(value: Any) -> Any:
    """`value` as what JSON knows; objects that are neither data nor dataclasses as their text."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return settings_of(value)
    return repr(value)
