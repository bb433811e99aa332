"""The folder of a campaign or a study: what it is, and one Parquet file for each chunk that is done.

Every file is written aside and renamed, so a chunk is either there and whole, or not there. What a kill leaves behind
is a part beside it, which is cleared away.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from terranav._version import __version__
from terranav.core.errors import ConfigError, DataError, DataWarning
from terranav.io.files import replacing
from terranav.io.results import read_result_table, write_result_table

SUMMARY = "summary.json"

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Folder:
    """A campaign's folder.

    Attributes
    ----------
    path : Path
    fingerprint : str
        Of the campaign that it is for.
    what : str
        What it holds, for messages and the manifest's name: 'campaign' or 'study'.
    differs : str
        What may differ when the fingerprint does, for messages.
    """

    path: Path
    fingerprint: str
    what: str = "campaign"
    differs: str = "its file, a scenario or a map"

    @property
    def manifest(self) -> Path:
        """The file that says what the folder is."""
        return self.path / f"{self.what}.json"

    @property
    def _format(self) -> str:
        return f"terranav-{self.what}-1"

    def begin(self, facts: Mapping[str, Any], *, resume: bool) -> None:
        """Make the folder this campaign's, or see that it is.

        Parameters
        ----------
        facts : mapping
            What the campaign is, as plain JSON values, for people who open the folder.
        resume : bool
            Whether it may hold a part of the campaign already.

        Raises
        ------
        ConfigError
            The folder holds anything and `resume` is not set; or another campaign, or one of another version.
        DataError
            It cannot be written, or its manifest cannot be read.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            held = [entry for entry in self.path.iterdir() if not entry.name.endswith(".part")]
        except FileExistsError:
            raise ConfigError(f"{self.path}: is a file, expected a folder") from None
        except OSError as problem:
            raise DataError(f"{self.path}: cannot be written ({problem.strerror}), expected a folder") from None
        if held and not resume:
            what = f"holds a {self.what}" if self.manifest.exists() else "is not empty"
            raise ConfigError(f"{self.path}: {what} already, expected a new folder, or --resume to go on with it")
        for part in self.path.glob(".*.part"):
            with suppress(OSError):
                part.unlink()
        if self.manifest.exists():
            self._check()
        elif held:
            raise ConfigError(
                f"{self.path}: is not empty and holds no {self.manifest.name}, expected the folder of a {self.what}"
            )
        else:
            manifest = {"format": self._format, "terranav": __version__, "fingerprint": self.fingerprint, **facts}
            with replacing(self.manifest) as aside:
                aside.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")

    def chunk_path(self, number: int) -> Path:
        """File of a chunk."""
        return self.path / f"chunk-{number:05d}.parquet"

    def write(self, number: int, columns: Columns) -> None:
        """Write a chunk in one go; DataError when that cannot be done."""
        write_result_table(self.chunk_path(number), columns, {"fingerprint": self.fingerprint, "chunk": str(number)})

    def read(self, number: int, keys: set[tuple[str, str, int]]) -> Columns | None:
        """A chunk that is done and whole, None for one that must be run.

        Parameters
        ----------
        number : int
        keys : set of (scenario, estimator, run)
            What it must hold, each once.

        Warns
        -----
        DataWarning
            A file is there, but damaged or not this chunk's.
        """
        path = self.chunk_path(number)
        if not path.exists():
            return None
        try:
            columns, metadata = read_result_table(path)
            wrong = self._wrong(number, keys, columns, metadata)
        except DataError as problem:
            wrong = str(problem).removeprefix(f"{path}: ")
        if wrong:
            warnings.warn(f"{path}: {wrong}; its runs are run again", DataWarning, stacklevel=2)
            return None
        return columns

    def _wrong(
        self, number: int, keys: set[tuple[str, str, int]], columns: Columns, metadata: Mapping[str, bytes]
    ) -> str:
        """Why a readable file is not the chunk; empty when it is."""
        said = metadata.get("fingerprint", b"").decode(), metadata.get("chunk", b"").decode()
        if said != (self.fingerprint, str(number)):
            return f"is a chunk of another {self.what} or place"
        if not {"scenario", "estimator", "run"} <= set(columns):
            return "lacks columns"
        held = list(zip(*(columns[key].tolist() for key in ("scenario", "estimator", "run")), strict=True))
        return "" if len(held) == len(keys) and set(held) == keys else "does not hold the runs that it should"

    def _check(self) -> None:
        """Raise ConfigError unless the folder's manifest is this campaign's."""
        path = self.manifest
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            if not isinstance(manifest, dict) or manifest.get("format") != self._format:
                raise ValueError
        except (OSError, ValueError):
            raise DataError(f"{path}: is not readable, expected the manifest of a {self.what}") from None
        if manifest.get("terranav") != __version__:
            raise ConfigError(
                f"{self.path}: was begun with terranav {manifest.get('terranav')}, this is {__version__}, "
                "expected the same version or a new folder"
            )
        if manifest.get("fingerprint") != self.fingerprint:
            raise ConfigError(
                f"{self.path}: holds another {self.what} ({manifest.get('name')!r}: {self.differs} differs), "
                "expected the same one or a new folder"
            )


def joined(chunks: list[Columns]) -> Columns:
    """Chunks one below the other."""
    return {key: np.concatenate([chunk[key] for chunk in chunks]) for key in chunks[0]}
