"""Replacement of findings by simpler forms that predict held-out blocks equally well."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import shape_fitted
from mkc_torch.diagnosis.noise.spectrum import agreed_innovation_gain
from mkc_torch.diagnosis.search.own_noise import priced, with_own_noise
from mkc_torch.diagnosis.settings import NamingSettings, Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

    from mkc_torch.diagnosis.model.term import Term
    from mkc_torch.effects.base import Effect
    from mkc_torch.simulation.protocol import PreparedSimulation

Holds = Callable[[FittedModel, Evidence], bool]


def simplified(
    fit: FittedModel, evidence: Evidence, blocks: HeldOutBlocks, holds: Holds, settings: NamingSettings
) -> tuple[FittedModel, Evidence]:
    """Replace each effect by its simpler form or special case unless held-out blocks reject it.

    Returns the fit and its scores.

    Held-out blocks reject a form if it makes them clearly less likely under white noise, and increases the innovations
    under coloured noise.

    All effects are tested again after each finding: a form that was needed without the new effect may not be needed any
    more.

    Args:
        fit: with all findings.
        evidence: scores of the fit on the blocks.
        blocks: held-out blocks.
        holds: whether a fit with these scores still confirms the last finding.
        settings: threshold of "clearly less likely".
    """
    for number in range(len(fit.model.terms)):
        start = _simpler(fit, number)
        if start is None:
            continue
        try:
            other = shape_fitted(fitted(*start, fit.bound, graduate=False))
        except NoFitError:
            continue
        after = held_out(other, blocks)
        lost = float((evidence.log_likelihood - after.log_likelihood).sum())
        as_well = lost <= settings.separable or agreed_innovation_gain(after.residual, evidence.residual) <= 0.0
        if as_well and holds(other, after):
            fit, evidence = other, after
    return fit, evidence


def simpler_by_price(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> FittedModel:
    """Replace each effect by its simpler form if the recording does not distinguish them.

    Each form has its own noise fit. The recording distinguishes two forms by more nats than their Schwarz penalty, and
    than the threshold for rivals.

    Args:
        fit: with all findings.
        declared: known standard deviations of the outputs' white noise.
        settings: thresholds.
    """
    for number in range(len(fit.model.terms)):
        start = _simpler(fit, number)
        if start is None:
            continue
        model, parameters = start
        try:
            other = with_own_noise(fitted(model, parameters, fit.bound, graduate=False), declared, settings)
        except NoFitError:
            continue
        price = 0.5 * (fit.model.size - model.size) * math.log(len(fit.residual))
        if priced(fit, settings) - priced(other, settings) < max(price, settings.naming.separable):
            fit = other
    return fit


def _simpler(fit: FittedModel, number: int) -> tuple[JointModel, Float[Tensor, " p"]] | None:
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
