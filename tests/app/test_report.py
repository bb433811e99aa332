"""Words, tables, pictures, the report and what a notebook shows, on a made-up outcome."""

from __future__ import annotations

import io
import math
import re
import sys
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import terranav
from terranav.app import report, tables, words
from terranav.app.console import as_json
from terranav.app.figures import FIGURES
from terranav.app.listing import described_estimators
from terranav.app.notebook import html_of
from terranav.app.outcome import Outcome
from terranav.app.style import nice_length, png
from terranav.core.recording import Recording
from terranav.experiment.registry import estimators
from tests.app.conftest import EPOCHS, made_up_result


def with_status(outcome: Outcome, error_m: float, status: list[str]) -> Outcome:
    made = made_up_result(outcome.recording, "pointmass", error_m, status)
    return Outcome(outcome.recording, outcome.maps, {**outcome.results, "pointmass": made}, outcome.ins)


def without_truth(outcome: Outcome) -> Outcome:
    rec = outcome.recording
    blind = Recording(
        {key: value for key, value in rec.columns.items() if not key.startswith("true_")},
        sigma=rec.sigma,
        name="blind",
    )
    results = {name: replace(result, true_lat_deg=None, true_lon_deg=None) for name, result in outcome.results.items()}
    return Outcome(blind, outcome.maps, results, outcome.ins)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.04, "0.0 m"), (9.96, "10 m"), (45.3, "45 m"), (999.4, "999 m"), (999.6, "1.0 km"), (1912.0, "1.9 km"),
     (123456.0, "123 km"), (math.nan, "–"), (math.inf, "–")],
)  # fmt: skip
def test_distance(value: float, text: str) -> None:
    assert words.distance(value) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0 s"), (119, "119 s"), (120, "2 min"), (3599, "1 h 00 min"), (7500, "2 h 05 min"), (math.nan, "–")],
)  # fmt: skip
def test_duration(value: float, text: str) -> None:
    assert words.duration(value) == text


def test_verdict(outcome: Outcome) -> None:
    start, end = (words.distance(value) for value in (outcome.initial_ins_error_m, outcome.final_ins_error_m))
    text = words.verdict(outcome)
    assert text.startswith("pointmass held the position within 10 m (95 %) for 3 min; the INS alone")
    assert end in text
    poor = words.verdict(with_status(outcome, 0.8 * outcome.final_ins_error_m, ["converged"] * EPOCHS))
    assert "knew the position only to" in poor
    never = words.verdict(with_status(outcome, 10.0, ["searching"] * EPOCHS))
    assert never.startswith("pointmass never found its position; ")
    lost = words.verdict(with_status(outcome, 10.0, ["converged"] * 100 + ["lost"] * 20))
    assert "ended lost" in lost
    proud = words.verdict(with_status(outcome, 90.0, ["converged"] * EPOCHS))
    assert "claims more than it delivers" in proud
    worse = words.verdict(with_status(outcome, 9000.0, ["converged"] * EPOCHS))
    assert "made it worse: it ended 9.0 km off" in worse
    alone = words.verdict(Outcome(outcome.recording, outcome.maps, {"ins": outcome.results["ins"]}, outcome.ins))
    assert alone.startswith("The INS alone")
    assert start in alone or end in alone
    blind = words.verdict(without_truth(outcome))
    assert "no true position to check" in blind
    assert "49 m (95 %)" in blind  # sqrt(5.99) * 20 m


def test_the_most_accurate_estimator_stands_for_all(outcome: Outcome) -> None:
    better = made_up_result(outcome.recording, "better", 2.0, ["converged"] * EPOCHS)
    both = Outcome(outcome.recording, outcome.maps, {**outcome.results, "better": better}, outcome.ins)
    assert both.main == "better"
    assert Outcome(both.recording, both.maps, both.results, both.ins, asked="pointmass").main == "pointmass"


def test_table(outcome: Outcome) -> None:
    heads = [column.head for column in tables.columns(outcome)]
    rows = dict(tables.rows(outcome))
    pointmass = dict(zip(heads, rows["pointmass"], strict=True))
    assert pointmass["R95 fixed"] == "10 m"
    assert pointmass["in 95 %"] == "100 %"
    assert pointmass["NEES"] == "0.25"  # (10 m / 20 m)^2
    assert pointmass["first fix"] == "40 s"
    assert dict(zip(heads, rows["ins"], strict=True))["first fix"] == "never"
    blind = without_truth(outcome)
    assert "last position" in [column.head for column in tables.columns(blind)]
    assert dict(tables.rows(blind))["pointmass"][1] == "49 m"


@pytest.mark.parametrize("width", [80, 100, 120])
def test_terminal_table_never_breaks_a_figure(width: int, outcome: Outcome) -> None:
    from rich.console import Console

    console = Console(file=io.StringIO(), width=width)
    console.print(tables.rich_table(outcome, width))
    assert isinstance(console.file, io.StringIO)
    lines = [line for line in console.file.getvalue().splitlines() if line.strip()]
    assert all(len(line.rstrip()) <= width for line in lines)
    assert len([line for line in lines if "pointmass" in line]) == 1
    assert lines[-1].lstrip().startswith("pointmass")
    heads = " ".join(lines[:-3])
    assert ("max" in heads) == (width > 100)
    assert "R95" in heads


