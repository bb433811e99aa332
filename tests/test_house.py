"""Rules of the house that no other tool holds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import terranav

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted((ROOT / "src").rglob("*.py"))


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT / "src" / "terranav")))
def test_modules_stay_under_400_lines(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 400


def test_every_public_name_is_there() -> None:
    for name in terranav.__all__:
        assert getattr(terranav, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = terranav.nonsense


@pytest.mark.parametrize("statement", ["import terranav", "from terranav.app.cli import main; main(['--help'])"])
def test_start_up_imports_nothing_heavy(statement: str) -> None:
    heavy = "{'numba', 'rasterio', 'matplotlib', 'pandas'}"
    check = f"{statement}\nimport sys\nprint(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
