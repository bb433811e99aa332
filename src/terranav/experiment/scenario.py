"""Scenario: a flight to simulate and the estimators to run over it, in one TOML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
from pydantic import PrivateAttr, model_validator

from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Prior
from terranav.experiment.scenario_tables import (
    NAME,
    NAME_EXPECTED,
    EstimatorTable,
    GradeTable,
    InsTable,
    MapErrorTable,
    MapTable,
    PriorTable,
    RouteTable,
    SensorsTable,
    Table,
    key,
)
from terranav.experiment.validation import toml_values, validated
from terranav.maps.map import Map

SAMPLE = "sample"


class Scenario(Table):
    """A flight to simulate and the estimators to run over it.

    The tables and their keys are in `terranav.experiment.scenario_tables`; examples/flight.toml shows them all.
    Unknown keys are errors. `Scenario.model_json_schema()` lists every key with its unit.
    """

    name: str = key("scenario", NAME_EXPECTED, "What to call it; else the file's name", pattern=NAME)
    seed: int = key(0, "a whole number >= 0", "Seed of everything that is random", ge=0)
    runs: int = key(1, "a whole number >= 1", "Runs of a Monte Carlo study", ge=1)
    maps: list[MapTable] = key(..., "at least one table [[maps]]", "Maps, at most one of a kind", min_length=1)
    route: RouteTable = key(..., "a table [route]", "Where the vehicle truly goes")
    ins: InsTable = key(..., "a table [ins]", "The INS that flies")
    sensors: SensorsTable = key(..., "a table [sensors]", "What the vehicle carries")
    map_error: MapErrorTable | None = key(None, "a table [map_error]", "Difference of the true field from the maps")
    ins_told: GradeTable | None = key(
        None, "a table [ins_told]", "What the estimators are told of the INS, where that is not [ins] itself"
    )
    prior: PriorTable | None = key(None, "a table [prior]", "Initial INS error; else the INS's position_sigma_m")
    estimators: list[EstimatorTable] = key([], "tables [[estimators]]", "Methods to run")

    _folder: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _check(self) -> Self:
        kinds = [table.kind for table in self.maps]
        if len(set(kinds)) != len(kinds):
            raise ConfigError(f"[[maps]] are of kinds {', '.join(kinds)}, expected one of a kind")
        labels = [table.label or table.name for table in self.estimators]
        twice = next((label for label in labels if labels.count(label) > 1), None)
        if twice is not None:
            raise ConfigError(f"[[estimators]] has {twice!r} twice, expected a label of its own for each")
        return self

    @classmethod
    def from_toml(cls, path: str | Path) -> Scenario:
        """Read a scenario file.

        Parameters
        ----------
        path : str or Path
            Its folder is where relative map files are looked for.

        Raises
        ------
        ConfigError
            Naming the file, the table, the key, the value and what was expected.
        """
        file, values = toml_values(path, "a scenario")
        return cls.from_dict({"name": file.stem, **values}, folder=file.parent, where=str(path))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], *, folder: str | Path = ".", where: str = "scenario") -> Scenario:
        """Make a scenario of nested tables, as tomllib or `to_dict` gives them.

        Parameters
        ----------
        values : mapping
        folder : str or Path
            Where relative map files are looked for.
        where : str
            What to call the values in messages.

        Raises
        ------
        ConfigError
            As `from_toml`.
        """
        scenario = cast("Scenario", validated(cls, values, where))
        scenario._folder = Path(folder)
        return scenario

    def to_dict(self) -> dict[str, Any]:
        """The scenario as nested tables that `from_dict` takes; keys left at 'none' are left out."""
        return self.model_dump(exclude_none=True)

    def open_maps(self) -> tuple[Map, ...]:
        """Read the maps; DataError or ConfigError as `terranav.open_map`."""
        return tuple(self._open(table) for table in self.maps)

    def told_ins(self) -> InsGrade:
        """What the estimators are told of the INS."""
        true = self.ins.build()
        return true if self.ins_told is None else self.ins_told.build(true)

    def initial_prior(self) -> Prior:
        """What the estimators believe of the INS error at the start."""
        return Prior.from_ins(self.told_ins()) if self.prior is None else self.prior.build()

    def methods(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """The estimators as `terranav.compare` takes them: label -> (name, settings)."""
        return {table.label or table.name: (table.name, dict(table.settings)) for table in self.estimators}

    def seeds(self) -> tuple[int, ...]:
        """A seed for each of the runs; the same ones, however many are asked for, up to their number."""
        children = np.random.SeedSequence(self.seed).spawn(self.runs)
        return tuple(int(child.generate_state(1)[0]) for child in children)

    def _open(self, table: MapTable) -> Map:
        """Read one map."""
        given = {name: value for name, value in table.model_dump(exclude={"file"}).items() if value is not None}
        if table.file == SAMPLE:
            from terranav.maps.sample_dem import sample_map

            if table.kind != "terrain" or set(given) - {"kind", "sigma", "correlation_m", "name"}:
                raise ConfigError(
                    "[[maps]] file = 'sample' is a terrain map in metres, expected only sigma, correlation_m and name"
                )
            return replace(sample_map(), **given)
        from terranav.io.rasters import open_map

        return open_map(self._folder / table.file, **given)
