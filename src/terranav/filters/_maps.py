"""Which maps a filter takes."""

from __future__ import annotations

from terranav.core.errors import ConfigError
from terranav.maps.map import Map


def one_map_a_kind(name: str, maps: tuple[Map, ...]) -> None:
    """Raise ConfigError unless there is a map and no two are of one kind; a reading meets the map of its kind."""
    kinds = [chart.kind for chart in maps]
    if not kinds or len(set(kinds)) != len(kinds):
        raise ConfigError(f"{name} maps are of kinds {kinds}, expected one map of each kind that is measured")