def test_json_is_strict() -> None:
    text = as_json({"a": math.nan, "b": np.float64("inf"), "c": np.arange(2), "d": (1, None, True), "e": np.float32(2)})
    assert "NaN" not in text
    assert text.replace("\n", "").replace(" ", "") == '{"a":null,"b":null,"c":[0,1],"d":[1,null,true],"e":2.0}'


@pytest.mark.parametrize("truth", [True, False])
@pytest.mark.parametrize("stem", FIGURES)
def test_every_picture(stem: str, truth: bool, outcome: Outcome) -> None:
    figure = FIGURES[stem](outcome if truth else without_truth(outcome))
    assert isinstance(figure, Figure)
    assert png(figure, dpi=40).startswith(b"\x89PNG")


def test_pictures_of_odd_outcomes(outcome: Outcome) -> None:
    rec = outcome.recording
    first = rec.between(0.0, 0.0)
    one = made_up_result(first, "pointmass", 10.0, ["searching"])
    tiny = Outcome(first, outcome.maps, {"pointmass": one}, outcome.ins)
    cloud = made_up_result(rec, "pointmass", 10.0, ["off_map"] * EPOCHS, particles=True)
    off = Outcome(rec, (), {"pointmass": cloud}, outcome.ins)
    alone = Outcome(rec, outcome.maps, {"ins": outcome.results["ins"]}, outcome.ins)
    for odd in (tiny, off, alone):
        pictures = report.draw(odd)
        assert "track" in pictures
        assert "</html>" in report.render(odd, pictures)
    assert "profile" not in report.draw(off)
    assert "posterior" not in report.draw(alone)


def test_same_outcome_same_picture(outcome: Outcome) -> None:
    assert png(FIGURES["error"](outcome), dpi=40) == png(FIGURES["error"](outcome), dpi=40)  # type: ignore[arg-type]


class _Links(HTMLParser):
    """Everything that a page would fetch, and whether its tags are closed."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.fetched += [value or "" for key, value in attrs if key in ("src", "href", "srcset", "data", "action")]
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_report_needs_nothing_else(outcome: Outcome) -> None:
    pictures = report.draw(outcome)
    page = report.render(outcome, pictures)
    links = _Links()
    links.feed(page)
    assert links.open == []
    assert len(links.fetched) == 1 + len(pictures)
    assert all(link.startswith("data:") for link in links.fetched)
    assert not re.search(r"https?:|@import|<script|url\(", page)
    assert "terranav run &lt;&amp;&gt;" in page
    for text in ("pointmass held the position within 10\N{NO-BREAK SPACE}m", "What was run", "cells 3", "NEES"):
        assert text in page


def test_report_says_what_the_pictures_show(outcome: Outcome) -> None:
    texts = report.captions(outcome)
    assert set(texts) == set(FIGURES)
    assert all(text["caption"] and text["title"] for text in texts.values())


@pytest.mark.parametrize(("wanted", "nice"), [(1.0, 1.0), (3.9, 2.0), (5.0, 5.0), (9999.0, 5000.0), (0.03, 0.02)])
def test_scale_bar_length(wanted: float, nice: float) -> None:
    assert nice_length(wanted) == pytest.approx(nice)


def test_every_estimator_says_what_it_is() -> None:
    found = {entry["name"]: entry["about"] for entry in described_estimators()}
    assert sorted(found) == estimators()
    assert all(found.values())


@pytest.mark.parametrize("truth", [True, False])
def test_things_show_themselves(truth: bool, outcome: Outcome) -> None:
    shown = outcome if truth else without_truth(outcome)
    for thing in (shown.maps[0], shown.recording, shown.results["pointmass"]):
        page = html_of(thing)
        assert page.count("data:image/png;base64,") == 1
        assert "<table" in page


def test_import_in_a_notebook_registers_them(monkeypatch: pytest.MonkeyPatch, outcome: Outcome) -> None:
    known: dict[tuple[str, str], Any] = {}
    html = SimpleNamespace(for_type_by_name=lambda module, name, show: known.__setitem__((module, name), show))
    shell = SimpleNamespace(display_formatter=SimpleNamespace(formatters={"text/html": html}))
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    terranav._show_in_notebooks()
    for thing in (outcome.maps[0], outcome.recording, outcome.results["ins"]):
        show = known[type(thing).__module__, type(thing).__name__]
        assert "<img" in show(thing)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    terranav._show_in_notebooks()


def test_png_is_an_image_of_the_right_size(outcome: Outcome) -> None:
    from matplotlib.image import imread

    figure = FIGURES["north_east"](outcome)
    assert figure is not None
    pixels = imread(io.BytesIO(png(figure, dpi=50)))
    assert pixels.shape[:2] == (220, 500)
