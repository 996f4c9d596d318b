"""A simulation together with the effects found so far: one vector of parameters, one residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.drivers import Driver
from mkc_torch.effects.protocol import Context, Effect, GainEffect, Shape, SignalEffect
from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["JointModel", "Term", "directions", "follows_signal", "port_jacobian", "through_port"]

_CHUNK = 64


@dataclass(frozen=True)
class Term:
    """An effect with its driver (None for time or the signal alone) and its shape."""

    effect: Effect
    driver: Driver | None
    shape: Shape

    @property
    def columns(self) -> tuple[str, ...]:
        return () if self.driver is None else self.driver.columns

    @property
    def key(self) -> tuple[str, tuple[str, ...]]:
        """What it is, whatever its shape."""
        return self.effect.id, self.columns

    def context(self, prepared: PreparedSimulation, signal: Tensor | None) -> Context:
        """What the effect sees."""
        port = prepared.ports[self.effect.port]
        time = prepared.time
        values = time.new_zeros(len(time), 0) if self.driver is None else self.driver.values
        units = () if self.driver is None else self.driver.units
        if signal is None:
            signal = time.new_zeros(len(time), len(port.channels))
        return Context(time, values, units, signal, port.unit, port.channels)

    def size(self, context: Context) -> int:
        return sum(quantity.size for quantity in self.effect.quantities(self.shape, context))


class JointModel:
    """A prepared simulation with effects at its ports; parameters are the simulation's, then each effect's γ.

    Args:
        prepared: the simulation of the recording.
        terms: the effects in it.
    """

    def __init__(self, prepared: PreparedSimulation, terms: Sequence[Term] = ()) -> None:
        self.prepared = prepared
        self.terms = tuple(terms)
        self.base = len(prepared.parameter_names)
        signals = prepared.signals(prepared.start())
        self.sizes = tuple(t.size(t.context(prepared, signals.get(t.effect.port))) for t in self.terms)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.base + sum(self.sizes)

    @property
    def prior(self) -> GaussianPrior | None:
        """The simulation's own, padded: nothing is known of effects beforehand."""
        known = self.prepared.prior
        if known is None or not self.terms:
            return known
        more = known.mean.new_zeros(self.size - self.base)
        precision = known.precision
        if precision.dim() == 1:
            return GaussianPrior(torch.cat([known.mean, more]), torch.cat([precision, more]))
        return GaussianPrior(torch.cat([known.mean, more]), torch.block_diag(precision, torch.diag(more)))

    def gammas(self, parameters: Float[Tensor, " p"]) -> tuple[Tensor, ...]:
        """Of the effects, in their order."""
        return torch.split(parameters[self.base :], list(self.sizes)) if self.terms else ()

    def changes(self, parameters: Float[Tensor, " p"]) -> dict[str, Tensor]:
        """What the effects add at each port."""
        signals = self.prepared.signals(parameters[: self.base]) if self.terms else {}
        total: dict[str, Tensor] = {}
        for term, gamma in zip(self.terms, self.gammas(parameters), strict=True):
            port = term.effect.port
            context = term.context(self.prepared, signals.get(port))
            change = term.effect.change(gamma, term.shape, context)
            total[port] = total[port] + change if port in total else change
        return total

    def residual(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "N m"]:
        """Recording less prediction."""
        return self.prepared.residual(parameters[: self.base], self.changes(parameters))

    def with_term(self, term: Term) -> JointModel:
        return JointModel(self.prepared, (*self.terms, term))

    def with_shape(self, shape: Shape) -> JointModel:
        """The same with another shape of the last effect."""
        return JointModel(self.prepared, (*self.terms[:-1], replace(self.terms[-1], shape=shape)))


def port_jacobian(model: JointModel, parameters: Float[Tensor, " p"], port: str) -> Float[Tensor, "N m c"]:
    """How the residual of each sample changes with what enters at a pointwise port, by forward mode."""
    changes = model.changes(parameters)
    known = model.prepared.ports[port]
    N = len(model.prepared.time)
    zero = parameters.new_zeros(N, len(known.channels))
    held = changes.get(port, zero)

    def residual(change: Tensor) -> Tensor:
        return model.prepared.residual(parameters[: model.base], {**changes, port: change})

    columns = []
    for k in range(len(known.channels)):
        direction = torch.zeros_like(zero)
        direction[:, k] = 1.0
        columns.append(torch.func.jvp(residual, (held + zero,), (direction,))[1])
    return torch.stack(columns, -1)


def follows_signal(effect: Effect) -> bool:
    """Whether an effect is a function of the signal at its port."""
    return isinstance(effect, SignalEffect) and effect.follows_signal


def directions(term: Term, context: Context) -> Float[Tensor, "N c q"]:
    """How an effect's change at its port grows with γ at γ = 0, by forward mode."""
    if isinstance(term.effect, GainEffect):
        # a gain on a course: the derivative is the course, channel by channel
        eye = torch.eye(len(context.channels), dtype=context.signal.dtype)
        return term.effect.course(term.shape, context)[:, None, None] * eye
    zero = context.signal.new_zeros(term.size(context))
    return torch.func.jacfwd(lambda gamma: term.effect.change(gamma, term.shape, context))(zero)


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
    changes = model.changes(parameters)
    held = changes.get(port, torch.zeros_like(courses[..., 0]))

    def residual(change: Tensor) -> Tensor:
        return model.prepared.residual(parameters[: model.base], {**changes, port: change})

    def push(direction: Tensor) -> Tensor:
        return torch.func.jvp(residual, (held,), (direction,))[1]

    return torch.vmap(push, in_dims=-1, out_dims=-1, chunk_size=_CHUNK)(courses)
