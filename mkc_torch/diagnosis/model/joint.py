"""A simulation together with the effects found so far: one vector of parameters, one residual."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch._support.forward_mode import forward_jacobian
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.courses import combined, gained
from mkc_torch.nonlinear import GaussianPrior, make_dual
from mkc_torch.simulation.continuation import CompiledResidual, Continuation, compiled_residual, is_plain
from mkc_torch.simulation.protocol import Answer, Change, Clocked, FreeChange, Nearby, PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["JointModel", "directions", "in_order_of_the_chain", "port_jacobian", "summed", "through_port"]

_CHUNK = 64
"""Courses whose effect on the residual is computed together."""


class JointModel:
    """A prepared simulation with effects at its ports; parameters are the simulation's, then each effect's γ.

    Args:
        prepared: the simulation of the recording.
        terms: the effects in it.
        near: an answer of the simulation that its answers here are near; what is computed begins with it.
    """

    def __init__(self, prepared: PreparedSimulation, terms: Sequence[Term] = (), near: Nearby | None = None) -> None:
        self.prepared = prepared
        self.near = near
        self.terms = tuple(terms)
        self.base = len(prepared.parameter_names)
        self._follow = tuple(t.effect.follows_signal for t in self.terms)
        self.sizes = tuple(t.size(t.context(prepared, None)) for t in self.terms)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.base + sum(self.sizes)

    @property
    def prior(self) -> GaussianPrior | None:
        """The simulation's own, padded: nothing is known of effects beforehand."""
        settled = self._settled
        prepared = self.prepared
        known = prepared.prior_beside(settled) if settled and isinstance(prepared, Clocked) else prepared.prior
        if known is None or not self.terms:
            return known
        more = known.mean.new_zeros(self.size - self.base)
        precision = known.precision
        if precision.dim() == 1:
            return GaussianPrior(torch.cat([known.mean, more]), torch.cat([precision, more]))
        return GaussianPrior(torch.cat([known.mean, more]), torch.block_diag(precision, torch.diag(more)))

    @property
    def _settled(self) -> frozenset[str]:
        """Parts of the clocks that effects settle: each that those which act on all channels have together."""
        parts: dict[str, set[str]] = {}
        for term in self.terms:
            for part in term.effect.settles:
                parts.setdefault(part, set()).update(self.prepared.ports[term.port].channels)
        return frozenset(part for part, channels in parts.items() if channels >= set(self.prepared.channels))

    def gammas(self, parameters: Float[Tensor, " p"]) -> tuple[Tensor, ...]:
        """Of the effects, in their order."""
        return torch.split(parameters[self.base :], list(self.sizes)) if self.terms else ()

    @property
    def bounds(self) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]] | None:
        """Least and greatest values; None if all are free."""
        known = self.prepared.bounds
        reach = [(term.effect.lower, term.effect.upper) for term in self.terms]
        if known is None and all(one == (-torch.inf, torch.inf) for one in reach):
            return None
        free = self.prepared.time.new_full((self.base,), torch.inf)
        low, high = (-free, free) if known is None else known
        least, most = (
            [free.new_full((size,), one[side]) for one, size in zip(reach, self.sizes, strict=True)] for side in (0, 1)
        )
        return torch.cat([low, *least]), torch.cat([high, *most])

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Change]:
        """What the effects add at each port."""
        return self._changes_of(range(len(self.terms)), parameters)

    def _changes_of(self, numbers: Sequence[int], parameters: Tensor) -> dict[str, Change]:
        """What some of the effects add at each port."""
        total: dict[str, Change] = {}
        gammas, ports = self.gammas(parameters), self.prepared.ports
        for number in in_order_of_the_chain(self.terms, numbers):
            term, courses = self.terms[number], self._courses[number]
            change = self._change(term, gammas[number]) if courses is None else _constant(courses(gammas[number]))
            free = change if self._follow[number] else FreeChange(change)
            total[term.port] = summed(total.get(term.port), free, series=ports[term.port].in_series(term.port))
        return total

    def _change(self, term: Term, gamma: Tensor) -> Change:
        def change(signal: Tensor) -> Tensor:
            return term.effect.change(gamma, term.shape, term.context(self.prepared, signal))

        return change

    @cached_property
    def _courses(self) -> tuple[Callable[[Tensor], Tensor] | None, ...]:
        """What each effect adds as a function of γ alone; None where it is more than a sum of known courses."""
        return tuple(
            None if follows else courses_of(term, term.context(self.prepared, None))
            for term, follows in zip(self.terms, self._follow, strict=True)
        )

    def signals(self, parameters: Float[Tensor, " p"]) -> Mapping[str, Tensor]:
        """What passes through each port, with the effects in it."""
        return self.prepared.signals(parameters[: self.base], self.changes(parameters), self.near)

    def signals_before(self, parameters: Float[Tensor, " p"], keys: Collection[Key]) -> Mapping[str, Tensor]:
        """What passes through each port where the next effect would act: behind the effects in series there.

        Args:
            parameters: of the model.
            keys: of candidates, which count as not yet there.
        """
        signals = dict(self.signals(parameters))
        ahead = [k for k, t in enumerate(self.terms) if t.key not in keys and t.port in signals]
        ahead = [k for k in ahead if self.prepared.ports[self.terms[k].port].in_series(self.terms[k].port)]
        for port, change in self._changes_of(ahead, parameters).items():
            signals[port] = signals[port] + change(signals[port])
        return signals

    def residual(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "N m"]:
        """Recording less prediction."""
        return self.answer(parameters).residual

    def answer(self, parameters: Float[Tensor, " p"]) -> Answer:
        """The residual, and what one nearby begins with."""
        check_deadline()
        compiled = self._compiled if is_plain(parameters) else None
        found = None if compiled is None else compiled.answer(parameters, self.near)
        if found is not None:
            return found
        return self.prepared.answer(parameters[: self.base], self.changes(parameters), self.near)

    def pushed(self, parameters: Float[Tensor, " p"], port: str, change: Float[Tensor, "N c"]) -> Float[Tensor, "N m"]:
        """The residual with a change at a port that does not depend on its signal."""
        check_deadline()
        changes = self.changes(parameters)
        added = {**changes, port: summed(changes.get(port), FreeChange(_constant(change)))}
        return self.prepared.answer(parameters[: self.base], added, self.near).residual

    def around(self, parameters: Float[Tensor, " p"]) -> JointModel:
        """The same, for derivatives at these parameters: with the answer there, linearised, to begin with."""
        nearby = self.answer(parameters).nearby
        return self if nearby is None else self.begun_with(nearby)

    def begun_with(self, near: Nearby | None) -> JointModel:
        """The same with another answer to begin with."""
        other = copy.copy(self)
        vars(other).update(vars(self), near=near)  # the compiled residual too
        return other

    def continuation(self) -> Continuation:
        """The residual for one fit, on whose way each answer begins with the one before."""
        return Continuation(self.prepared, self._meaning, self.near, lambda: self._compiled)

    def _meaning(self, parameters: Tensor) -> tuple[Tensor, dict[str, Change]]:
        """The simulation's own parameters, and what the effects add at each port."""
        return parameters[: self.base], self.changes(parameters)

    @cached_property
    def _compiled(self) -> CompiledResidual | None:
        return compiled_residual(self.prepared, self._meaning, self.size)

    def __getstate__(self) -> dict[str, Any]:
        """Without the compiled residual, which another process compiles again."""
        return {name: value for name, value in vars(self).items() if name != "_compiled"}

    def with_term(self, term: Term) -> JointModel:
        return JointModel(self.prepared, (*self.terms, term), self.near)

    def with_last(self, term: Term) -> JointModel:
        """The same with another term in the place of the last one."""
        return JointModel(self.prepared, (*self.terms[:-1], term), self.near)

    def with_shape(self, shape: Shape) -> JointModel:
        """The same with another shape of the last effect."""
        return self.with_last(replace(self.terms[-1], shape=shape))


