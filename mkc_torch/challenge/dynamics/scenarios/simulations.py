"""Write the file of a simulation for the diagnosis of a recording: one class, with its own starting values."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

from torch import Generator

from mkc_torch.challenge.draws import happens
from mkc_torch.challenge.dynamics.scenarios.wrong import WRONG_SIGN

NOMINAL = Path(__file__).parents[1] / "nominal_models.py"
WRONG = Path(__file__).with_name("wrong_simulations.py")

FAR = 10.0
"""Factor by which each starting value is too large or too small in the scenario of far starts."""

Start = Callable[[float, float], float]
"""Returns another starting value, given the starting value and its lower bound."""


def right_source(system: str, start: Start | None = None) -> str:
    """Return the source of the nominal simulation, with other starting values."""
    return one_class(NOMINAL, system, system, start)


def wrong_source(system: str, kind: str) -> str:
    """Return the source of a wrong simulation, under the name of the nominal one."""
    return one_class(WRONG, f"{system}{'WrongSign' if kind == WRONG_SIGN else 'Other'}", system)


def far_starts(g: Generator) -> Start:
    """Return a draw of starting values 10 times too large or too small; too large if the bound forbids too small."""

    def start(value: float, least: float) -> float:
        small = happens(g, 0.5) and (least == 0.0 or value / FAR > least)
        return value / FAR if small else value * FAR

    return start


def one_class(file: Path, name: str, called: str, start: Start | None = None) -> str:
    """Return the source of one class of a file with its imports, renamed and with other starting values.

    Args:
        file: a file whose classes are independent of each other.
        name: name of the class.
        called: its new name.
        start: changes each starting value; None keeps them.

    Returns:
        The text of a Python file.
    """
    tree = ast.parse(file.read_text(encoding="utf-8"))
    needed = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    (found,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    found.name = called
    for node in found.body:
        if start is not None and isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "parameters":
            assert isinstance(node.value, ast.Dict)
            node.value.values = [_from(value, start) for value in node.value.values]
    return "\n".join([*(ast.unparse(node) for node in needed), "", "", ast.unparse(found), ""])


def _from(value: ast.expr, start: Start) -> ast.expr:
    """Replace a number, or the starting value of a ``Parameter``."""
    if isinstance(value, ast.Call):
        bounds = {word.arg: word.value for word in value.keywords}
        least = float(ast.literal_eval(bounds["lower"])) if "lower" in bounds else -float("inf")
        value.args[0] = ast.Constant(_rounded(start(float(ast.literal_eval(value.args[0])), least)))
        return value
    return ast.Constant(_rounded(start(float(ast.literal_eval(value)), -float("inf"))))


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
