"""The command line: `terranav COMMAND`. Errors are one line on stderr; see `app.console` for the exit statuses."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from typing import Annotated

import typer
import typer.main

from terranav.app.commands import maps, plan
from terranav.app.commands.bench import bench
from terranav.app.commands.campaign import campaign
from terranav.app.commands.compare import compare
from terranav.app.commands.convert import convert
from terranav.app.commands.cue import cue
from terranav.app.commands.demo import demo
from terranav.app.commands.doctor import doctor
from terranav.app.commands.estimators import estimators
from terranav.app.commands.fly import fly
from terranav.app.commands.leg import leg
from terranav.app.commands.live import live
from terranav.app.commands.locate import locate
from terranav.app.commands.monitor import monitor
from terranav.app.commands.replay import replay
from terranav.app.commands.reproduce import reproduce
from terranav.app.commands.route import route
from terranav.app.commands.run import run
from terranav.app.commands.simulate import simulate
from terranav.app.commands.study import study
from terranav.app.console import INCOMPLETE, OK, STOPPED, WRONG, complain, data_warnings, silence_broken_pipe
from terranav.core.errors import TerranavError

#: what typer raises for wrong use: BadParameter is public, its bases are not in every version of typer
_WRONG_USE: type[Exception] = typer.BadParameter.__mro__[2]

app = typer.Typer(
    name="terranav",
    help="Where a vehicle is, without satellites: match what it measures with a map. Start with: terranav demo",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in (demo, run, compare, simulate, convert, replay, cue, locate, monitor, campaign, study, bench):
    app.command()(command)
app.add_typer(maps.app, name="map")
plan.app.command()(route)
plan.app.command()(leg)
app.add_typer(plan.app, name="plan")
app.command()(reproduce)
app.command()(estimators)
app.command()(live)
app.command()(doctor)
app.command()(fly)


def _version(wanted: bool) -> None:
    if wanted:
        from terranav import __version__

        typer.echo(f"terranav {__version__}")
        raise typer.Exit


@app.callback()
def _about(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    """Where a vehicle is, without satellites: match what it measures with a map. Start with: terranav demo"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Without the program's name; sys.argv's unless given.

    Returns
    -------
    int
        Exit status: 0 done, 1 done but something was left out, 2 wrong use or wrong input, 130 stopped.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with data_warnings():
            status = _run(given)
        sys.stdout.flush()
    except BrokenPipeError:
        silence_broken_pipe()
        return INCOMPLETE
    except TerranavError as error:
        complain(error)
        return WRONG
    except (KeyboardInterrupt, typer.Abort):
        return _stopped()
    except (OSError, MemoryError) as error:
        complain(f"{type(error).__name__}: {error}")
        return INCOMPLETE
    return _stopped() if status == STOPPED else status


def _run(given: list[str]) -> int:
    """Hand the arguments to typer; wrong use is one line that names the nearest option where there is one."""
    command = typer.main.get_command(app)
    try:
        status = command.main(given, prog_name="terranav", standalone_mode=False, obj=f"terranav {shlex.join(given)}")
    except _WRONG_USE as error:
        complain(_wrong_use(error))
        return WRONG
    return status if isinstance(status, int) else OK


def _wrong_use(error: Exception) -> str:
    """What typer says, the nearest name first, and where to read on."""
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else "terranav"
    near = getattr(error, "possibilities", None)
    message = str(getattr(error, "message", "") if near else error.format_message())  # type: ignore[attr-defined]
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"{message.strip().removesuffix('.')}{hint} (see: {path} --help)"


def _stopped() -> int:
    complain("stopped", "note")
    return STOPPED
