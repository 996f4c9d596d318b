"""A simulation together with effects: a joint parameter vector and a joint residual."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch._support.dual_constants import dual_constants
from mkc_torch._support.forward_mode import forward_jacobian
from mkc_torch.diagnosis.model.term import Key, Term
from mkc_torch.effects.context import Context, Shape
from mkc_torch.effects.waveforms import apply_basis, outer_product
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.simulation.continuation import CompiledResidual, Continuation, is_plain
from mkc_torch.simulation.logarithms import Logarithms, log_density
from mkc_torch.simulation.ports import Answer, Change, FreeChange, Nearby
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

_CHUNK = 64
"""Number of changes at a port whose tangents are computed together."""


class JointModel:
    """A prepared simulation with effects at its ports; parameters are the simulation's, then each effect's γ.

    Args:
        prepared: the simulation of the recording.
        terms: its effects.
        near: a nearby result of the simulation, as the start of its computation.
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
        """The simulation's prior, padded with zero precision for the effects."""
        settled = self._settled
        prepared = self.prepared
        known = prepared.prior_given(settled) if settled else prepared.prior
        if known is None or not self.terms:
            return known
        more = known.mean.new_zeros(self.size - self.base)
        precision = known.precision
        if precision.dim() == 1:
            return GaussianPrior(torch.cat([known.mean, more]), torch.cat([precision, more]))
        return GaussianPrior(torch.cat([known.mean, more]), torch.block_diag(precision, torch.diag(more)))

    @property
    def logarithms(self) -> Logarithms | None:
        """Coordinates of a fit of a simulation that steps; None for others, and without positive parameters there."""
        system, prior, bounds = self.prepared.dynamics, self.prior, self.bounds
        if system is None or system.system.steps is None or prior is None or bounds is None:
            return None
        known = list(system.known.values())
        positive = [p.uncertainty is not None and p.lower == 0.0 < p.value for p in known]
        places = torch.zeros(self.size, dtype=torch.bool)
        places[: len(known)] = torch.tensor(positive, dtype=torch.bool)
        return Logarithms(places, prior, bounds) if any(positive) else None

    def log_prior(self, parameters: Float[Tensor, " p"]) -> float:
        """The logarithm of the density of the parameters' prior, less its largest value; 0 without a prior."""
        logarithms = self.logarithms
        return log_density(self.prior, parameters) if logarithms is None else logarithms.log_prior(parameters)

    @property
    def _settled(self) -> frozenset[str]:
        """Parts of the clocks that effects determine: a part counts if effects on all channels determine it."""
        parts: dict[str, set[str]] = {}
        for term in self.terms:
            for part in term.effect.settles:
                parts.setdefault(part, set()).update(self.prepared.ports[term.port].channels)
        return frozenset(part for part, channels in parts.items() if channels >= set(self.prepared.channels))

    def gammas(self, parameters: Float[Tensor, " p"]) -> tuple[Tensor, ...]:
        """Return γ of each effect."""
        return torch.split(parameters[self.base :], list(self.sizes)) if self.terms else ()

    @property
    def bounds(self) -> tuple[Float[Tensor, " p"], Float[Tensor, " p"]] | None:
        """Lower and upper limits of the parameters; None if all are free."""
        known = self.prepared.bounds
        reach = [(term.effect.lower, term.effect.upper) for term in self.terms]
        if known is None and all(limits == (-torch.inf, torch.inf) for limits in reach):
            return None
        free = self.prepared.time.new_full((self.base,), torch.inf)
        low, high = (-free, free) if known is None else known
        lower, upper = (
            [free.new_full((size,), ends[side]) for ends, size in zip(reach, self.sizes, strict=True)]
            for side in (0, 1)
        )
        return torch.cat([low, *lower]), torch.cat([high, *upper])

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Change]:
        """Return the sum of the effects' changes at each port."""
        return self._changes_of(range(len(self.terms)), parameters)

    def _changes_of(self, numbers: Sequence[int], parameters: Tensor) -> dict[str, Change]:
        """Return the sum of some effects' changes at each port."""
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
        """Each effect's change as a function of γ alone; None for an effect that is not a sum of known courses."""
        return tuple(
            None if follows else courses_of(term, term.context(self.prepared, None))
            for term, follows in zip(self.terms, self._follow, strict=True)
        )

    def signals(self, parameters: Float[Tensor, " p"]) -> Mapping[str, Tensor]:
        """Return the signal at each port, with the effects."""
        return self.prepared.signals(parameters[: self.base], self.changes(parameters), self.near)

    def signals_before(self, parameters: Float[Tensor, " p"], keys: Collection[Key]) -> Mapping[str, Tensor]:
        """Return the signal at each port that a further effect would receive: after the effects in series there.

        Args:
            parameters: of the model.
            keys: of candidates whose own terms in the model are ignored.
        """
        signals = dict(self.signals(parameters))
        ahead = [k for k, t in enumerate(self.terms) if t.key not in keys and t.port in signals]
        ahead = [k for k in ahead if self.prepared.ports[self.terms[k].port].in_series(self.terms[k].port)]
        for port, change in self._changes_of(ahead, parameters).items():
            signals[port] = signals[port] + change(signals[port])
        return signals

    def residual(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "N m"]:
        """Return recording less prediction."""
        return self.answer(parameters).residual

    def answer(self, parameters: Float[Tensor, " p"]) -> Answer:
        """Return the residual, and the nearby result that further computations start from."""
        check_deadline()
        compiled = self._compiled if is_plain(parameters) else None
        found = None if compiled is None else compiled.answer(parameters, self.near)
        if found is not None:
            return found
        return self.prepared.answer(parameters[: self.base], self.changes(parameters), self.near)

    def residual_with_change(
        self, parameters: Float[Tensor, " p"], port: str, change: Float[Tensor, "N c"]
    ) -> Float[Tensor, "N m"]:
        """Return the residual with an added change at a port that does not depend on its signal."""
        check_deadline()
        changes = self.changes(parameters)
        added = {**changes, port: summed(changes.get(port), FreeChange(_constant(change)))}
        return self.prepared.answer(parameters[: self.base], added, self.near).residual

    def around(self, parameters: Float[Tensor, " p"]) -> JointModel:
        """Return the model with the linearised result at these parameters as its start, for derivatives there."""
        nearby = self.answer(parameters).nearby
        return self if nearby is None else self.begun_with(nearby)

    def begun_with(self, near: Nearby | None) -> JointModel:
        """Return the model with another nearby result as its start."""
        other = copy.copy(self)
        vars(other).update(vars(self), near=near)  # keeps the compiled residual
        return other

    def continuation(self) -> Continuation:
        """Return the residual for one fit, in which each evaluation starts from the previous result."""
        return Continuation(self.prepared, self._meaning, self.near, lambda: self._compiled)

    def _meaning(self, parameters: Tensor) -> tuple[Tensor, dict[str, Change]]:
        """Return the simulation's own parameters, and the effects' changes at each port."""
        return parameters[: self.base], self.changes(parameters)

    @cached_property
    def _compiled(self) -> CompiledResidual | None:
        return self.prepared.compiled(self._meaning, self.size)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the compiled residual; another process compiles it again."""
        return {name: value for name, value in vars(self).items() if name != "_compiled"}

    @property
    def open_loop_only(self) -> bool:
        """Whether an effect cannot be computed along a trajectory that an observer corrects."""
        return any(term.effect.open_loop_only for term in self.terms)

    def with_term(self, term: Term) -> JointModel:
        return JointModel(self.prepared, (*self.terms, term), self.near)

    def with_last(self, term: Term) -> JointModel:
        """Return the model with another term in place of the last."""
        return JointModel(self.prepared, (*self.terms[:-1], term), self.near)

    def with_shape(self, shape: Shape) -> JointModel:
        """Return the model with another shape of the last effect."""
        return self.with_last(replace(self.terms[-1], shape=shape))


def port_jacobian(model: JointModel, parameters: Float[Tensor, " p"], port: str) -> Float[Tensor, "N m c"]:
    """Return the derivative of each sample's residual by the signal at a pointwise port, by forward mode."""
    known = model.prepared.ports[port]
    N = len(model.prepared.time)
    zero = parameters.new_zeros(N, len(known.channels))

    def residual(change: Tensor) -> Tensor:
        return model.residual_with_change(parameters, port, change)

    columns = []
    for k in range(len(known.channels)):
        direction = torch.zeros_like(zero)
        direction[:, k] = 1.0
        columns.append(torch.func.jvp(dual_constants(residual), (zero,), (direction,))[1])
    return torch.stack(columns, -1)


