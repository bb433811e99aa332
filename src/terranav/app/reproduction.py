"""What a reproduction is called, in JSON and on the terminal: tables as they are, each claim with its verdict."""

from __future__ import annotations

import io
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

from terranav.app.console import show, width
from terranav.app.words import duration
from terranav.experiment.papers.outcome import Claim, Reproduction, Table

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table as RichTable

#: what a claim's verdict, or a paper that could not be run, looks like on the terminal
_STYLE = {"holds": "green", "holds in part": "yellow", "does not hold": "red", "failed": "bold red"}
FAILED = "failed"
_UNBOUNDED = 1000  # columns of a file
_HEAD = 14  # columns that the head of a column of figures may take, however short they are
_TEXT = 36  # columns of a terminal that a text in a table may take


@dataclass(frozen=True)
class Attempt:
    """What came of one paper.

    Attributes
    ----------
    paper, title : str
    wall_s : float
        How long it took [s].
    found : Reproduction or None
        None when it failed.
    error, traceback : str
        Why it failed, in one line and in full; empty when it did not.
    refused : bool
        Whether it failed because it cannot use what it was given, such as a map.
    """

    paper: str
    title: str
    wall_s: float
    found: Reproduction | None = None
    error: str = ""
    traceback: str = ""
    refused: bool = False

    @property
    def claims(self) -> Sequence[Claim]:
        """Its claims; none when it failed."""
        return () if self.found is None else self.found.claims

    def as_json(self) -> dict[str, Any]:
        """Everything but the data of the figures."""
        head = {"paper": self.paper, "title": self.title, "wall_s": self.wall_s, "error": self.error or None}
        if self.found is None:
            return {**head, "traceback": self.traceback}
        return {
            **head,
            "scenario": self.found.scenario,
            "runs": self.found.runs,
            "failures": [asdict(failure) for failure in self.found.failures],
            "tables": [asdict(table) for table in self.found.tables],
            "claims": [asdict(claim) for claim in self.found.claims],
            "figures": [{"name": figure.name, "title": figure.title} for figure in self.found.figures],
        }

    def effort(self) -> str:
        """How many runs in what time, and which runs failed."""
        if self.found is None:
            return f"failed after {duration(self.wall_s)}"
        text = f"{self.found.runs} runs of each case in {duration(self.wall_s)}"
        failures = list(self.found.failures)
        if failures:
            which = "; ".join(f"run {failure.run}: {failure.error}" for failure in failures[:3])
            text += f"; {len(failures)} failed ({which}{'; ...' if len(failures) > 3 else ''})"
        return text


def verdicts(attempts: Sequence[Attempt]) -> dict[str, int]:
    """How many claims have which verdict, and how many papers failed; in the order of the terminal's colours."""
    counts = Counter(claim.verdict for attempt in attempts for claim in attempt.claims)
    failed = sum(attempt.found is None for attempt in attempts)
    return {verdict: counts[verdict] for verdict in ("holds", "holds in part", "does not hold")} | {FAILED: failed}


def summary(attempts: Sequence[Attempt]) -> str:
    """The outcome in one sentence."""
    counts = verdicts(attempts)
    failed = counts.pop(FAILED)
    total = sum(counts.values())
    papers = len(attempts) - failed
    holds, part, not_held = counts.values()
    text = (
        f"{total} claim{'s' * (total != 1)} of {papers} paper{'s' * (papers != 1)}: {holds} {_verb(holds)}, "
        f"{part} {_verb(part)} in part, {not_held} {'does' if not_held == 1 else 'do'} not"
    )
    return text + (f"; {failed} paper{'s' * (failed != 1)} could not be run" if failed else "") + "."


def _verb(count: int) -> str:
    return "holds" if count == 1 else "hold"


