"""Arguments of a user's functions: values as attributes."""

from __future__ import annotations

from collections.abc import Mapping
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


def watched(values: Mapping[str, Any]) -> tuple[Names, set[str]]:
    """Return values as attributes, and a set to which each name is added when it is read.

    Example:
        >>> p, read = watched({"mass": 1.0, "drag": 0.1})
        >>> p.mass, read
        (1.0, {'mass'})
    """
    read: set[str] = set()

    class Watched(Names):
        def __getattribute__(self, name: str) -> Any:
            read.update(values if name == "__dict__" else {name})
            return super().__getattribute__(name)

    return Watched(**values), read
