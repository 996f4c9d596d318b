"""Processes that tests start and interrupt; they receive interrupts in every environment and end with their test."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any


@contextmanager
def started(*arguments: object, **options: Any) -> Iterator["subprocess.Popen[str]"]:
    """Run this Python with the arguments, in a process group of its own that ends with the block.

    A process ignores the signals that its parent ignores, and a background shell ignores interrupts; a handler of
    Python is not inherited, so that the process receives them.
    """
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = subprocess.Popen(
            [sys.executable, *map(str, arguments)],
            **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True} | options,
        )
    finally:
        signal.signal(signal.SIGINT, usual)
    with process:
        try:
            yield process
        finally:
            with suppress(ProcessLookupError):  # it ended, and all that it started
                os.killpg(process.pid, signal.SIGKILL)
