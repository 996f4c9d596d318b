"""``mkc``: the entry point of the command line. The commands are in ``mkc_torch.cli.app``; extra ``cli``."""

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
        SystemExit: always. Exit codes: 0 success, 1 failure, 2 wrong arguments, 3 a doubtful result, 130
            interrupted.
    """
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:  # a background job ignores the signal; leave that
        signal.signal(signal.SIGINT, _quit)
    # find_spec does not import: a missing package is reported at once, and no time is spent on imports
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
    except KeyboardInterrupt:  # a second Ctrl-C while the first is handled
        sys.exit(130)
    except OSError as error:
        if error.filename is not None:
            raise
        # flushing the streams when Python exits would fail again
        os.write(2, f"mkc: the output could not be written: {error.strerror}.\n".encode())
        os._exit(1)


def _begin(usual: Callable[[int, FrameType | None], object] | int | None) -> None:
    """Prepare the process after its imports: keep modules, allow forks, restore the interrupt handler."""
    from mkc_torch._parallel.pool import allow_copies
    from mkc_torch._parallel.processes import keep_modules

    keep_modules()
    allow_copies()
    signal.signal(signal.SIGINT, usual)


def _quit(_signal: int, _frame: FrameType | None) -> None:
    """Exit at once: an import in progress may swallow an exception, and no file is open yet."""
    os.write(2, b"mkc: interrupted; nothing was written.\n")
    os._exit(130)
