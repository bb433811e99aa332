"""Estimators by name: one module in filters/ or matchers/ is one method, and the module's name is its name."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable, Sequence
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import Any, cast

import terranav.filters
import terranav.matchers
from terranav.core.checks import unknown_name
from terranav.core.errors import ConfigError
from terranav.core.ins_grade import InsGrade
from terranav.core.protocols import Estimator, Matcher
from terranav.maps.map import Map, as_maps

_ADAPTER = "windowed"  # makes an Estimator of a Matcher; not a method of its own
_GIVEN = ("maps", "ins", "matcher", "estimator")  # fields that are not settings
_MONITOR = "terranav.integrity.monitored"
_WATCHED = ("innovations", "restarted", "excluding")  # a method that has these is watched by an integrity monitor


def estimators() -> list[str]:
    """Names of every method that `run` takes, sorted. Imports none of them."""
    return sorted(_homes())


def make_estimator(
    estimator: str | Estimator[Any] | Matcher, maps: Map | Iterable[Map], ins: InsGrade, **settings: Any
) -> Estimator[Any]:
    """Build an estimator from its name, or make one of an object that is one already.

    Parameters
    ----------
    estimator : str, Estimator or Matcher
        A name from `estimators()`. An Estimator is returned as it is; a Matcher is wrapped in `Windowed`.
    maps : Map or several
    ins : InsGrade
        What the estimator is told of the INS.
    **settings
        Fields of the method's dataclass; for a matcher, also those of `Windowed`; for a method that an integrity
        monitor can watch, also those of `Monitored`, and `integrity=False` for the method alone.

    Raises
    ------
    ConfigError
        Unknown estimator or setting (the nearest name is offered), a setting with an impossible value, or settings
        that an object cannot take.
    """
    if isinstance(estimator, str):
        return _from_name(estimator, as_maps(maps), ins, settings)
    if isinstance(estimator, type):
        raise ConfigError(f"estimator is the class {estimator.__name__}, expected its name or an object of it")
    if isinstance(estimator, Estimator):
        if settings:
            raise ConfigError(
                f"settings {', '.join(sorted(settings))} are given beside the object {estimator_name(estimator)!r}, "
                "expected them in the object itself"
            )
        return estimator
    if isinstance(estimator, Matcher):
        return _windowed(estimator, ins, settings, estimator_name(estimator))
    raise ConfigError(
        f"estimator is {estimator!r}, expected a name or an object with init, step and estimate, or match"
    )


def estimator_name(estimator: str | Estimator[Any] | Matcher) -> str:
    """Return the name of a method: its module's for terranav's own, its class's for any other."""
    if isinstance(estimator, str):
        return estimator
    inner = _within(estimator)
    package, _, module = type(inner).__module__.rpartition(".")
    ours = package in (terranav.filters.__name__, terranav.matchers.__name__)
    return module if ours else type(inner).__name__


def own_maps(estimator: str | Estimator[Any] | Matcher) -> tuple[Map, ...]:
    """Return the maps that an object holds, its matcher's if it has one; none for a name."""
    return tuple(getattr(_within(estimator), "maps", ()))


def _within(estimator: Any) -> Any:
    """The method inside an adapter or a monitor, or the object itself."""
    return getattr(estimator, "matcher", getattr(estimator, "estimator", estimator))


def check_name(estimator: str | Estimator[Any] | Matcher) -> None:
    """Raise ConfigError for an unknown name, offering the nearest."""
    if isinstance(estimator, str) and estimator not in _homes():
        unknown_name("estimator", estimator, _homes())


def _homes() -> dict[str, str]:
    """Name of each method and the package that holds its module."""
    return {
        info.name: package.__name__
        for package in (terranav.filters, terranav.matchers)
        for info in pkgutil.iter_modules(package.__path__)
        if not info.name.startswith("_") and info.name != _ADAPTER
    }


def _from_name(name: str, maps: tuple[Map, ...], ins: InsGrade, settings: dict[str, Any]) -> Estimator[Any]:
    """Import the module of this name and build its one class."""
    check_name(name)
    method = _class_in(f"{_homes()[name]}.{name}")
    given: dict[str, Any] = {"maps": maps, "ins": ins}
    given = {key: value for key, value in given.items() if key in _field_names(method)}
    if all(hasattr(method, name) for name in _WATCHED):
        return _monitored(name, method, given, settings)
    if hasattr(method, "step"):
        _check_settings(name, settings, _settings_of(method))
        return cast("Estimator[Any]", method(**given, **settings))
    own = _settings_of(method)
    rest = {key: value for key, value in settings.items() if key not in own}
    _check_settings(name, rest, _settings_of(_adapter()), also=own)
    matcher = method(**given, **{key: value for key, value in settings.items() if key in own})
    return _windowed(matcher, ins, rest, name)


def _monitored(name: str, method: type[Any], given: dict[str, Any], settings: dict[str, Any]) -> Estimator[Any]:
    """Build a method and, unless told otherwise, the monitor that watches it."""
    settings = dict(settings)
    watched = settings.pop("integrity", True)
    if not isinstance(watched, bool):
        raise ConfigError(f"{name} integrity is {watched!r}, expected true or false")
    own = _settings_of(method)
    mine = {key: value for key, value in settings.items() if key in own}
    rest = {key: value for key, value in settings.items() if key not in own}
    monitor = _class_in(_MONITOR)
    _check_settings(name, rest, _settings_of(monitor) if watched else [], also=(*own, "integrity"))
    inner = method(**given, **mine)
    return cast("Estimator[Any]", monitor(inner, **rest) if watched else inner)


def _windowed(matcher: Matcher, ins: InsGrade, settings: dict[str, Any], name: str) -> Estimator[Any]:
    """Wrap a matcher so that it runs over the stream."""
    adapter = _adapter()
    _check_settings(name, settings, _settings_of(adapter))
    return cast("Estimator[Any]", adapter(matcher=matcher, ins=ins, **settings))


def _adapter() -> type[Any]:
    return _class_in(f"{terranav.matchers.__name__}.{_ADAPTER}")


def _class_in(module_name: str) -> type[Any]:
    """Return the one public class with step() or match() that a module defines."""
    module = import_module(module_name)
    found = [
        value
        for key, value in vars(module).items()
        if isinstance(value, type)
        and value.__module__ == module.__name__
        and not key.startswith("_")
        and is_dataclass(value)
        and (hasattr(value, "step") or hasattr(value, "match"))
    ]
    if len(found) != 1:
        names = ", ".join(cls.__name__ for cls in found) or "none"
        raise ConfigError(f"{module.__name__} defines {names}, expected exactly one dataclass with step() or match()")
    return found[0]


def _field_names(cls: type[Any]) -> list[str]:
    return [entry.name for entry in fields(cls) if entry.init]


def _settings_of(cls: type[Any]) -> list[str]:
    return [name for name in _field_names(cls) if name not in _GIVEN]


def _check_settings(name: str, settings: dict[str, Any], known: list[str], also: Sequence[str] = ()) -> None:
    """Raise ConfigError for the first unknown setting, offering the nearest name."""
    for key in settings:
        if key not in known:
            unknown_name(f"setting of {name!r}", key, (*also, *known))
