"""Arguments of a user's functions: values as attributes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any


class Names(SimpleNamespace):
    """Values as attributes; the error of a missing name lists the names.

    Example:
        >>> Names(climb=1.0).clmb
        Traceback (most recent call last):
        AttributeError: there is no `clmb` here; there is climb. Names are those of `states`, `inputs`, `parameters`.
    """

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        known = ", ".join(vars(self)) or "nothing"
        raise AttributeError(
            f"there is no `{name}` here; there is {known}. Names are those of `states`, `inputs`, `parameters`."
        )
