"""The papers by number: the module p000 is paper '000', and a new one needs no entry anywhere."""

from __future__ import annotations

import pkgutil
import re
from importlib import import_module
from typing import Any, cast

import terranav.experiment.papers
from terranav.core.errors import ConfigError
from terranav.experiment.papers.outcome import Reproduction, Setup

_MODULE = re.compile(r"p(\d{3})")


def papers() -> list[str]:
    """Numbers of the papers that can be reproduced, sorted: '000', '001' ... Imports none of them."""
    names = (info.name for info in pkgutil.iter_modules(terranav.experiment.papers.__path__))
    return sorted(match[1] for match in map(_MODULE.fullmatch, names) if match)


def paper_number(text: str) -> str:
    """Return the number of a paper that there is, whatever its leading zeros.

    Parameters
    ----------
    text : str
        '003' or '3'.

    Raises
    ------
    ConfigError
        When there is no such paper; it names those there are.
    """
    known = papers()
    number = text.strip().zfill(3)
    if number not in known:
        raise ConfigError(f"there is no paper {text!r}, expected one of {', '.join(known)}")
    return number


def title(number: str) -> str:
    """Title of a paper; ConfigError for an unknown number."""
    return str(_module(number).TITLE)


def reproduce(number: str, setup: Setup | None = None) -> Reproduction:
    """Run a paper's study again.

    Parameters
    ----------
    number : str
        '000' .. '004'.
    setup : Setup, optional
        Runs, seed, maps and where to run; 50 runs on the default maps unless given.

    Raises
    ------
    ConfigError
        Unknown number, or maps that this paper cannot use.
    """
    return cast("Reproduction", _module(number).reproduce(setup or Setup()))


def _module(number: str) -> Any:
    return import_module(f"{terranav.experiment.papers.__name__}.p{paper_number(number)}")
