"""A record with some fields changed is what dataclasses.replace makes of it."""

from __future__ import annotations

import pickle
from dataclasses import FrozenInstanceError, replace

import pytest

from terranav.core.frozen import changed
from terranav.core.records import Epoch, Measurement

EPOCH = Epoch(1.0, 45.0, 10.0, 2000.0, measurements=(Measurement("terrain", 3.0, 1.0),))


def test_it_is_what_replace_makes() -> None:
    after = changed(EPOCH, time_s=2.0, measurements=())
    assert after == replace(EPOCH, time_s=2.0, measurements=())
    assert (EPOCH.time_s, len(EPOCH.measurements)) == (1.0, 1)
    assert pickle.loads(pickle.dumps(after)) == after
    with pytest.raises(FrozenInstanceError):
        after.time_s = 3.0  # type: ignore[misc]


def test_a_field_that_does_not_exist_is_named() -> None:
    with pytest.raises(TypeError, match="Epoch has no speed"):
        changed(EPOCH, speed=1.0)
