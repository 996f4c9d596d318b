"""The typer application of ``mkc``: each command is a function in a file of its own.

A command imports torch and other slow packages after its options are checked, so that help and wrong arguments are
answered at once.
"""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from mkc_torch.cli.apply import apply
from mkc_torch.cli.calibrate import calibrate
from mkc_torch.cli.check import check
from mkc_torch.cli.demo import demo
from mkc_torch.cli.diagnose import diagnose
from mkc_torch.cli.doctor import doctor
from mkc_torch.cli.effects import effects
from mkc_torch.cli.export import export
from mkc_torch.cli.inspect import inspect
from mkc_torch.cli.new import new_effect, new_simulation


class _Commands(TyperGroup):
    """A typer group that does not import pydantic to show help."""

    def get_help_option(self, ctx: Any) -> Any:
        option = super().get_help_option(ctx)
        if option is not None:
            option.default = False  # pydantic validates None; importing it takes longer than all other imports
        return option

    def get_params(self, ctx: Any) -> list[Any]:
        params = super().get_params(ctx)
        for param in params:
            if param.name in ("install_completion", "show_completion"):
                param.default = False  # as above
        return params


app = typer.Typer(
    cls=_Commands,
    help="Find the physics that a simulation lacks; calibrate sensors; correct recordings. `mkc demo` needs no file.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(requested: bool) -> None:
    if requested:
        from mkc_torch import __version__

        typer.echo(f"mkc {__version__}")
        raise typer.Exit


@app.callback()
def _all_commands(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of ``mkc`` itself."""


app.command(short_help="Find the physics that a simulation lacks.")(diagnose)
app.command(short_help="Calibrate a magnetometer or an accelerometer.")(calibrate)
app.command(short_help="Correct a recording with a calibration or a model.")(apply)
app.command(short_help="Check a model on recordings that no fit has used.")(check)
app.command(short_help="Write a calibration for an autopilot, ROS or C.")(export)
app.command(short_help="Show what a file holds, and which commands take it.")(inspect)
app.command(short_help="List the effects, and where each can act in a simulation.")(effects)
app.command(short_help="Try all of it on simulated sensors; needs no file.")(demo)
app.command(short_help="Show what is installed, and what is missing.")(doctor)
app.command(short_help="Write a template for your own simulation.")(new_simulation)
app.command(short_help="Write a template for your own effect.")(new_effect)
