"""The commands of ``mkc``, one a file, each a function that typer makes a command of.

What takes long to import, torch before all, is imported where a command has understood its options, so that help and
mistakes are answered at once.
"""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mkc_torch.cli.apply import apply
from mkc_torch.cli.calibrate import calibrate
from mkc_torch.cli.challenge import challenge
from mkc_torch.cli.demo import demo
from mkc_torch.cli.diagnose import diagnose
from mkc_torch.cli.export import export
from mkc_torch.cli.inspect import inspect
from mkc_torch.cli.new import new_effect, new_simulation

__all__ = ["app"]


class _Commands(TyperGroup):
    """The commands; which one is asked for, and how it is asked for help, is known without pydantic."""

    def get_help_option(self, ctx: Any) -> Any:
        option = super().get_help_option(ctx)
        if option is not None:
            option.default = False  # None is checked by pydantic, which takes longer to import than all the rest
        return option


app = typer.Typer(
    cls=_Commands,
    help="Find what a simulation lacks, calibrate, apply. `mkc demo` shows it, no file needed.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _say_version(asked: bool) -> None:
    if asked:
        from mkc_torch import __version__

        typer.echo(f"mkc {__version__}")
        raise typer.Exit


@app.callback()
def _all_commands(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say which version this is.")
    ] = False,
) -> None:
    """Options of no command in particular."""


app.command()(diagnose)
app.command()(calibrate)
app.command()(apply)
app.command()(export)
app.command()(inspect)
app.command()(challenge)
app.command()(demo)
app.command()(new_simulation)
app.command()(new_effect)