def courses_of(term: Term, context: Context) -> Callable[[Tensor], Tensor] | None:
    """Return the effect's change as a function of γ if it is a sum of known courses; otherwise None."""
    if term.effect.has_basis:
        return partial(apply_basis, term.effect.basis(term.shape, context))
    if term.effect.has_waveform:
        return partial(outer_product, term.effect.waveform(term.shape, context))
    return None


def _constant(added: Float[Tensor, "N c"]) -> Change:
    return lambda _: added


def in_order_of_the_chain(terms: Sequence[Term], numbers: Iterable[int]) -> list[int]:
    """Return numbers of terms in the order in which effects in series act: effects with memory before the others.

    A motor's lag comes before the square law of its propeller; delays, lags and backlash commute. A term that acts
    ``first``, such as the dead zone of a driver in front of the motor's lag, comes before both.
    """
    return sorted(numbers, key=lambda number: (not terms[number].first, not terms[number].effect.remembers))


def summed(previous: Change | None, other: Change, *, series: bool = False) -> Change:
    """Return two changes at one port: in parallel, or in ``series``, the second on the output of the first."""
    if previous is None:
        return other
    first = previous

    def both(signal: Tensor) -> Tensor:
        added = first(signal)
        more = other(signal + added if series else signal)
        # the last column is the rate of a memory, if only one change has it
        width = max(added.shape[1], more.shape[1])
        return _widened(added, width) + _widened(more, width)

    return FreeChange(both) if isinstance(first, FreeChange) and isinstance(other, FreeChange) else both


