"""The tables of a scenario file, with every key, its unit and what its value may be."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.records import Prior
from terranav.experiment.registry import check_name
from terranav.experiment.validation import unknown_key
from terranav.ins.grades import grade_named
from terranav.ins.trajectory import Route
from terranav.sensors.altimeter import Altimeter
from terranav.sensors.barometer import Barometer

_NUMBER, _POSITIVE, _NOT_NEGATIVE, _TEXT = "a number", "a number > 0", "a number >= 0", "a text"
_KINDS = "'terrain', 'bathymetry', 'gravity' or 'magnetic'"
#: what can stand in the name of a file
NAME, NAME_EXPECTED = r"^[\w .+-]+$", "letters, digits, spaces and . + - _"
Kind = Literal["terrain", "bathymetry", "gravity", "magnetic"]


def key(default: Any, expected: str, description: str, **limits: Any) -> Any:
    """A key of a table: its default, what its value should be (for messages), what it means."""
    return Field(default, description=description, json_schema_extra={"expected": expected}, **limits)


class Table(BaseModel):
    """A table whose keys are known: another one is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class OpenTable(BaseModel):
    """A table that also takes the keys of one of the package's dataclasses, which checks them."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True, allow_inf_nan=False)

    @property
    def others(self) -> dict[str, Any]:
        """The keys that the dataclass takes."""
        return dict(self.model_extra or {})


class MapTable(Table):
    """[[maps]]: a map that the estimators hold and that the sensors measure."""

    file: str = key(..., "a path, or 'sample'", "Map file, relative to the scenario's folder; 'sample': the sample DEM")
    kind: Kind = key("terrain", _KINDS, "What the map shows")
    sigma: float | None = key(None, _NOT_NEGATIVE, "1-sigma of the map error [the kind's unit: m, m, mGal, nT]", ge=0)
    correlation_m: float | None = key(None, _POSITIVE, "Correlation length of the map error; else 2.5 cells [m]", gt=0)
    crs: str | None = key(None, _TEXT, "CRS, where the file states none or a wrong one: anything that pyproj takes")
    variable: str | int | None = key(
        None, "a text, or a whole number", "Variable of a NetCDF file; a band's description, or its number from 1"
    )
    unit: str | None = key(None, _TEXT, "Unit of the file's values, where the file states none or a wrong one")
    positive_down: bool | None = key(None, "true or false", "The file holds depths: negate them")
    name: str | None = key(None, _TEXT, "What to call the map; else the file's name")


class MapErrorTable(Table):
    """[map_error]: what the true field differs from the maps by."""

    sigma: float = key(..., _NOT_NEGATIVE, "1-sigma of the difference [the kind's unit]", ge=0)
    correlation_m: float = key(100.0, _POSITIVE, "Correlation length: covariance exp(-d^2 / (2 L^2)) [m]", gt=0)


class RouteTable(Table):
    """[route]: where the vehicle truly goes."""

    waypoints_deg: list[list[float]] = key(
        ..., "a list of at least two [latitude, longitude] pairs", "Waypoints: [latitude, longitude] [deg]"
    )
    altitude_m: float | list[float] = key(
        ..., "a number, or one for each waypoint", "Altitude above the map's datum [m]; one, or one a waypoint"
    )
    speed_mps: float | list[float] = key(
        ..., "a number > 0", "Speed over the ellipsoid [m/s]; one, or one for each leg"
    )
    bank_deg: float = key(20.0, "a number > 0, at most 75", "Roll in turns [deg]", gt=0, le=75)
    turn_radius_m: float | None = key(None, _POSITIVE, "Radius of all turns, in place of bank_deg [m]", gt=0)
    roll_in_s: float = key(3.0, _POSITIVE, "Time from level to full bank [s]", gt=0)
    accel_mps2: float = key(1.0, _POSITIVE, "Largest acceleration along the track [m/s^2]", gt=0)
    rate_hz: float = key(2.0, _POSITIVE, "Epochs a second [Hz]", gt=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(len(pair) != 2 for pair in self.waypoints_deg):
            raise ConfigError("waypoints_deg holds another than [latitude, longitude], expected pairs")
        if isinstance(self.altitude_m, list) and len(self.altitude_m) != len(self.waypoints_deg):
            raise ConfigError(
                f"altitude_m has {len(self.altitude_m)} values, expected one or one a waypoint "
                f"({len(self.waypoints_deg)})"
            )
        self.build()
        return self

    def build(self) -> Route:
        """The route."""
        places = np.array(self.waypoints_deg).reshape(-1, 2)
        heights = np.broadcast_to(self.altitude_m, len(places))
        return Route(
            np.column_stack([places, heights]),
            speed_mps=self.speed_mps,
            bank_deg=self.bank_deg,
            turn_radius_m=self.turn_radius_m,
            roll_in_s=self.roll_in_s,
            accel_mps2=self.accel_mps2,
        )


class GradeTable(OpenTable):
    """A named grade of INS, or the keys of InsGrade, or a grade with some keys changed."""

    grade: str | None = key(None, "'navigation', 'tactical' or 'industrial'", "Named grade that the other keys change")

    def build(self, base: InsGrade | None = None) -> InsGrade:
        """The grade; without a name the keys change `base`, else InsGrade's own defaults."""
        start = grade_named(self.grade) if self.grade is not None else base or InsGrade()
        known = [entry.name for entry in fields(InsGrade)]
        for name in self.others:
            if name not in known:
                raise ConfigError(unknown_key(name, [*type(self).model_fields, *known]))
        return replace(start, **self.others)

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.build()
        return self


