"""The studies by name."""

from __future__ import annotations

from importlib import import_module

from terranav.core.checks import unknown_name
from terranav.experiment.studies.study import Study

#: name of the command -> module whose STUDY it is
_HOMES = {
    "bound": "bound",
    "consistency": "consistency",
    "integrity": "integrity_study",
    "monitor": "monitor",
    "plan": "plan",
    "real": "real",
    "robust": "robust",
    "routes": "routes",
}


def studies() -> list[str]:
    """Names of the studies, in the order in which they are told of. Imports none of them."""
    return list(_HOMES)


def study_named(name: str) -> Study:
    """A study.

    Raises
    ------
    ConfigError
        There is none of this name; it offers the nearest.
    """
    if name not in _HOMES:
        unknown_name("study", name, _HOMES)
    found = import_module(f"terranav.experiment.studies.{_HOMES[name]}").STUDY
    assert isinstance(found, Study)
    return found
