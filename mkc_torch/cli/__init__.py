"""``mkc``: the command line. The commands themselves are in ``mkc_torch.cli.app`` and need the ``cli`` extra."""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import Callable
from importlib.util import find_spec
from types import FrameType

_EXTRA = ("typer", "rich", "polars", "matplotlib", "jinja2", "jsonschema", "threadpoolctl")


def main() -> None:
    """Run ``mkc`` with the arguments of the process.

    Raises:
        SystemExit: always; 0 when all was done, 1 when something failed, 2 for a command that makes no sense, 130 when
            it was interrupted.
    """
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:  # and not what ignores it, as in the background of a shell
        signal.signal(signal.SIGINT, _quit)
    # found, not imported: what is missing is said at once and not after the work, and what is not needed costs no time
    missing = next((name for name in _EXTRA if find_spec(name) is None), None)
    if missing is not None:
        sys.exit(f'mkc: {missing} is not installed; install the command line with `pip install "mkc-torch[cli]"`.')
    from mkc_torch.cli.app import app
    from mkc_torch.cli.loading import when_loaded

    when_loaded(lambda: _begin(usual))
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a pipe's encoding may lack σ and ±
    try:
        app(prog_name="mkc")
    except KeyboardInterrupt:  # a second one, while the first was being dealt with
        sys.exit(130)
    except OSError as error:
        if error.filename is not None:
            raise
        # what streams still hold would fail again when Python ends
        os.write(2, f"mkc: what it says could not be written: {error.strerror}.\n".encode())
        os._exit(1)


def _begin(usual: Callable[[int, FrameType | None], object] | int | None) -> None:
    """Make the process the command's own, now that it has loaded what it needs."""
    from mkc_torch._parallel.pool import allow_copies
    from mkc_torch._parallel.processes import keep_modules

    keep_modules()
    allow_copies()
    signal.signal(signal.SIGINT, usual)


def _quit(_signal: int, _frame: FrameType | None) -> None:
    """End at once: what is being imported may take an exception for a failure of its own, and nothing is open yet."""
    os.write(2, b"mkc: interrupted; nothing was written.\n")
    os._exit(130)
