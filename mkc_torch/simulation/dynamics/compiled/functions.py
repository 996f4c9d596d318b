"""Traced expressions as the functions of a collocation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mkc_torch.simulation.dynamics.compiled.affine import multiplied
from mkc_torch.simulation.dynamics.compiled.collocation import dense
from mkc_torch.simulation.dynamics.compiled.expressions import Array, Expressions
from mkc_torch.simulation.dynamics.compiled.tape import Evaluation, Tape


class Derivatives:
    """Sparse derivatives of several nodes by several leaves.

    Args:
        expressions: the expressions that hold the nodes.
        nodes: the nodes to differentiate.
        leaves: the nodes of the parameters or states.
        arranged: as in :class:`..tape.Tape`.
    """

    def __init__(
        self, expressions: Expressions, nodes: Sequence[int], leaves: Sequence[int], arranged: Callable[[Array], Array]
    ) -> None:
        nothing, columns = expressions.number(0.0), {leaf: j for j, leaf in enumerate(leaves)}
        slopes = {
            (i, columns[leaf]): expressions.derivative(node, leaf)
            for i, node in enumerate(nodes)
            for leaf in sorted(expressions.leaves(node) & columns.keys())
        }
        self.places = [place for place, slope in slopes.items() if slope != nothing]
        self.nodes = [slopes[place] for place in self.places]
        self.shape = (len(nodes), len(leaves))
        self._expressions, self._arranged = expressions, arranged

    @cached_property
    def _tape(self) -> Tape:
        return Tape(self._expressions, self.nodes, self._arranged)

    def at(self, parameters: Sequence[float]) -> Callable[[Array], Array]:
        """The derivatives (nodes, leaves, *) as a function of the states (w, *)."""
        evaluated = self._tape.at(parameters)
        return lambda states: dense(evaluated(states), self.places, (*self.shape, *states.shape[1:]))


@dataclass(frozen=True)
class CompiledBlock:
    """Nodes as functions of states and parameters at fixed stations or samples.

    Attributes:
        expressions: the expressions that hold the nodes.
        nodes: the nodes to compute.
        states, parameters: their leaves.
        arranged: as in :class:`..tape.Tape`.
    """

    expressions: Expressions
    nodes: Sequence[int]
    states: Sequence[int]
    parameters: Sequence[int]
    arranged: Callable[[Array], Array]

    @cached_property
    def _tape(self) -> Tape:
        return Tape(self.expressions, self.nodes, self.arranged)

    @cached_property
    def by_states(self) -> Derivatives:
        """Derivatives by the states."""
        return Derivatives(self.expressions, self.nodes, self.states, self.arranged)

    @cached_property
    def moving(self) -> list[int]:
        """Indices of the parameters that a node depends on."""
        leaves = frozenset().union(*(self.expressions.leaves(node) for node in self.nodes))
        return [k for k, leaf in enumerate(self.parameters) if leaf in leaves]

    @cached_property
    def by_parameters(self) -> Derivatives:
        """Derivatives by the parameters in ``moving``."""
        return Derivatives(self.expressions, self.nodes, [self.parameters[k] for k in self.moving], self.arranged)

    def values(self, parameters: Sequence[float]) -> Callable[[Array], Array]:
        """The values (nodes, *) as a function of the states (w, *)."""
        evaluated: Evaluation = self._tape.at(parameters)

        def values(states: Array) -> Array:
            found = np.empty((len(self.nodes), *states.shape[1:]))
            for k, value in enumerate(evaluated(states)):
                found[k] = value
            return found

        return values


@dataclass(frozen=True)
class CompiledObserverJump:
    """An observer's jump at given parameters; see :class:`mkc_torch.simulation.dynamics.observer.ObserverJump`.

    Attributes:
        rows: (N,), grid index of each sample.
        places: indices of the corrected states.
        gain: (k, m, N), gains of the observer.
        limit: (m, N), at which the innovations are clipped.
        new: the innovations (m, N) as a function of the states at the samples (w, N).
        new_slope: their derivatives by the states, (m, w, N).
    """

    rows: NDArray[np.int64]
    places: Sequence[int]
    gain: Array
    limit: Array
    new: Callable[[Array], Array]
    new_slope: Callable[[Array], Array]

    def applied(self, states: Array) -> Array:
        moved = self.limit * np.tanh(self.new(states[:, self.rows]) / self.limit)
        after = states.copy()
        for place, change in zip(self.places, multiplied(self.gain, moved[:, None]), strict=True):
            after[place, self.rows] += change[0]
        return after

    def slope(self, states: Array) -> Array:
        w, G = states.shape
        found = np.zeros((w, w, G))
        found[np.arange(w), np.arange(w)] = 1.0
        at = states[:, self.rows]
        return self._moved(found, self.new_slope(at), at)

    def by_parameters(self, states: Array, new_slope: Array) -> Array:
        """Derivatives of the states just after, (w, K, G), given those of the innovations, (m, K, N)."""
        found = np.zeros((len(states), new_slope.shape[1], states.shape[1]))
        return self._moved(found, new_slope, states[:, self.rows])

    def _moved(self, found: Array, new_slope: Array, at: Array) -> Array:
        kept = 1.0 - np.square(np.tanh(self.new(at) / self.limit))
        for place, change in zip(self.places, multiplied(self.gain, kept[:, None] * new_slope), strict=True):
            found[place][:, self.rows] += change
        return found
