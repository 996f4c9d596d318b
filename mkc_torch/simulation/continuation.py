"""The residual during a fit: each evaluation starts from the previous one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

from torch import Tensor

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch._support.torch_internals import functorch_is_active, is_wrapped
from mkc_torch.simulation.ports import Answer, Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float

Meaning = Callable[[Tensor], tuple[Tensor, Changes]]
"""Maps the parameters of a fit to the simulation's own parameters and the changes at its ports."""

_MOST_KEPT = 64
"""Number of past evaluations that are kept, because a fit returns to recent parameters."""


class ResidualTangents(NamedTuple):
    """Derivatives of a residual by the parameters of a fit, and the start of evaluations nearby."""

    rows: Float[Tensor, "p N m"]
    nearby: Nearby


class CompiledResidual(Protocol):
    """A residual with its own derivatives, equal to those of the simulation up to rounding, but faster.

    Attributes:
        steps: whether it is that of a simulation that steps.
    """

    steps: bool

    def answer(self, parameters: Float[Tensor, " p"], near: Nearby | None = None) -> Answer:
        """The residual; see :meth:`PreparedSimulation.answer`."""
        ...

    def tangents(self, parameters: Float[Tensor, " p"], near: Nearby) -> ResidualTangents | None:
        """Derivatives at the evaluation ``near``; None where the simulation itself must be differentiated."""
        ...

    def affine(self, parameters: Float[Tensor, " p"], near: Nearby) -> CompiledResidual | None:
        """The residual with the simulation's own steps affine at ``near``; None for a simulation without steps."""
        ...


class Answering(Protocol):
    """The part of a prepared simulation that a fit evaluates; see :class:`mkc_torch.simulation.PreparedSimulation`."""

    def answer(self, theta: Float[Tensor, " p"], changes: Changes, near: Nearby | None = None) -> Answer: ...
    def compiled(self, meaning: Meaning, size: int) -> CompiledResidual | None: ...


def is_plain(parameters: Tensor) -> bool:
    """Whether no derivative by these parameters is being computed."""
    return not (parameters.requires_grad or is_wrapped(parameters) or functorch_is_active())


class Continuation:
    """The residual as a function of a fit's parameters; stores the recent evaluations of this fit.

    Args:
        prepared: the simulation.
        meaning: maps the fit's parameters to the simulation's parameters and the changes at its ports.
        near: start of the first evaluation.
        compiled: returns the compiled residual; default the simulation's.
    """

    def __init__(
        self,
        prepared: Answering,
        meaning: Meaning,
        near: Nearby | None = None,
        compiled: Callable[[], CompiledResidual | None] | None = None,
    ) -> None:
        self._prepared, self._meaning, self._last = prepared, meaning, near
        self._compile = compiled
        self._compiled: tuple[CompiledResidual | None] | None = None
        self._known: OrderedDict[bytes, Nearby] = OrderedDict()
        self._last_key = b""
        self._same: tuple[bytes, Tensor] | None = None

    def __call__(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "N m"]:
        """The residual, recording minus simulation."""
        check_deadline()
        if is_wrapped(parameters):
            return self._prepared.answer(*self._meaning(parameters), self._last).residual
        key = _key(parameters)
        if self._same is not None and self._same[0] == key and is_plain(parameters):
            return self._same[1]
        # from another start, the solver may not find the same solution again
        near = self._last if key == self._last_key else self._known.get(key, self._last)
        residual, nearby = self._answer(parameters, near)
        if nearby is not None:
            self._last, self._last_key = nearby, key
            self._known[key] = nearby.bare
            self._known.move_to_end(key)
            while len(self._known) > _MOST_KEPT:
                self._known.popitem(last=False)
        # the steps of a simulator are slow, and a solution of theirs does not depend on its start
        steps = (
            is_plain(parameters) and self._compiled is not None and bool(self._compiled[0] and self._compiled[0].steps)
        )
        self._same = (key, residual) if steps else None
        return residual

    def tangents(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "p N m"] | None:
        """Derivatives of the residual, a row per parameter; None where they must be computed in another way."""
        compiled = self._compiled_for(parameters) if is_plain(parameters) else None
        if compiled is None:
            return None
        key = _key(parameters)
        if key != self._last_key and key not in self._known:
            self(parameters)
        near = self._last if key == self._last_key else self._known.get(key)
        found = None if near is None else compiled.tangents(parameters, near)
        if found is None:
            return None
        self._last, self._last_key = found.nearby, key
        return found.rows

    def near(self, parameters: Float[Tensor, " p"]) -> Nearby | None:
        """The start of an evaluation at these parameters: the solution that was found there, else the last solution."""
        last = None if self._last is None else self._last.bare
        return self._known.get(_key(parameters), last)

    def affine(self, parameters: Float[Tensor, " p"], *, given: bool = False) -> Continuation | None:
        """The residual with the simulation's own steps affine near parameters; None for a simulation without steps.

        It is far faster than the simulation, and exact at the parameters.

        Args:
            parameters: the parameters.
            given: whether the start of the first evaluation is the trajectory at these parameters.
        """
        compiled = self._compiled_for(parameters)
        if compiled is None or not compiled.steps:
            return None
        if not given and _key(parameters) not in self._known:
            self(parameters)
        near = self._last if given else self._known.get(_key(parameters))
        if near is None:
            return None
        affine = compiled.affine(parameters, near)
        return None if affine is None else Continuation(self._prepared, self._meaning, near, lambda: affine)

    def _answer(self, parameters: Tensor, near: Nearby | None) -> Answer:
        compiled = self._compiled_for(parameters) if is_plain(parameters) else None
        if compiled is not None:
            return compiled.answer(parameters, near)
        return self._prepared.answer(*self._meaning(parameters), near)

    def _compiled_for(self, parameters: Tensor) -> CompiledResidual | None:
        if self._compiled is None:
            if self._compile is None:
                self._compiled = (self._prepared.compiled(self._meaning, len(parameters)),)
            else:
                self._compiled = (self._compile(),)
        return self._compiled[0]


def _key(parameters: Tensor) -> bytes:
    return parameters.detach().cpu().numpy().tobytes()
