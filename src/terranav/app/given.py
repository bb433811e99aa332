"""What was typed, made into maps, a recording and an INS: checked before anything long starts."""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from terranav.core.checks import finite, nearest_name
from terranav.core.errors import ConfigError

if TYPE_CHECKING:
    from terranav.core.ins_grade import InsGrade
    from terranav.core.recording import Recording
    from terranav.maps.map import Map

#: said for --map, the embedded one
SAMPLE = Path("sample")


@dataclass(frozen=True)
class Given:
    """The options that `run` and `compare` share.

    Attributes
    ----------
    recording : Path
    maps : sequence of Path
    map_options : mapping
        As for `open_maps`.
    ins, drift : str
        A grade's name, three numbers or a TOML file (see `ins_from`); empty for none.
    drift_seed : int
    first_s : float
        Use only this much of the recording from its start [s].
    """

    recording: Path
    maps: Sequence[Path] = ()
    map_options: Mapping[str, Sequence[Any] | None] = field(default_factory=dict)
    ins: str = ""
    drift: str = ""
    drift_seed: int = 0
    first_s: float | None = None

    def read(self) -> tuple[Recording, tuple[Map, ...], InsGrade | None]:
        """The recording, with its drift if one is wanted, the maps, and the INS that the estimators are told of."""
        from terranav.io.recordings import read_recording

        told = ins_from("--ins", self.ins) if self.ins else None
        drift = ins_from("--drift", self.drift) if self.drift else None
        rec = read_recording(self.recording)
        if self.first_s is not None:
            start_s = float(rec.time_s[0])
            rec = rec.between(start_s, start_s + finite("--first", self.first_s, above=0.0))
        if drift is not None:
            from terranav.ins.drift import add_drift

            rec = add_drift(rec, drift, self.drift_seed)
        return rec, open_maps(self.maps, self.map_options), told


def open_maps(paths: Sequence[Path], options: Mapping[str, Sequence[Any] | None]) -> tuple[Map, ...]:
    """Open each map; a folder of tiles is one, and 'sample' the embedded one.

    Parameters
    ----------
    paths : sequence of Path
    options : mapping
        Option (kind, sigma, correlation, crs, variable, unit) to its values: none, one for all maps, or one for each
        map in their order.

    Raises
    ------
    ConfigError, DataError
    """
    n = len(paths)
    each: list[dict[str, Any]] = [{} for _ in paths]
    for key, values in options.items():
        if values and len(values) not in (1, n):
            raise ConfigError(
                f"--map-{key} is given {len(values)} times for {n} maps, expected once, or once for each map"
            )
        for i in range(n if values else 0):
            each[i]["correlation_m" if key == "correlation" else key] = (values or ())[
                i if len(values or ()) == n else 0
            ]
    return tuple(one_map(path, "map-", **keywords) for path, keywords in zip(paths, each, strict=True))


def one_map(path: Path, prefix: str = "", **options: Any) -> Map:
    """A map in a file or a folder of tiles, or the embedded one.

    Parameters
    ----------
    path : Path
    prefix : str
        Of the options that were typed, such as 'map-', for messages.
    **options
        Of `terranav.io.rasters.open_map`.
    """
    from terranav.io.rasters import open_map

    chart = embedded(path, options, prefix)
    return open_map(path, **options) if chart is None else chart


def embedded(path: Path, options: Mapping[str, Any], prefix: str = "") -> Map | None:
    """The map that needs no file where 'sample' is said and no such file is there; it is what it is."""
    from terranav.maps.sample_dem import sample_map

    if path != SAMPLE or path.exists():
        return None
    told = [key for key, value in options.items() if value not in (None, False, "terrain")]
    if told:
        name = told[0].removesuffix("_m").replace("_", "-")
        prefix = "map-" if name in ("datum", "correlation") else prefix
        raise ConfigError(f"--{prefix}{name} is given for the embedded map 'sample', expected a map in a file")
    return sample_map()


def place_from(name: str, text: str) -> tuple[float, float]:
    """Latitude and longitude from what was typed."""
    try:
        lat, lon = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"{name} is {text!r}, expected latitude,longitude in degrees such as 47.5,9.3") from None
    return (
        finite(f"{name} latitude", lat, minimum=-90.0, maximum=90.0),
        finite(f"{name} longitude", lon, minimum=-180.0, maximum=360.0),
    )


def ins_from(option: str, text: str) -> InsGrade:
    """An INS from what was typed.

    Parameters
    ----------
    option : str
        Where it was typed, for messages.
    text : str
        A grade's name ('tactical'); or position_sigma_m,velocity_sigma_mps,walk_m_per_sqrt_s ('500,0.05,0.3'), the last
        one or two left out being zero; or a TOML file with a table [ins].

    Raises
    ------
    ConfigError
    """
    from terranav.core.ins_grade import InsGrade
    from terranav.ins.grades import GRADES

    if text in GRADES:
        return GRADES[text]
    if text.endswith(".toml"):
        return _ins_file(text)
    expected = f"three numbers such as 500,0.05,0.3 (m, m/s, m/sqrt(s)), a .toml file or one of {', '.join(GRADES)}"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} is {text!r}, expected {expected}{nearest_name(text, GRADES)}") from None
    if len(numbers) > 3:
        raise ConfigError(f"{option} is {text!r}, expected {expected}")
    position, velocity, walk = [*numbers, 0.0, 0.0][:3]
    try:
        return InsGrade(position, velocity, walk)
    except ConfigError as error:
        raise ConfigError(f"{option} is {text!r}: {error}") from None


def settings_from(texts: Sequence[str]) -> dict[str, Any]:
    """Settings of an estimator from texts such as 'window=48'; a value is what TOML reads it as, else a text."""
    settings: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set is {text!r}, expected key=value")
        try:
            settings[key.strip()] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            settings[key.strip()] = value.strip()
    return settings


def folder_for(out: Path | None) -> Path | None:
    """Make the output folder and try to write into it, so that no long run ends in vain."""
    if out is None:
        return None
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except FileExistsError:
        raise ConfigError(f"--out {out}: is a file, expected a folder") from None
    except OSError as error:
        raise ConfigError(f"--out {out}: cannot be written ({error.strerror}), expected a writable folder") from None
    return out


def _ins_file(path: str) -> InsGrade:
    """The table [ins] of a TOML file."""
    from terranav.io.sidecar import about_from
    from terranav.io.toml_table import read_toml

    table = read_toml(path, "a TOML file with a table [ins]", ConfigError)
    about = about_from(table)
    if about.ins is None:
        table.missing("[ins]", "a table with keys such as position_sigma_m")
    return about.ins