def _widened(added: Float[Tensor, "N c"], width: int) -> Float[Tensor, "N w"]:
    """Append columns of zeros."""
    if added.shape[1] == width:
        return added
    return torch.cat([added, added.new_zeros(len(added), width - added.shape[1])], -1)


def directions(term: Term, context: Context) -> Float[Tensor, "N c q"]:
    """Return the derivative of an effect's change at its port by γ at γ = 0, by forward mode if it is not given.

    Of an effect with a ``finite_size`` the change at that size of each number of γ, over the size.
    """
    if term.effect.has_basis:
        return term.effect.basis(term.shape, context)
    if term.effect.has_waveform:
        # a gain of a waveform: the derivative is the waveform, channel by channel
        eye = torch.eye(len(context.channels), dtype=context.signal.dtype)
        return term.effect.waveform(term.shape, context)[:, None, None] * eye

    def change(gamma: Tensor) -> Tensor:
        return term.effect.change(gamma, term.shape, context)

    if term.effect.finite_size:
        size = term.shape[term.effect.finite_size]
        sizes = size * torch.eye(term.size(context), dtype=context.signal.dtype)
        return torch.stack([change(gamma) / size for gamma in sizes], -1)
    return forward_jacobian(change, context.signal.new_zeros(term.size(context)), context.signal.numel())


def through_port(
    model: JointModel,
    parameters: Float[Tensor, " p"],
    port: str,
    courses: Float[Tensor, "N c q"],
    pointwise: Float[Tensor, "N m c"] | None,
) -> Float[Tensor, "N m q"]:
    """Return residual tangents of changes at a port, by the pointwise Jacobian if given, else by forward mode."""
    if pointwise is not None:
        return torch.einsum("nmc,ncq->nmq", pointwise, courses)
    zero = torch.zeros_like(courses[..., 0])

    def residual(change: Tensor) -> Tensor:
        return model.residual_with_change(parameters, port, change)

    def tangent(direction: Tensor) -> Tensor:
        return torch.func.jvp(dual_constants(residual), (zero,), (direction,))[1]

    # out_dims=-1 fails in torch if nothing depends on the change
    return torch.vmap(tangent, in_dims=-1, chunk_size=_CHUNK)(courses).movedim(0, -1)