class InsTable(GradeTable):
    """[ins]: the INS that flies."""

    mode: Literal["strapdown", "drift"] = key(
        "strapdown", "'strapdown' or 'drift'", "IMU and strapdown integration, or errors drawn on position level"
    )
    imu_rate_hz: float | None = key(
        None,
        _POSITIVE,
        "Samples of the IMU a second, a multiple of [route] rate_hz; else about 50 [Hz]",
        gt=0,
    )

    @model_validator(mode="after")
    def _check_mode(self) -> Self:
        if self.mode == "strapdown" and self.grade is None:
            raise ConfigError("grade is missing, expected one that says what the IMU is like, or mode = 'drift'")
        return self


class HeightSensorTable(OpenTable):
    """A height sensor: the keys below, and those of its error model."""

    period_s: float | None = key(None, _POSITIVE, "Time between readings; else one each epoch [s]", gt=0)
    told_sigma_m: float | None = key(
        None,
        _POSITIVE,
        "1-sigma that the estimators are told; else the model's own over the flight [m]",
        gt=0,
    )


class RadarTable(HeightSensorTable):
    """[sensors.radar_altimeter]."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.build()
        return self

    def build(self) -> Altimeter:
        """The sensor."""
        return Altimeter.from_table({"kind": "radar", **self.others})


class LaserTable(HeightSensorTable):
    """[sensors.laser_altimeter]."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.build()
        return self

    def build(self) -> Altimeter:
        """The sensor."""
        return Altimeter.from_table({"kind": "laser", **self.others})


class BarometerTable(HeightSensorTable):
    """[sensors.barometer]."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.build()
        return self

    def build(self) -> Barometer:
        """The sensor."""
        return Barometer.from_table(self.others)


class FieldSensorTable(Table):
    """[sensors.bathymetry], [sensors.gravity] and so on: a sensor that reads the mapped field itself."""

    sigma: float = key(..., _POSITIVE, "1-sigma of the noise, told to the estimators [the kind's unit]", gt=0)
    bias: float = key(0.0, _NUMBER, "Constant error [the kind's unit]")
    period_s: float | None = key(None, _POSITIVE, "Time between readings; else one each epoch [s]", gt=0)


class SensorsTable(Table):
    """[sensors]: what the vehicle carries."""

    radar_altimeter: RadarTable | None = key(None, "a table", "Radar altimeter")
    laser_altimeter: LaserTable | None = key(None, "a table", "Laser altimeter, fixed to the body")
    barometer: BarometerTable | None = key(None, "a table", "Barometric altimeter")
    terrain: FieldSensorTable | None = key(None, "a table", "Terrain height, as if measured at once")
    bathymetry: FieldSensorTable | None = key(None, "a table", "Height of the seabed")
    gravity: FieldSensorTable | None = key(None, "a table", "Gravity anomaly")
    magnetic: FieldSensorTable | None = key(None, "a table", "Magnetic anomaly")


class PriorTable(Table):
    """[prior]: what the estimators believe of the INS error at the start."""

    mean_m: list[float] = key([0.0, 0.0], "two numbers: north, east", "Mean error, north and east [m]")
    sigma_m: float | list[float] = key(
        ..., "a number > 0, or two: north, east", "1-sigma of the error; one, or north and east [m]"
    )
    shape: Literal["gaussian", "uniform"] = key("gaussian", "'gaussian' or 'uniform'", "Uniform: flat over +-3 sigma")

    @model_validator(mode="after")
    def _check(self) -> Self:
        sigma = self.sigma_m if isinstance(self.sigma_m, list) else [self.sigma_m] * 2
        if len(sigma) != 2 or min(sigma) <= 0.0:
            raise ConfigError(f"sigma_m is {self.sigma_m!r}, expected a number > 0, or two: north, east")
        self.build()
        return self

    def build(self) -> Prior:
        """The prior."""
        sigma = np.broadcast_to(self.sigma_m, 2)
        return Prior(np.array(self.mean_m), np.diag(sigma**2), self.shape)


class EstimatorTable(Table):
    """[[estimators]]: a method to run."""

    name: str = key(..., "the name of an estimator", "Name of the method, from terranav.estimators()")
    label: str | None = key(
        None, NAME_EXPECTED, "What to call it in tables and file names; else its name", pattern=NAME
    )
    settings: dict[str, Any] = key({}, "a table", "Settings of the method")

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_name(self.name)
        return self
