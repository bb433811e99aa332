"""Signed MAVLink 2 with MAVProxy's own signing: what carries the key is taken, what does not is refused."""

from __future__ import annotations

import asyncio
import hashlib
import time
from pathlib import Path
from typing import Any

import pytest

from terranav.live.testbed.settings import FlightSettings
from tests.live.thirdparty.peers import Proxy, mavproxy, mavproxy_command, until
from tests.live.thirdparty.scene import SEED, Bed, flying, navigating

PASSPHRASE = "over-the-hills"
KEY = hashlib.sha256(PASSPHRASE.encode()).digest()  # as MAVProxy makes a key
SIGN, SIGN_WRONGLY = f"signing key {PASSPHRASE}", "signing key elsewhere"


@pytest.fixture(autouse=True)
def _there() -> None:
    pytest.importorskip("jsbsim", reason="needs the extra 'fly'")
    mavproxy_command()


def vehicle(key: bytes | None) -> FlightSettings:
    """A flight of today, since signatures carry the date."""
    return FlightSettings(minutes=10.0, gnss_off_s=5.0, seed=SEED, sign_key=key, start_us=time.time_ns() // 1000)


def signed(message: Any) -> bool:
    return bool(message.get_header().incompat_flags & 1)


def met(tmp_path: Path, key: bytes | None, *commands: str) -> tuple[Bed, Proxy]:
    """The test bed and MAVProxy, until one has heard ten messages of the other, or cannot."""

    async def main() -> tuple[Bed, Proxy]:
        async with (
            flying(vehicle(key), speed=5.0) as bed,
            mavproxy(tmp_path, f"tcp:127.0.0.1:{bed.port}", commands=commands) as proxy,
        ):
            await until(lambda: sum((bed.heard | bed.ignored).values()) >= 6, "MAVProxy speaks")
            await until(lambda: len(proxy.messages()) >= 60, "MAVProxy logs", 0.3)
        return bed, proxy

    return asyncio.run(main())


def test_a_vehicle_and_mavproxy_with_the_same_key_understand_each_other(tmp_path: Path) -> None:
    bed, proxy = met(tmp_path, KEY, SIGN)
    assert bed.heard["HEARTBEAT"] >= 2
    assert "unsigned" not in bed.ignored
    assert proxy.counts()["GLOBAL_POSITION_INT", 1, 1] > 0
    assert "Detected vehicle 1:1" in proxy.said


@pytest.mark.parametrize("command", [SIGN_WRONGLY, "signing disable"], ids=["wrong key", "unsigned"])
def test_a_vehicle_with_a_key_takes_nothing_from_mavproxy_without_it(tmp_path: Path, command: str) -> None:
    bed, _ = met(tmp_path, KEY, command)
    assert bed.heard == {}
    assert bed.ignored["unsigned"] >= 6


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
def test_the_engine_takes_what_is_signed_and_nothing_else(tmp_path: Path, key: bytes | None) -> None:
    """Through MAVProxy, which hands signed messages on as they are."""

    async def main() -> tuple[Bed, dict[str, Any], Proxy]:
        async with (
            flying(vehicle(key), speed=5.0) as bed,
            navigating(key=KEY) as (live, (port,)),
            mavproxy(
                tmp_path,
                f"tcp:127.0.0.1:{bed.port}",
                [f"tcp:127.0.0.1:{port}"],
                [SIGN] if key else [],
            ) as proxy,
        ):
            if key:
                await until(lambda: bed.flight.navigation.used >= 2, "signed fixes arrive and are used")
                await proxy.logs("GLOBAL_POSITION_SENSOR", (1, 191), 2)
            else:
                await until(lambda: live.facts()["refused"] >= 500, "unsigned messages are refused")
        return bed, live.facts(), proxy

    bed, facts, proxy = asyncio.run(main())
    if key:
        assert facts["refused"] == 0
        assert facts["usable"] > 0
        assert "unsigned" not in bed.ignored
        assert all(signed(m) for m in proxy.messages() if m.get_srcComponent() == 191)
    else:
        assert facts["fixes"] == 0
        assert facts["engine"]["messages"] == {}
        assert not any(m.get_srcComponent() == 191 for m in proxy.messages())
