"""What is constant over a recording: `name`, `[ins]`, `[sigma]`, `[source]`, `vertical_datum`.

It stands in a TOML file beside a CSV recording, as JSON in the metadata of a Parquet recording, and in the columns file
that converts a table; the keys are the same everywhere.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from terranav.core.errors import ConfigError, DataError
from terranav.core.ins_grade import InsGrade
from terranav.core.recording import HEIGHTS, RAW, READY, Recording
from terranav.io.toml_table import TomlTable
from terranav.maps.datum import stated_datum


@dataclass(frozen=True)
class About:
    """The constant facts of a recording, with the meaning they have there; no name stands for the file's own."""

    name: str | None = None
    ins: InsGrade | None = None
    sigma: dict[str, float] = field(default_factory=dict)
    source: dict[str, str] = field(default_factory=dict)
    datum: dict[str, str] = field(default_factory=dict)


def about_from(table: TomlTable) -> About:
    """Read the facts from the top of a file; unknown keys beside them are the caller's to refuse."""
    return About(
        name=table.text("name"),
        ins=_ins(table.table("ins")),
        sigma=_sigma(table.table("sigma")),
        source=_source(table.table("source")),
        datum=_datum(table),
    )


def facts_of(rec: Recording) -> dict[str, Any]:
    """Return the facts of a recording as plain nested values: the tables of the TOML file, the JSON of the metadata.

    DataError for a vertical datum that nobody knows.
    """
    facts: dict[str, Any] = {"name": rec.name}
    if rec.ins is not None:
        facts["ins"] = asdict(rec.ins)
    if rec.datum:
        for key, text in rec.datum.items():  # what is written can be read
            stated_datum(text, f"{rec.name}: vertical_datum of {key}", DataError)
        facts["vertical_datum"] = dict(rec.datum)
    return {**facts, "sigma": dict(rec.sigma), "source": dict(rec.source)}


def toml_text(facts: Mapping[str, Any]) -> str:
    """Write texts, floats and one level of tables of them as TOML; empty tables are left out."""
    lines = [f"{_quoted(key)} = {_literal(value)}" for key, value in facts.items() if not isinstance(value, Mapping)]
    for name, table in facts.items():
        if isinstance(table, Mapping) and table:
            lines += [
                "",
                f"[{_quoted(name)}]",
                *[f"{_quoted(key)} = {_literal(value)}" for key, value in table.items()],
            ]
    return "\n".join(lines) + "\n"


def _ins(table: TomlTable | None) -> InsGrade | None:
    """[ins]: the keys of InsGrade."""
    if table is None:
        return None
    known = [entry.name for entry in fields(InsGrade)]
    for key in table.given():
        if key not in known:
            table.unknown(key, known)
    numbers = {key: table.number(key, 0.0) for key in known if key in table and key != "name"}
    try:
        return InsGrade(**numbers, name=table.text("name") or "")
    except ConfigError as problem:
        raise table.error(f"{table.where}: {str(problem).replace('ins ', '[ins] ', 1)}") from None


def _sigma(table: TomlTable | None) -> dict[str, float]:
    """[sigma]: one positive number per reading column."""
    if table is None:
        return {}
    known = (*READY, *RAW)
    for key in table.given():
        if key not in known:
            table.unknown(key, known)
    return {key: table.number(key, 0.0, above=0.0) for key in table.given()}


def _source(table: TomlTable | None) -> dict[str, str]:
    """[source]: any keys, each with a text."""
    return {} if table is None else {key: table.text(key) or "" for key in table.given()}


def _datum(facts: TomlTable) -> dict[str, str]:
    """vertical_datum: one for all heights, or a table with one per column; as it stands, once it is a known one."""
    value = facts.value("vertical_datum")
    if value is None:
        return {}
    if isinstance(value, str):
        value = {"all": value}
    elif not isinstance(value, dict):
        facts.fail("vertical_datum", 'a text such as "EGM96", or a table [vertical_datum]')
    table = facts.inner(value, "[vertical_datum]")
    for key in table.given():
        if key not in HEIGHTS:
            table.unknown(key, HEIGHTS)
        stated_datum(table.text(key), f"{table.where}: [vertical_datum] {key}", table.error)
    return {key: table.text(key) or "" for key in table.given()}


def _literal(value: str | float) -> str:
    """A value as TOML: the shortest decimals that give the same float back."""
    return _string(value) if isinstance(value, str) else repr(float(value))


def _quoted(key: str) -> str:
    """A key as TOML: bare where that is allowed."""
    bare = key.replace("_", "").replace("-", "")
    return key if bare.isascii() and bare.isalnum() else _string(key)


def _string(text: str) -> str:
    """A text in double quotes: what JSON escapes is right in TOML too, which also wants DEL escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
