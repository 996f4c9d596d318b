"""The states of a simulation that steps, step after step, where the simulation has fast single steps."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mkc_torch.simulation.dynamics.compiled.collocation import ArrayGrid
from mkc_torch.simulation.dynamics.compiled.expressions import FUNCTIONS, Array, Expressions
from mkc_torch.simulation.dynamics.compiled.foreign import ForeignCall
from mkc_torch.simulation.dynamics.compiled.functions import CompiledBlock
from mkc_torch.simulation.dynamics.compiled.tape import Tape
from mkc_torch.simulation.dynamics.compiled.traced import Traced

_OF_NUMBERS: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "neg": operator.neg,
    "abs": abs,
    "sin": math.sin,
    "cos": math.cos,
    "tanh": math.tanh,
    "where": lambda condition, first, second: first if condition else second,
    "gt": operator.gt,
    "ge": operator.ge,
    "lt": operator.lt,
    "le": operator.le,
}
"""Functions of single numbers that are faster than those of NumPy and have the same values."""


def in_sequence(
    traced: Traced,
    grid: ArrayGrid,
    parameters: Sequence[float],
    first: Array,
    rows: NDArray[np.int64],
    observed: tuple[Array, Array] | None = None,
) -> Array | None:
    """Return the states (w, G) by single steps; None where the simulation has none that are fast, or fails.

    Args:
        traced: the map of a simulation that steps.
        grid: its grid times.
        parameters: its parameters.
        first: (w, K), initial states of the trajectories.
        rows: (N,), grid index of each sample.
        observed: gain (k, m, N) and clipping limit (m, N) of its observer; None without an observer.
    """
    rates = _single_steps(traced.ends, parameters)
    correct = None if observed is None else _corrections(traced, parameters, rows, *observed)
    if rates is None or (observed is not None and correct is None):
        return None
    found = np.empty((len(grid.begins), len(first)))
    x, place = first[:, 0].tolist(), 0
    found[0] = x
    try:
        for k, h in enumerate(grid.step.tolist()):
            if h == 0.0:
                place += 1
                x = first[:, place].tolist()
            else:
                if correct is not None:
                    x = correct(k, x)
                x = [value + h * rate for value, rate in zip(x, rates(k, x), strict=True)]
            found[k + 1] = x
    except (OverflowError, ValueError, ZeroDivisionError):  # a state that diverges
        return None
    return np.ascontiguousarray(found.T) if np.isfinite(found).all() else None


_Single = Callable[[int, Sequence[float]], list[float]]


def _single_steps(block: CompiledBlock, parameters: Sequence[float]) -> _Single | None:
    """The nodes of a block at a place and its states; None where a call has no single steps."""
    expressions = block.expressions
    if not all(isinstance(call, ForeignCall) for call in expressions.calls):
        return None
    tape = Tape(expressions, block.nodes, block.arranged)
    steps = []
    for function, slot, arguments, node in tape.steps:
        of_numbers = _of_numbers(expressions, node) or function
        if of_numbers is _NONE:
            return None
        steps.append((of_numbers, slot, arguments))
    slots, states, outputs = tape.values_at(parameters), tape.states, tape.outputs
    columns = [(k, value.reshape(-1).tolist()) for k, value in enumerate(slots) if np.ndim(value) > 0]
    own = [float(value) if np.ndim(value) == 0 and value is not None else value for value in slots]

    def single(place: int, x: Sequence[float]) -> list[float]:
        for slot, values in columns:
            own[slot] = values[place]
        for slot, index in states:
            own[slot] = x[index]
        for function, slot, arguments in steps:
            own[slot] = function(*[own[argument] for argument in arguments])
        return [own[output] for output in outputs]

    return single


def _corrections(
    traced: Traced, parameters: Sequence[float], rows: NDArray[np.int64], gain: Array, limit: Array
) -> Callable[[int, list[float]], list[float]] | None:
    """The states just after a grid time from those before, with an observer; None without single steps."""
    new = None if traced.new is None else _single_steps(traced.new, parameters)
    if new is None:
        return None
    innovations, samples = new, {row: sample for sample, row in enumerate(rows.tolist())}
    gains, limits = np.moveaxis(gain, -1, 0).tolist(), limit.T.tolist()

    def corrected(place: int, x: list[float]) -> list[float]:
        sample = samples.get(place)
        if sample is None:
            return x
        pairs = zip(innovations(sample, x), limits[sample], strict=True)
        moved, after = [most * math.tanh(value / most) for value, most in pairs], list(x)
        for state, row in zip(traced.places, gains[sample], strict=True):
            after[state] += sum(map(operator.mul, row, moved))
        return after

    return corrected


def _none(*_: Any) -> None:
    return None


_NONE: Callable[..., Any] = _none
"""Stands for single steps that a simulation does not have."""


def _of_numbers(expressions: Expressions, node: int) -> Callable[..., Any] | None:
    """The function of single numbers of a node; None for that of arrays."""
    own = expressions.nodes[node]
    if own.operation in _OF_NUMBERS:
        return _OF_NUMBERS[own.operation]
    if own.operation == "points":
        return lambda *values: values
    if own.operation == "values":
        call = expressions.calls[int(expressions.nodes[own.arguments[0]].value)]
        assert isinstance(call, ForeignCall)
        single = None if call.outputs else call.function.single()
        return _NONE if single is None else partial(_called, single, call.states, call.inputs)
    if own.operation == "item":
        return itemgetter(int(own.value))
    assert own.operation in FUNCTIONS
    return None


def _called(single: Callable[..., Sequence[float]], states: int, inputs: int, values: Sequence[float]) -> Any:
    last = 1 + states + inputs
    return single(values[1 : 1 + states], values[1 + states : last], values[last:])
