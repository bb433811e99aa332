"""Shared fixtures: the real data that lies beside the repository, where it does."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

#: the same examples on every machine and in every run, however long they take: the first often compiles
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")

SHARED = Path(os.environ.get("TERRANAV_SHARED", Path(__file__).resolve().parents[2] / "shared"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes minutes comes first, so that one worker does not end long after the other."""
    items.sort(key=lambda item: item.path.name != "test_environments.py")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real flights, cruises and maps; skips the test where it is not."""
    folder = SHARED / "data"
    if not folder.is_dir():
        pytest.skip(
            f"real data is not beside the checkout ({folder.name} of 'shared'; set TERRANAV_SHARED to its folder)"
        )
    return folder