def port_jacobian(model: JointModel, parameters: Float[Tensor, " p"], port: str) -> Float[Tensor, "N m c"]:
    """How the residual of each sample changes with what enters at a pointwise port, by forward mode."""
    known = model.prepared.ports[port]
    N = len(model.prepared.time)
    zero = parameters.new_zeros(N, len(known.channels))

    def residual(change: Tensor) -> Tensor:
        return model.pushed(make_dual(parameters, change[0, 0]), port, change)

    columns = []
    for k in range(len(known.channels)):
        direction = torch.zeros_like(zero)
        direction[:, k] = 1.0
        columns.append(torch.func.jvp(residual, (zero,), (direction,))[1])
    return torch.stack(columns, -1)


def courses_of(term: Term, context: Context) -> Callable[[Tensor], Tensor] | None:
    """A function of γ that is an effect's change, for one that adds courses of its own; None of any other."""
    if term.effect.has_basis:
        return partial(combined, term.effect.basis(term.shape, context))
    if term.effect.has_course:
        return partial(gained, term.effect.waveform(term.shape, context))
    return None


def _constant(added: Float[Tensor, "N c"]) -> Change:
    return lambda _: added


def in_order_of_the_chain(terms: Sequence[Term], numbers: Iterable[int]) -> list[int]:
    """Numbers of terms in the order in which effects in series act: those with memory before those without.

    A motor's lag comes before the square by which its propeller pulls; delays, lags and play commute.
    """
    return sorted(numbers, key=lambda number: not terms[number].effect.remembers)