def shown(attempt: Attempt, columns: int | None = None) -> list[RenderableType]:
    """One paper's outcome for a terminal of so many columns, or for a file, where a table is as wide as it needs."""
    from rich.text import Text

    head = Text(f"{attempt.paper}  {attempt.title}", style="bold")
    if attempt.found is None:
        return [head, Text(f"{attempt.effort()}: {attempt.error}", style=_STYLE[FAILED]), Text()]
    parts: list[RenderableType] = [head, Text(attempt.found.scenario), Text(attempt.effort(), style="dim"), Text()]
    for table in attempt.found.tables:
        parts += [Text(table.title, style="bold"), _table(table, columns)]
    return [*parts, _claims(attempt.claims), Text()]


def print_parts(*parts: RenderableType) -> None:
    """Print to stdout: in colour and wrapped on a terminal, else plain, tables whole, no spaces at line ends."""
    from rich.console import Console
    from rich.table import Table as RichTable

    if sys.stdout.isatty():
        show(*parts)
        return
    for part in parts:
        wide = isinstance(part, RichTable) and part.box is not None
        text = io.StringIO()
        Console(file=text, width=_UNBOUNDED if wide else width(), highlight=False).print(part)
        sys.stdout.write("".join(line.rstrip() + "\n" for line in text.getvalue().splitlines()))


def verdict_table(attempts: Sequence[Attempt]) -> RichTable:
    """Every claim of every paper in one table, without the reasons."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for name, widest in (("paper", None), ("claim", 44), ("the paper says", 26), ("ours", 32)):
        table.add_column(name, max_width=widest)
    table.add_column("verdict", no_wrap=True)
    for attempt in attempts:
        if attempt.found is None:
            table.add_row(attempt.paper, Text(attempt.error), "", "", Text(FAILED, style=_STYLE[FAILED]))
        for claim in attempt.claims:
            texts = (Text(text) for text in (claim.text, claim.paper, claim.ours))
            table.add_row(attempt.paper, *texts, Text(claim.verdict, style=_STYLE[claim.verdict]))
    return table


def _table(table: Table, columns: int | None) -> RichTable:
    """A paper's table, figures to the right and on one line, where there is room for that."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    texts = zip(*table.rows) if table.rows else [()] * len(table.columns)
    longest = [max(map(len, cells), default=0) for cells in texts]
    numeric = numeric_columns(table)
    needed = sum((size if right else min(size, _TEXT)) + 3 for size, right in zip(longest, numeric))
    fits = columns is None or needed <= columns
    out = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1))
    for head, size, right in zip(table.columns, longest, numeric):
        whole = size if right and fits else None
        head_needs = max(map(len, head.split()), default=0)
        widest = None if columns is not None else max(head_needs, size, _HEAD if right else _TEXT)
        side: Literal["left", "right"] = "right" if right else "left"
        out.add_column(Text(head), justify=side, overflow="fold", min_width=whole, max_width=widest)
    for row in table.rows:
        out.add_row(*[Text(text) for text in row])
    return out


def numeric_columns(table: Table) -> list[bool]:
    """Whether each column but the first holds figures: most cells that are not empty start like one."""
    columns = zip(*table.rows) if table.rows else [()] * len(table.columns)
    return [i > 0 and _mostly_figures(cells) for i, cells in enumerate(columns)]


def _mostly_figures(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    return 2 * sum(cell[0] in "0123456789+-−–.<>" for cell in filled) >= len(filled)


def _claims(claims: Sequence[Claim]) -> RichTable:
    """Each claim: the verdict beside its words, both figures and the reason."""
    from rich.table import Table as RichTable
    from rich.text import Text

    grid = RichTable.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column()
    for claim in claims:
        text = Text.assemble(
            (claim.text, "bold"),
            *(part for name, words in told(claim) for part in (("\n" + name + " ", "dim"), words)),
        )
        grid.add_row(Text(claim.verdict, style=_STYLE[claim.verdict]), text)
    return grid


def told(claim: Claim) -> list[tuple[str, str]]:
    """What is known of a claim, each with its name; without what is empty."""
    pairs = (("the paper:", claim.paper), ("ours:", claim.ours), ("why:", claim.why))
    return [(name, text) for name, text in pairs if text]
