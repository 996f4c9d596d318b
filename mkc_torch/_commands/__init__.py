"""The commands of ``mkc``, one a file, each a function that typer makes a command of."""

import jinja2  # noqa: F401 - so that what is missing is said at once, not after the work
import matplotlib  # noqa: F401
import polars  # noqa: F401
import typer

from mkc_torch._commands.apply import apply
from mkc_torch._commands.calibrate import calibrate
from mkc_torch._commands.demo import demo

__all__ = ["app"]

app = typer.Typer(
    help="Calibrate magnetometers by robust likelihoods: `mkc demo` shows it, no file needed.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command()(calibrate)
app.command()(apply)
app.command()(demo)
