"""What MAVSDK makes of a vehicle: a program of its own, so that its threads end with it.

    python -m tests.live.thirdparty.mavsdk_client URL MESSAGE COUNT [STREAM ...]

connects, waits for so many messages of that name and for a value of every stream of the telemetry plugin, and prints
what it was told as JSON.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

_PATIENCE_S = 120.0


def listened(url: str, message: str, count: int, streams: Sequence[str]) -> dict[str, Any]:
    """Connect and listen."""
    from mavsdk import ComponentType, Configuration, ConnectionResult, Mavsdk

    with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        result = mavsdk.add_any_connection(url)
        if result != ConnectionResult.SUCCESS:
            raise SystemExit(f"{url}: {result.name}")
        end = time.monotonic() + _PATIENCE_S
        while not mavsdk.get_systems():
            if time.monotonic() > end:
                raise SystemExit(f"{url}: no system in {_PATIENCE_S:.0f} s")
            time.sleep(0.05)
        (system,) = mavsdk.get_systems()
        found = _heard(system, message, count, streams)
        return {
            "mavsdk": mavsdk.version(),
            "system": system.get_system_id(),
            "autopilot": system.autopilot_type().name if system.has_autopilot() else None,
            "components": system.component_ids(),
            "connected": system.is_connected(),
            **found,
        }


def _heard(system: Any, message: str, count: int, streams: Sequence[str]) -> dict[str, Any]:
    """Values of the streams, and the fields of the messages of one name."""
    from mavsdk.plugins.mavlink_direct import MavlinkDirect
    from mavsdk.plugins.telemetry import Telemetry

    direct = MavlinkDirect(system)
    found: dict[str, list[Any]] = {name: [] for name in (message, *streams)}
    enough = threading.Event()

    def keep(name: str, value: Any) -> None:
        found[name].append(value)
        if len(found[message]) >= count and all(found.values()):
            enough.set()

    def taken(value: Any, _: Any) -> None:
        keep(message, {"component": value.component_id, **json.loads(value.fields_json)})

    direct.subscribe_message(message, taken)
    if streams:
        telemetry = Telemetry(system)
        for name in streams:
            getattr(telemetry, f"subscribe_{name}")(lambda value, _, name=name: keep(name, _plain(value)))
    if not enough.wait(_PATIENCE_S):
        raise SystemExit(
            f"not enough in {_PATIENCE_S:.0f} s: { {name: len(values) for name, values in found.items()} }"
        )
    return found


def _plain(value: Any) -> Any:
    """A value of MAVSDK in JSON's own kinds."""
    if isinstance(value, (bool, int, float, str)):
        return getattr(value, "name", value)
    return {name: _plain(one) for name, one in vars(value).items() if not name.startswith("_")}


if __name__ == "__main__":
    json.dump(listened(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4:]), sys.stdout)
