"""Bound, protection level, ribbon and reasons in tables, pictures, report and JSON."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import terranav as tn
from terranav.app import reasons, report, tables, words
from terranav.app.console import as_json
from terranav.app.figures import FIGURES, error_history, north_east
from terranav.app.outcome import Outcome
from terranav.app.style import STATUS_COLOUR, png, status_ribbon
from terranav.core.recording import Recording
from terranav.core.records import Status
from terranav.experiment.result import Result
from tests.app.conftest import EPOCHS, made_up_result

LOST, DOUBT = slice(50, 70), slice(70, 80)
CONTRADICTED = "terrain readings contradict the map: NIS {:.2g} over the last 20 readings (limit 1.9)"


def watched(rec: Recording, name: str = "pointmass", error_m: float = 10.0) -> Result:
    """A run that searches for 40 s, is lost from 1 min 40 s to 2 min 20 s, and in doubt for 20 s more."""
    k = np.arange(EPOCHS)
    status = np.where(k < 20, "searching", "converged").astype("U9")
    status[LOST], status[DOUBT] = "lost", "degraded"
    protection = np.where(k < 20, np.inf, 40.0 + 0.1 * k)
    protection[LOST] = np.inf
    told: list[tuple[str, ...]] = [("no fix yet",) if i < 20 else () for i in range(EPOCHS)]
    told[LOST] = [
        (CONTRADICTED.format(4 + 0.1 * i), f"the readings also fit {300 + i} m south of here") for i in range(20)
    ]
    told[DOUBT] = [("found again: settling",)] * 10
    made = made_up_result(rec, name, error_m, status.tolist())
    return replace(made, protection_m=protection, usable=status == "converged", reasons=tuple(told))


@pytest.fixture(scope="module")
def reliable(outcome: Outcome) -> Outcome:
    results = {**outcome.results, "pointmass": watched(outcome.recording)}
    return Outcome(outcome.recording, outcome.maps, results, outcome.ins, command="terranav run")


def blind(outcome: Outcome) -> Outcome:
    columns = {key: value for key, value in outcome.recording.columns.items() if not key.startswith("true_")}
    rec = Recording(columns, sigma=outcome.recording.sigma)
    results = {name: replace(result, true_lat_deg=None, true_lon_deg=None) for name, result in outcome.results.items()}
    return Outcome(rec, outcome.maps, results, outcome.ins)


def labels(axes: Axes) -> list[str]:
    return list(axes.get_legend_handles_labels()[1])


def legend(axes: Axes) -> list[str]:
    found = axes.get_legend()
    assert found is not None
    return [text.get_text() for text in found.get_texts()]


def drawn(figure: Figure | None) -> list[Axes]:
    assert figure is not None
    return list(figure.axes)


# the bound


def test_bound_is_that_of_the_package(outcome: Outcome) -> None:
    there = tn.bound(outcome.recording, outcome.maps, outcome.ins)
    assert outcome.bound is not None
    assert np.array_equal(outcome.bound.cov_m2, there.cov_m2)
    assert outcome.metrics("pointmass")["bound_drms_m"] == pytest.approx(math.sqrt(np.mean(there.drms_m**2)))
    after = outcome.metrics_after_fix("pointmass")["bound_drms_m"]  # the first fix is that of epoch 20
    assert after == pytest.approx(math.sqrt(np.mean(there.drms_m[20:] ** 2)))
    assert math.isnan(outcome.metrics_after_fix("ins")["bound_drms_m"])
    since = replace(outcome, since_s=100.0, _cache={})
    assert since.metrics("ins")["bound_drms_m"] == pytest.approx(math.sqrt(np.mean(there.drms_m[50:] ** 2)))


def test_bound_knows_the_prior(outcome: Outcome) -> None:
    prior = {"mean_m": [0.0, 0.0], "cov_m2": [[100.0, 0.0], [0.0, 100.0]], "shape": "gaussian"}
    made = replace(outcome.results["ins"], provenance={"prior": prior})
    told = Outcome(outcome.recording, outcome.maps, {"ins": made}, outcome.ins)
    assert told.bound is not None
    assert outcome.bound is not None
    assert told.bound.drms_m[0] < math.sqrt(200.0) < outcome.bound.drms_m[0]


def test_bound_is_of_the_settings_that_the_navigator_had(outcome: Outcome) -> None:
    there = tn.bound(outcome.recording, outcome.maps, outcome.ins, outlier_share=0.4, bias_sigma={"terrain": 99.0})
    settings = {"particles": 5000, "outlier_share": 0.4, "bias_sigma": {"terrain": 99.0}}
    for told in (settings, {"risk": 1e-3, "estimator": settings}):  # alone, and watched by a monitor
        made = replace(outcome.results["ins"], provenance={"estimator": {"name": "marginalized", "settings": told}})
        own = Outcome(outcome.recording, outcome.maps, {"ins": outcome.results["ins"], "mine": made}, outcome.ins)
        assert own.bound is not None
        assert np.array_equal(own.bound.cov_m2, there.cov_m2)


def test_without_a_bound_nothing_is_said_of_it(outcome: Outcome) -> None:
    for bare in (
        blind(outcome),
        replace(outcome, maps=(), _cache={}),
        replace(outcome, maps=outcome.maps * 2, _cache={}),
    ):
        assert bare.bound is None
        assert "bound" not in [column.head for column in tables.columns(bare)]
        assert math.isnan(bare.metrics("pointmass")["bound_drms_m"])
        assert "Cramér" not in report.captions(bare)["error"]["caption"]
        assert "Cramér-Rao bound" not in labels(drawn(error_history(bare))[0])
        pictures = report.draw(bare)
        assert "</html>" in report.render(bare, pictures)


def test_bound_is_drawn_and_told(outcome: Outcome) -> None:
    assert "Cramér-Rao bound" in labels(drawn(error_history(outcome))[0])
    assert "bound ±2σ" in labels(drawn(north_east(outcome))[0])
    assert "Cramér" in report.captions(outcome)["error"]["caption"]
    heads = [column.head for column in tables.columns(outcome)]
    assert heads.index("bound") == heads.index("DRMS fixed") + 1
    row = dict(zip(heads, dict(tables.rows(outcome))["pointmass"], strict=True))
    assert row["bound"] == words.distance(outcome.metrics_after_fix("pointmass")["bound_drms_m"])


# the protection level


def test_integrity_in_the_table(reliable: Outcome, outcome: Outcome) -> None:
    heads = [column.head for column in tables.columns(reliable)]
    rows = {name: dict(zip(heads, texts, strict=True)) for name, texts in tables.rows(reliable)}
    assert (rows["pointmass"]["HPL"], rows["pointmass"]["available"]) == ("48 m", "58 %")  # 70 of 120
    assert (rows["ins"]["HPL"], rows["ins"]["available"]) == ("–", "–")
    assert "HPL" not in [column.head for column in tables.columns(outcome)]
    assert [column.head for column in tables.columns(blind(reliable))][-2:] == ["HPL", "available"]


@pytest.mark.parametrize("width", [80, 100, 120])
def test_terminal_table_keeps_them(width: int, reliable: Outcome) -> None:
    from rich.console import Console

    console = Console(file=io.StringIO(), width=width)
    console.print(tables.rich_table(reliable, width))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    assert all(len(line.rstrip()) <= width for line in text.splitlines())
    assert all(head in text for head in ("bound", "HPL", "available"))


def test_protection_level_and_ribbon_are_drawn(reliable: Outcome, outcome: Outcome) -> None:
    top, bottom = drawn(error_history(reliable))
    assert "protection level" in labels(top)
    assert [tick.get_text() for tick in bottom.get_yticklabels()] == ["pointmass", "its fix"]
    told = {"searching", "converged", "degraded", "lost", "fix usable", "fix withheld"}
    assert set(legend(bottom)) == told
    top, bottom = drawn(error_history(outcome))
    assert "protection level" not in labels(top)
    assert [tick.get_text() for tick in bottom.get_yticklabels()] == ["pointmass"]


@pytest.mark.parametrize("stem", FIGURES)
def test_every_picture(stem: str, reliable: Outcome) -> None:
    for shown in (reliable, blind(reliable)):
        figure = FIGURES[stem](shown)
        assert figure is not None
        assert png(figure, dpi=40).startswith(b"\x89PNG")


def test_ribbon_shows_every_status_once() -> None:
    axes = Figure().subplots()
    status = np.array([status.value for status in Status])
    status_ribbon(axes, np.arange(len(status), dtype=float), [("one", status)])
    assert len(legend(axes)) == len(STATUS_COLOUR) == len(Status)
    widths = [bar.get_width() for bar in axes.patches if isinstance(bar, Rectangle) and bar.get_width()]
    assert widths == [1.0] * len(status)


def test_statuses_can_be_told_apart_by_the_colour_blind() -> None:
    """Machado, Oliveira and Fernandes, IEEE Trans. Visualization 15 (2009): no red, no green, no blue cones."""
    blind_to: list[list[list[float]]] = [
        np.eye(3).tolist(),
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
    ]
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    codes = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in STATUS_COLOUR.values()]) / 255
    light = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    for seen in blind_to:
        xyz = np.clip(light @ np.transpose(seen), 0, 1) @ to_xyz.T / [0.9505, 1.0, 1.089]
        x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116).T
        lab = np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
        apart = np.linalg.norm(lab[:, None] - lab[None], axis=2)
        assert apart[~np.eye(len(lab), dtype=bool)].min() > 25.0


# the reasons


def test_spans_of_the_same_reason(reliable: Outcome) -> None:
    found = reasons.spans(reliable.results["pointmass"])
    assert [(entry.when, entry.status, entry.fix) for entry in found] == [
        ("from 0 s to 40 s", "searching", "fix withheld"),
        ("from 1 min 40 s to 2 min 20 s", "lost", "fix withheld"),
        ("from 2 min 20 s to 2 min 40 s", "degraded", "fix withheld"),
    ]
    assert found[1].reasons == (CONTRADICTED.format(4), "the readings also fit 300 m south of here")


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ("fits 300 m south of here", "fits 1.2 km north-east of here", True),
        ("NIS 4 over 20 readings (limit 1.9)", "NIS 1e+02 over 19 readings (limit 2)", True),
        ("terrain is stuck", "gravity is stuck", False),
        ("fits 300 m south of here", "fits 300 m south of the map", False),
        ("nothing for 40 s", "nothing for 12 min", True),
    ],
)
def test_figures_do_not_split_a_span(first: str, second: str, same: bool, outcome: Outcome) -> None:
    made = outcome.results["pointmass"]
    told = (*[(first,)] * 5, *[(second,)] * (EPOCHS - 5))
    made = replace(made, status=np.full(EPOCHS, "converged"), reasons=told)
    assert len(reasons.spans(made)) == (1 if same else 2)


def test_spans_without_a_monitor(outcome: Outcome) -> None:
    made = outcome.results["pointmass"]
    assert reasons.spans(made) == []
    assert reasons.section(outcome) is None
    told = replace(made, reasons=(*[()] * (EPOCHS - 1), ("the last epoch alone",)))
    (only,) = reasons.spans(told)
    assert (only.when, only.usable, only.fix, only.why) == ("at 3 min 58 s", None, "", "the last epoch alone")
    results = {**outcome.results, "pointmass": told}
    section = reasons.section(Outcome(outcome.recording, outcome.maps, results, outcome.ins))
    assert section is not None
    assert section["summary"] == "No integrity monitor watched pointmass."


def test_a_reason_that_flickers_gets_one_row(reliable: Outcome) -> None:
    made = reliable.results["pointmass"]
    k = np.arange(EPOCHS)
    usable = (k < 20) | (k >= 40) | (k % 4 > 1)
    told = tuple(() if ok else ("another reason",) if i == 36 else (f"HPL {i} m",) for i, ok in enumerate(usable))
    nervous = replace(made, status=np.full(EPOCHS, "converged"), usable=usable, reasons=told)
    rows = reasons.gathered(reasons.spans(nervous), 10.0)
    assert [(row.when, row.why) for row in rows] == [
        ("from 40 s to 1 min 16 s, 5 times", "HPL 20 m"),
        ("from 1 min 12 s to 1 min 14 s", "another reason"),
    ]
    assert reasons.gathered(reasons.spans(nervous), 3.0) == reasons.spans(nervous)


def test_many_spans_leave_the_longest(reliable: Outcome) -> None:
    made = reliable.results["pointmass"]
    usable = np.arange(EPOCHS) % 2 == 0
    usable[:9] = False
    told = tuple(("every time " + "I" * i,) for i in range(EPOCHS))
    nervous = replace(made, status=np.full(EPOCHS, "converged"), usable=usable, reasons=told)
    found = reasons.spans(nervous)
    assert len(found) == EPOCHS
    shown = reasons.longest(found)
    assert len(shown) == reasons.MOST_SPANS
    assert [entry.start_s for entry in shown] == sorted(entry.start_s for entry in shown)
    section = reasons.section(replace(reliable, results={"pointmass": nervous}, _cache={}))
    assert section is not None
    assert section["more"].startswith(f"{EPOCHS - reasons.MOST_SPANS} shorter rows")
    long = replace(nervous, usable=np.arange(EPOCHS) < 60, reasons=(("x",),) * 50 + told[50:])
    assert reasons.longest(reasons.spans(long))[0].duration_s == 100.0


def test_summary(reliable: Outcome) -> None:
    text = reasons.summary(reliable)
    assert text.startswith("pointmass offered a fix at 58 % of the epochs, with a protection level of 48 m (median)")
    assert "none of these fixes" in text
    results = {**reliable.results, "pointmass": watched(reliable.recording, error_m=45.0)}
    assert "of these fixes were farther" in reasons.summary(replace(reliable, results=results, _cache={}))
    assert reasons.summary(blind(reliable)).endswith("(median).")
    never = replace(reliable.results["pointmass"], usable=np.zeros(EPOCHS, dtype=bool))
    assert (
        reasons.summary(replace(reliable, results={"pointmass": never}, _cache={}))
        == "pointmass offered no fix at all."
    )


def test_report_lists_them(reliable: Outcome) -> None:
    pictures = dict.fromkeys(FIGURES, b"")
    page = report.render(reliable, pictures).replace("\N{NO-BREAK SPACE}", " ")
    for text in ("Can it be relied on?", "from 1 min 40 s to 2 min 20 s", "NIS 4 over", "fix withheld", "HPL"):
        assert text in page
    assert page.index("How far off") < page.index("Can it be relied on?") < page.index("Does the map fit")
    assert ("58 %", "of epochs with a fix offered as usable") in report.cards(reliable)
    assert "protection level (dashed blue)" in report.captions(reliable)["error"]["caption"]


def test_reasons_are_escaped(reliable: Outcome) -> None:
    told = replace(reliable.results["pointmass"], reasons=(("<b>&",),) * EPOCHS)
    page = report.render(replace(reliable, results={"pointmass": told}, _cache={}), {"error": b""})
    assert "&lt;b&gt;&amp;" in page


def test_json_has_the_same_figures(reliable: Outcome) -> None:
    found = json.loads(as_json(reliable.as_json()))
    assert found["metrics"]["available"] == pytest.approx(70 / 120)
    assert found["metrics"]["misleading"] == 0.0
    assert found["metrics"]["bound_drms_m"] == pytest.approx(reliable.metrics("pointmass")["bound_drms_m"])
    one = found["estimators"]["pointmass"]
    assert one["after_fix"]["bound_drms_m"] < found["metrics"]["bound_drms_m"]
    assert one["reasons"][1] == {
        "from_s": 100.0,
        "to_s": 140.0,
        "status": "lost",
        "usable": False,
        "reasons": [CONTRADICTED.format(4), "the readings also fit 300 m south of here"],
    }
    assert found["estimators"]["ins"]["available"] is None
    assert found["estimators"]["ins"]["reasons"] == []


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.0, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (200.0, "3 min 20 s"), (3909.0, "1 h 05 min 09 s")],
)
def test_moment(seconds: float, text: str) -> None:
    assert words.moment(seconds) == text


@pytest.mark.parametrize(
    ("share", "digits", "text"),
    [
        (0.0, 0, "0 %"),
        (0.001, 0, "< 1 %"),
        (0.001, 1, "0.1 %"),
        (0.0001, 1, "< 0.1 %"),
        (0.94, 0, "94 %"),
        (math.nan, 1, "–"),
    ],
)
def test_percent(share: float, digits: int, text: str) -> None:
    assert words.percent(share, digits) == text
