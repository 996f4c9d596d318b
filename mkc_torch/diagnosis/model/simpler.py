"""Simpler forms of a model's effects."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects.base import Effect
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor


def simpler_start(fit: FittedModel, number: int) -> tuple[JointModel, Float[Tensor, " p"]] | None:
    """Return the model with the simpler form or the special case of an effect, and a start; None without either.

    Args:
        fit: with effects.
        number: of the effect.
    """
    terms = list(fit.model.terms)
    effect = terms[number].effect
    simpler = effect.simpler or effect.reduces_to
    if simpler is None:
        return None
    known = simpler.shapes(fit.model.prepared.time)[0]
    shape = {name: value for name, value in terms[number].shape.items() if name in known}
    at = _port_of(simpler, terms[number], fit.model.prepared)
    terms[number] = replace(terms[number], effect=simpler, shape=shape, at=at)
    model = JointModel(fit.model.prepared, terms, fit.model.near)
    size = model.sizes[number]
    if size >= fit.model.sizes[number]:
        return None
    before, own, behind = fit.parameters.split(
        [
            fit.model.base + sum(fit.model.sizes[:number]),
            fit.model.sizes[number],
            sum(fit.model.sizes[number + 1 :]),
        ]
    )
    return model, fit.parameters.new_tensor([*before, *own.reshape(size, -1).mean(-1), *behind])


def _port_of(simpler: Effect, term: Term, prepared: PreparedSimulation) -> str:
    """Return the port of the same channels where a simpler form acts: a special case can lack a part, such as a load.

    As in :class:`Term`, empty if the effect has no choice of ports.
    """
    if simpler.port == term.effect.port:
        return term.at
    channels = prepared.ports[term.port].channels
    return next(name for name, port in prepared.ports.items() if (port.kind, port.channels) == (simpler.port, channels))
