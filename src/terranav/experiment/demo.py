"""The flight of `terranav demo`."""

from __future__ import annotations

import tomllib
from importlib.resources import files

from terranav.experiment.scenario import Scenario

_FILE = "demo.toml"


def demo_scenario() -> Scenario:
    """Return an aircraft's flight over the sample DEM, without GNSS, on a tactical-grade INS."""
    values = tomllib.loads(files(__package__).joinpath(_FILE).read_text(encoding="utf-8"))
    return Scenario.from_dict(values, where=_FILE)
