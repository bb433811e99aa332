"""Every estimator whose memory a setting decides refuses before it allocates, with the figure needed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terranav.core import memory
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Epoch, Prior
from terranav.experiment.registry import make_estimator
from terranav.maps.fields import plane_map

CASES: dict[str, dict[str, Any]] = {
    "particle": {"particles": 2_000_000},
    "marginalized": {"particles": 2_000_000, "least_particles": 2_000_000},
    "pointmass": {"max_cells": 40_000_000},
}


@pytest.mark.parametrize("name", CASES)
def test_too_little_memory_is_said_before_it_is_taken(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    estimator = make_estimator(name, plane_map(0.1, 0.2), InsGrade(200.0, 0.1, 0.1), **CASES[name])
    monkeypatch.setattr(memory, "available", lambda: (float(memory.SMALL), "a test's limit"))
    rng, prior = np.random.default_rng(0), Prior(np.zeros(2), np.eye(2) * 1e4**2)
    said = rf"^{name}: .* needs \d+ MiB of memory, but 64 MiB is left \(a test's limit\)"
    with pytest.raises(ConfigError, match=said):
        estimator.step(estimator.init(prior, rng), Epoch(0.0, 0.0, 0.0, 0.0), rng)
