"""Calls outside torch replaced by their affine parts at a trajectory, so that single steps need no call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mkc_torch.simulation.dynamics.compiled.expressions import CONSTANT, Array, Expressions
from mkc_torch.simulation.dynamics.compiled.functions import CompiledBlock
from mkc_torch.simulation.dynamics.compiled.tape import Tape, needed_nodes


def with_affine_calls(block: CompiledBlock, parameters: Sequence[float], states: Array) -> CompiledBlock | None:
    """Return nodes in which the values of each call are affine in its arguments; None where a call fails.

    Args:
        block: the nodes at stations.
        parameters: at which the calls are replaced.
        states: (w, \\*), at which the calls are replaced.
    """
    old, new = block.expressions, Expressions()
    needed = needed_nodes(old, block.nodes)
    calls = {node: old.nodes[node].arguments[0] for node in needed if old.nodes[node].operation == "values"}
    moving = {
        points: [place for place, node in enumerate(old.nodes[points].arguments) if old.levels[node] != CONSTANT]
        for points in calls.values()
    }
    evaluated = [
        node
        for values, points in calls.items()
        for node in (
            values,
            *(old.slope(points, place) for place in moving[points]),
            *(old.nodes[points].arguments[place] for place in moving[points]),
        )
    ]
    known = dict(zip(evaluated, Tape(old, evaluated, block.arranged).at(parameters)(states), strict=True))
    if not all(np.isfinite(value).all() for value in known.values()):
        return None
    own: dict[int, int] = {}

    def affine(values: int, number: int) -> int:
        """The value of this number of a call, in the new expressions."""
        points = calls[values]
        shift, total = known[values][number], new.number(0.0)
        for place in moving[points]:
            argument, slope = old.nodes[points].arguments[place], known[old.slope(points, place)][number]
            if np.any(slope):
                shift = shift - slope * known[argument]
                total = new.apply("add", total, new.apply("mul", new.column(slope.reshape(-1)), own[argument]))
        return new.apply("add", total, new.column(shift.reshape(-1)))

    inside = {*calls, *calls.values()}
    for node in needed:
        if node not in inside:
            own[node] = _copied(old, node, new, own, affine)
    states_of, parameters_of = (
        [new.leaf(*_leaf(old, node)) for node in group] for group in (block.states, block.parameters)
    )
    return CompiledBlock(new, [own[node] for node in block.nodes], states_of, parameters_of, block.arranged)


def _copied(old: Expressions, node: int, new: Expressions, own: dict[int, int], affine: Any) -> int:
    """A node in other expressions, in which its arguments are."""
    known = old.nodes[node]
    if known.operation == "number":
        return new.number(known.value)
    if known.operation == "column":
        return new.column(old.columns[int(known.value)])
    if known.operation in ("parameter", "state"):
        return new.leaf(*_leaf(old, node))
    if known.operation == "course":
        return new.course(
            old.courses[int(known.value)], [new.leaf(*_leaf(old, leaf)) for leaf in sorted(old.leaves(node))]
        )
    if known.operation == "item":
        return int(affine(known.arguments[0], int(known.value)))
    return new.apply(known.operation, *(own[argument] for argument in known.arguments))


def _leaf(old: Expressions, node: int) -> tuple[str, int]:
    return old.nodes[node].operation, int(old.nodes[node].value)
