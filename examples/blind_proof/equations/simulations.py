"""Write the file of a simulation for the diagnosis of a recording: one class, with its own starting values."""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from torch import Generator

from examples.blind_proof.draws import happens

MODELS = Path(__file__).with_name("models.py")

WRONG_SIGN, OTHER, UNRELATED = "wrong sign", "another system", "unrelated output"
"""Why a simulation is unusable."""

_POSITIVE_FLOWS = (("0.0015", "Parameter(0.0015, lower=0.0)"),)
_POSITIVE_HEATS = (("0.009,", "Parameter(0.009, lower=0.0),"),)

CHANGES: Mapping[tuple[str, str], Sequence[tuple[str, str]]] = MappingProxyType(
    {
        ("Pendulum", WRONG_SIGN): (("- p.stiffness", "+ p.stiffness"),),
        ("CartPole", WRONG_SIGN): (("+ 9.81", "- 9.81"), ("lower=0.1", "lower=0.1, upper=5.0")),
        ("Tanks", WRONG_SIGN): (("- p.outlet", "+ p.outlet"), *_POSITIVE_FLOWS),
        ("Tanks", OTHER): (("1 * u.pump_1", "1 * u.pump_2"), ("2 * u.pump_2", "2 * u.pump_1"), *_POSITIVE_FLOWS),
        ("Motor", WRONG_SIGN): (("- p.resistance", "+ p.resistance"),),
        ("Projectile", WRONG_SIGN): (("-9.81", "9.81"),),
        ("Thermal", WRONG_SIGN): (
            ("- p.loss", "+ p.loss"),
            ("lower=0.0", "lower=0.001"),
            *_POSITIVE_HEATS,
            ("20.0", "20.0, lower=-50.0, upper=50.0"),
        ),
        ("Thermal", OTHER): (
            ("1 * u.heater_1", "1 * u.heater_2"),
            ("2 * u.heater_2", "2 * u.heater_1"),
            *_POSITIVE_HEATS,
        ),
    }
)
"""Replacements in the nominal simulation that make it unusable; any other simulation is a class of its own."""

FAR = 10.0
"""Factor by which each starting value is too large or too small in the scenario of far starts."""

Start = Callable[[float, float], float]
"""Returns another starting value, given the starting value and its lower bound."""


def class_of(system: str) -> str:
    """Return the class of a system's simulation.

    Example:
        >>> class_of("cart_pole")
        'CartPole'
    """
    return "".join(word.capitalize() for word in system.split("_"))


def right_source(system: str, start: Start | None = None) -> str:
    """Return the source of the nominal simulation of a class, with other starting values."""
    return one_class(system, system, start)


def wrong_source(system: str, kind: str) -> str:
    """Return the source of a wrong simulation, under the name of the nominal class."""
    if (system, kind) not in CHANGES:
        return one_class(f"{system}Other", system)
    text = right_source(system)
    for old, new in CHANGES[system, kind]:
        text = text.replace(old, new)
    return text


def parameters_of(source: str) -> tuple[list[float], list[tuple[float, float]]]:
    """Return the starting values and bounds of the parameters of a simulation.

    Example:
        >>> parameters_of(right_source("Pendulum"))
        ([9.0, 0.2, 1.0], [(0.0, inf), (0.0, inf), (-inf, inf)])
    """
    values = [value for node in ast.parse(source).body for value in _parameters(node)]
    bounds = [(_bound(value, "lower"), _bound(value, "upper")) for value in values]
    return [_start_of(value) for value in values], bounds


def far_starts(g: Generator) -> Start:
    """Return a draw of starting values 10 times too large or too small; too large if the bound forbids too small."""

    def start(value: float, least: float) -> float:
        small = happens(g, 0.5) and (least == 0.0 or value / FAR > least)
        return value / FAR if small else value * FAR

    return start


def one_class(name: str, called: str, start: Start | None = None) -> str:
    """Return the source of one class of the models with its imports, renamed and with other starting values.

    Args:
        name: name of the class.
        called: its new name.
        start: changes each starting value; None keeps them.

    Returns:
        The text of a Python file.
    """
    tree = ast.parse(MODELS.read_text(encoding="utf-8"))
    needed = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    (found,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    found.name = called
    for value in _parameters(found):
        if start is None:
            break
        changed = ast.Constant(float(f"{start(_start_of(value), _bound(value, 'lower')):.6g}"))
        if isinstance(value, ast.Call):
            value.args[0] = changed
        else:
            value.value = changed.value
    return "\n".join([*(ast.unparse(node) for node in needed), "", "", ast.unparse(found), ""])


def _parameters(node: ast.stmt) -> list[ast.Call | ast.Constant]:
    """Return the values of the parameters in the order of a class: numbers, or calls of ``Parameter``."""
    body = node.body if isinstance(node, ast.ClassDef) else []
    tables = [
        item.value for item in body if isinstance(item, ast.Assign) and ast.unparse(item.targets[0]) == "parameters"
    ]
    return [value for table in tables if isinstance(table, ast.Dict) for value in table.values]  # type: ignore[misc]


def _start_of(value: ast.Call | ast.Constant) -> float:
    return float(ast.literal_eval(value.args[0] if isinstance(value, ast.Call) else value))


def _bound(value: ast.Call | ast.Constant, side: str) -> float:
    """Return a bound of a parameter; infinite if it has none."""
    words = {word.arg: word.value for word in value.keywords} if isinstance(value, ast.Call) else {}
    default = -math.inf if side == "lower" else math.inf
    return float(ast.literal_eval(words[side])) if side in words else default
