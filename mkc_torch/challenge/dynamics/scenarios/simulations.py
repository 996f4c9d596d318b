"""The file of a simulation that the diagnosis is given with a recording: one class, with starts of its own."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path

from torch import Generator

from mkc_torch.challenge.draws import happens
from mkc_torch.challenge.dynamics.scenarios.wrong import WRONG_SIGN

NAIVE = Path(__file__).parents[1] / "naive.py"
WRONG = Path(__file__).with_name("wrong_simulations.py")

FAR = 10.0
"""By how much each start is too large or too small in the world of far starts."""

Start = Callable[[float, float], float]
"""From a start and its least value another start."""


def right_source(system: str, start: Start | None = None) -> str:
    """The simulation as a user would write it, from other starts."""
    return one_class(NAIVE, system, system, start)


def wrong_source(system: str, kind: str) -> str:
    """One that is wrong in that way, under the name of the right one."""
    return one_class(WRONG, f"{system}{'WrongSign' if kind == WRONG_SIGN else 'Other'}", system)


def far_starts(g: Generator) -> Start:
    """Each ten times too large or too small; too large where too small is not allowed."""

    def start(value: float, least: float) -> float:
        small = happens(g, 0.5) and (least == 0.0 or value / FAR > least)
        return value / FAR if small else value * FAR

    return start


def one_class(file: Path, name: str, called: str, start: Start | None = None) -> str:
    """One class of a file with what that imports, under another name, each parameter from another start.

    Args:
        file: whose classes need nothing of one another.
        name: of the class.
        called: its new name.
        start: of each parameter; default the one it has.

    Returns:
        A Python file's text.
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
    """A number, or the first of a ``Parameter``, as another number."""
    if isinstance(value, ast.Call):
        bounds = {word.arg: word.value for word in value.keywords}
        least = float(ast.literal_eval(bounds["lower"])) if "lower" in bounds else -float("inf")
        value.args[0] = ast.Constant(_rounded(start(float(ast.literal_eval(value.args[0])), least)))
        return value
    return ast.Constant(_rounded(start(float(ast.literal_eval(value)), -float("inf"))))


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")
