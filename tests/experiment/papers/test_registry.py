"""Papers are found by the name of their module; a number without one names those there are."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

import terranav.experiment.papers as package
from terranav.core.errors import ConfigError
from terranav.experiment.papers.outcome import Setup
from terranav.experiment.papers.registry import paper_number, papers, reproduce, title

MADE_UP = """
from terranav.experiment.papers.outcome import Reproduction
TITLE = "A made-up method"
def reproduce(setup):
    return Reproduction("017", TITLE, f"seed {setup.seed}", setup.runs, (), ())
"""


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of papers in place of the real ones, with paper 017 and files that are none."""
    (tmp_path / "p017.py").write_text(MADE_UP)
    for name in ("_p018_world", "p19", "p0200", "outcome"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('imported')")
    monkeypatch.setattr(package, "__path__", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, f"{package.__name__}.p017", raising=False)
    importlib.invalidate_caches()
    return tmp_path


def test_papers_are_modules_with_a_number(shelf: Path) -> None:
    assert papers() == ["017"]
    (shelf / "p003.py").write_text("raise RuntimeError('imported')")
    importlib.invalidate_caches()
    assert papers() == ["003", "017"]


@pytest.mark.parametrize("text", ["017", "17", " 17 "])
def test_leading_zeros_may_be_left_out(shelf: Path, text: str) -> None:
    assert paper_number(text) == "017"
    assert title(text) == "A made-up method"


@pytest.mark.parametrize("text", ["016", "p017", "", "0017", "all", "-17", "17.0"])
def test_an_unknown_number_names_those_there_are(shelf: Path, text: str) -> None:
    with pytest.raises(ConfigError, match=f"no paper '{text}', expected one of 017$"):
        reproduce(text)


def test_reproduce_hands_on_the_setup(shelf: Path) -> None:
    found = reproduce("017", Setup(runs=3, seed=8))
    assert (found.paper, found.runs, found.scenario) == ("017", 3, "seed 8")
    assert reproduce("017").runs == 50


def test_every_real_paper_has_a_title_and_a_study() -> None:
    for number in papers():
        module = importlib.import_module(f"{package.__name__}.p{number}")
        assert title(number) == module.TITLE
        assert title(number).strip()
        assert callable(module.reproduce)
