"""Docstrings as the site shows them: examples as code, and each argument by its own name."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc|obj):`~?([^`]+)`")
_EXAMPLE = re.compile(r"^Example:$", re.MULTILINE)
_SECTION = re.compile(r"^(?:Args|Attributes):\n(?:(?: .*)?\n?)+", re.MULTILINE)
_TOGETHER = re.compile(r"^    ((?:\w+, )+\w+):((?:.*\n?)(?:     .*\n?)*)", re.MULTILINE)


class Docstrings(griffe.Extension):
    """Bring what this project writes, and editors and people read, into what griffe's style "google" takes."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Called by griffe once a package is read: ``MKCLoss`` comes first on the page of the losses."""
        losses = pkg.members.get("losses")
        loss = None if losses is None else losses.members.get("MKCLoss")
        if isinstance(loss, griffe.Alias):
            loss.alias_lineno = 0

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called by griffe once an object and what is in it are read."""
        if obj.docstring is not None:
            obj.docstring.value = google(obj.docstring.value)


def google(text: str) -> str:
    r"""The text with "Examples:" for "Example:", names for the roles of Sphinx, and an entry for each argument.

    Example:
        >>> google("See :func:`fit`.\n\nArgs:\n    a, b: bounds.\n\nExample:\n    >>> 1\n")
        'See `fit`.\n\nArgs:\n    a: bounds.\n    b: bounds.\n\nExamples:\n    >>> 1\n'
    """
    text = _ROLE.sub(r"`\1`", _EXAMPLE.sub("Examples:", text))
    return _SECTION.sub(lambda section: _TOGETHER.sub(_each, section[0]), text)


def _each(entry: re.Match[str]) -> str:
    """An entry of several names as one of each, all with its text."""
    entry_text = entry[2].rstrip("\n")
    entries = "\n".join(f"    {name}:{entry_text}" for name in entry[1].split(", "))
    return entries + entry[2][len(entry_text) :]
