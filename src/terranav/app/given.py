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


WHOLE_CELLS = 2**24  # a map of at most so many cells (64 MiB) is read whole
REACH = 10.0  # sigmas of the INS by its grade, which may be told too well
MARGIN_M = 5000.0


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
        return rec, open_maps(self.maps, self.map_options, rec, told), told


def open_maps(
    paths: Sequence[Path],
    options: Mapping[str, Sequence[Any] | None],
    rec: Recording | None = None,
    ins: InsGrade | None = None,
) -> tuple[Map, ...]:
    """Open each map; of one with more than WHOLE_CELLS cells only what the INS may be over (`reach_box`) is read.

    Parameters
    ----------
    paths : sequence of Path
    options : mapping
        Option (kind, sigma, correlation, crs, variable, unit) to its values: none, one for all maps, or one for each
        map in their order.
    rec : Recording, optional
        Without it every map is read whole.
    ins : InsGrade, optional
        By default the recording's.

    Raises
    ------
    ConfigError, DataError
    """
    from terranav.io.rasters import cell_count, open_map

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
    for path, keywords in zip(paths, each, strict=True):
        if rec is not None and cell_count(path, keywords.get("variable")) > WHOLE_CELLS:
            keywords["box"] = reach_box(rec, ins)
    return tuple(open_map(path, **keywords) for path, keywords in zip(paths, each, strict=True))


def reach_box(rec: Recording, ins: InsGrade | None = None) -> tuple[float, float, float, float]:
    """Where the vehicle may be: south, west, north and east of the track with REACH sigmas of an unaided INS [deg].

    A track within a degree of a pole, or one that goes around the Earth, may be at any longitude.
    """
    import numpy as np

    from terranav.core.earth import shift
    from terranav.core.ins_grade import InsGrade

    grade = ins or rec.ins or InsGrade()
    last_s = float(rec.time_s[-1] - rec.time_s[0])
    sigma_m = (grade.position_sigma_m**2 + grade.position_growth_m2(0.0, last_s)) ** 0.5
    margin_m = REACH * sigma_m + MARGIN_M
    lat, lon = rec.lat_deg, np.unwrap(rec.columns["lon_deg"], period=360.0)
    south, north = (
        float(shift(end, 0.0, away, 0.0)[0]) for end, away in ((lat.min(), -margin_m), (lat.max(), margin_m))
    )
    furthest = max(abs(south), abs(north))
    if furthest > 89.0:
        return max(south, -90.0), -180.0, min(north, 90.0), 179.999999
    wide = float(shift(furthest, 0.0, 0.0, margin_m)[1])
    west, east = float(lon.min()) - wide, float(lon.max()) + wide
    return (south, -180.0, north, 179.999999) if east - west >= 360.0 else (south, west, north, east)


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
