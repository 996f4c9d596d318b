"""``mkc``: the command line. The commands themselves are in ``mkc_torch._commands`` and need the ``cli`` extra."""

from __future__ import annotations

import io
import sys

_EXTRA = ("typer", "rich", "polars", "matplotlib", "jinja2")


def main() -> None:
    """Run ``mkc`` with the arguments of the process.

    Raises:
        SystemExit: always; 0 when all was done, 1 when something failed, 2 for a command that makes no sense.
    """
    try:
        from mkc_torch._commands import app
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in _EXTRA:
            raise
        sys.exit(f'mkc: {missing} is not installed; install the command line with `pip install "mkc-torch[cli]"`.')
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a pipe's encoding may lack σ and ±
    app(prog_name="mkc")


if __name__ == "__main__":
    main()