def summed(one: Change | None, other: Change, *, series: bool = False) -> Change:
    """Two changes at one port: side by side, or in ``series``, the second of the signal that the first one changed."""
    if one is None:
        return other
    first = one

    def both(signal: Tensor) -> Tensor:
        added = first(signal)
        more = other(signal + added if series else signal)
        # the rate of a memory, where only one of them has it, comes last
        width = max(added.shape[1], more.shape[1])
        return _widened(added, width) + _widened(more, width)

    return FreeChange(both) if isinstance(first, FreeChange) and isinstance(other, FreeChange) else both


def _widened(added: Float[Tensor, "N c"], width: int) -> Float[Tensor, "N w"]:
    """With zeros beside it."""
    if added.shape[1] == width:
        return added
    return torch.cat([added, added.new_zeros(len(added), width - added.shape[1])], -1)


def directions(term: Term, context: Context) -> Float[Tensor, "N c q"]:
    """How an effect's change at its port grows with γ at γ = 0, by forward mode where the effect does not say."""
    if term.effect.has_basis:
        return term.effect.basis(term.shape, context)
    if term.effect.has_course:
        # a gain on a course: the derivative is the course, channel by channel
        eye = torch.eye(len(context.channels), dtype=context.signal.dtype)
        return term.effect.waveform(term.shape, context)[:, None, None] * eye

    def change(gamma: Tensor) -> Tensor:
        return term.effect.change(gamma, term.shape, replace(context, signal=make_dual(context.signal, gamma[0])))

    return forward_jacobian(change, context.signal.new_zeros(term.size(context)), context.signal.numel())


def through_port(
    model: JointModel,
    parameters: Float[Tensor, " p"],
    port: str,
    courses: Float[Tensor, "N c q"],
    pointwise: Float[Tensor, "N m c"] | None,
) -> Float[Tensor, "N m q"]:
    """Residual tangents of changes at a port; by the pointwise Jacobian where there is one, else by forward mode."""
    if pointwise is not None:
        return torch.einsum("nmc,ncq->nmq", pointwise, courses)
    zero = torch.zeros_like(courses[..., 0])

    def push(direction: Tensor) -> Tensor:
        return torch.func.jvp(lambda change: model.pushed(parameters, port, change), (zero,), (direction,))[1]

    # where nothing follows the change, torch takes an out_dims of -1 for a place in memory
    return torch.vmap(push, in_dims=-1, chunk_size=_CHUNK)(courses).movedim(0, -1)
