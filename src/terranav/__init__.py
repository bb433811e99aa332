"""terranav: where a vehicle is, without satellites.

It matches terrain height, seabed depth, gravity and magnetic readings along a track with maps of those fields and
estimates the error of the inertial navigation system (INS).

The contract
------------
- Position error = indicated minus true, metres north and east; corrected position = indicated position - error.
- Navigation frame north-east-down; elevation up-positive; the seabed negative below the datum.
- SI units; latitude, longitude and attitude in degrees; map values in the one unit of their kind (m, m, mGal, nT).
- Arrays: time first; grids (rows, cols) as stored by the file; voids and off-map are NaN.
- Randomness only through an explicit seed: the same seed gives the same bits.
- Three exceptions: DataError, ConfigError, StateError; each message names the file, the key, the value and what was
  expected.

Names are loaded when first used, so that `import terranav` stays fast.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from terranav._version import __version__

if TYPE_CHECKING:
    from terranav.core.errors import ConfigError, DataError, DataWarning, StateError, TerranavError
    from terranav.core.ins_grade import InsGrade
    from terranav.core.protocols import Estimator, Matcher
    from terranav.core.recording import Recording
    from terranav.core.records import (
        Candidates,
        Epoch,
        Estimate,
        Measurement,
        Posterior,
        Prior,
        Profile,
        Status,
    )
    from terranav.experiment.compare import compare
    from terranav.experiment.registry import estimators, make_estimator
    from terranav.experiment.result import Result
    from terranav.experiment.run import run
    from terranav.experiment.scenario import Scenario
    from terranav.experiment.simulate import simulate
    from terranav.experiment.smooth import smooth
    from terranav.experiment.stream import stream
    from terranav.ins.drift import add_drift
    from terranav.io.rasters import open_map
    from terranav.io.recordings import read_recording, write_recording
    from terranav.maps.map import Map
    from terranav.maps.sample_dem import sample_map
    from terranav.matchers.windowed import Windowed
    from terranav.planning.bound import Bound, bound

_HOME = {
    "core.errors": ("ConfigError", "DataError", "DataWarning", "StateError", "TerranavError"),
    "core.ins_grade": ("InsGrade",),
    "core.protocols": ("Estimator", "Matcher"),
    "core.recording": ("Recording",),
    "core.records": ("Candidates", "Epoch", "Estimate", "Measurement", "Posterior", "Prior", "Profile", "Status"),
    "experiment.compare": ("compare",),
    "experiment.registry": ("estimators", "make_estimator"),
    "experiment.result": ("Result",),
    "experiment.run": ("run",),
    "experiment.scenario": ("Scenario",),
    "experiment.simulate": ("simulate",),
    "experiment.smooth": ("smooth",),
    "experiment.stream": ("stream",),
    "ins.drift": ("add_drift",),
    "io.rasters": ("open_map",),
    "io.recordings": ("read_recording", "write_recording"),
    "maps.map": ("Map",),
    "maps.sample_dem": ("sample_map",),
    "matchers.windowed": ("Windowed",),
    "planning.bound": ("Bound", "bound"),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Bound",
    "Candidates",
    "ConfigError",
    "DataError",
    "DataWarning",
    "Epoch",
    "Estimate",
    "Estimator",
    "InsGrade",
    "Map",
    "Matcher",
    "Measurement",
    "Posterior",
    "Prior",
    "Profile",
    "Recording",
    "Result",
    "Scenario",
    "StateError",
    "Status",
    "TerranavError",
    "Windowed",
    "__version__",
    "add_drift",
    "bound",
    "compare",
    "estimators",
    "make_estimator",
    "open_map",
    "read_recording",
    "run",
    "sample_map",
    "simulate",
    "smooth",
    "stream",
    "write_recording",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'terranav' has no attribute {name!r}")
    value = getattr(import_module(f"terranav.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _show_in_notebooks() -> None:
    """Inside IPython let Map, Recording and Result show themselves; nothing is imported until one is shown."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is not None:
        html = shell.display_formatter.formatters["text/html"]
        for name in ("Map", "Recording", "Result"):
            module = f"terranav.{_MODULE_OF[name]}"
            html.for_type_by_name(module, name, lambda it: import_module("terranav.app.notebook").html_of(it))


_show_in_notebooks()
