"""A module that a command needs in the end, loaded while it computes."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from importlib import import_module
from threading import Thread

__all__ = ["load_early"]

_TURN = 2e-4
"""Seconds after which threads change places meanwhile: most calls of torch are shorter than Python's 5 ms."""


def load_early(module: str) -> None:
    """Begin to load a module, in a thread that ends before this process is forked: a copy would wait for it for ever.

    Args:
        module: one that loads nothing of this package, so that neither thread waits for what the other one has begun.
            One that cannot be loaded says so where it is used.
    """
    if module in sys.modules:
        return
    thread = Thread(target=_load, args=(module,))
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=thread.join)
    thread.start()


def _load(module: str) -> None:
    usual = sys.getswitchinterval()
    sys.setswitchinterval(_TURN)
    try:
        with suppress(Exception):
            import_module(module)
    finally:
        sys.setswitchinterval(usual)
