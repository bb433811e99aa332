"""terranav estimators: what there is to choose from."""

from __future__ import annotations

from terranav.app.commands import options


def estimators(as_json: options.Json = False) -> int:
    """List the estimators with what each is."""
    from terranav.app.console import OK, show, show_json
    from terranav.app.listing import described_estimators, estimators_table

    found = described_estimators()
    if as_json:
        show_json(found)
    else:
        show(estimators_table(found))
    return OK
