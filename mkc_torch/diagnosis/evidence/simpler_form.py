"""Simpler forms of what was found, where blocks that the fit has not seen are predicted as well by them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shaped import shape_fitted
from mkc_torch.diagnosis.noise.innovations import agreed_innovation_gain
from mkc_torch.diagnosis.search.own_noise import priced, with_own_noise
from mkc_torch.diagnosis.settings import NamingSettings, Settings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float
    from torch import Tensor

__all__ = ["simpler_by_price", "simplified"]

Holds = Callable[[FittedModel, Evidence], bool]


def simplified(
    fit: FittedModel, evidence: Evidence, blocks: HeldOutBlocks, holds: Holds, settings: NamingSettings
) -> tuple[FittedModel, Evidence]:
    """The fit with the simpler form of each effect that unseen blocks do not speak against, and its evidence.

    They do where they are clearly less likely by it, with their noise taken for white, and it leaves more that is new
    in their samples, with it taken for coloured.

    All effects are asked again with each that is found: what one needed while another was missing, it may not need any
    more.

    Args:
        fit: with all effects that were found.
        evidence: of it, on the blocks.
        blocks: held out.
        holds: whether a fit, with its evidence, still makes a finding of the last effect.
        settings: what is clearly less likely.
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
    """The fit with the simpler form of each effect that the recording does not tell from it.

    Each form has the noise that it leaves; the recording tells them apart by more nats than the numbers between them
    cost (Schwarz), and than rivals have to differ by.

    Args:
        fit: with all effects that were found.
        declared: standard deviation of the white noise of outputs that it is known of.
        settings: the numbers that decide.
    """
    for number in range(len(fit.model.terms)):
        start = _simpler(fit, number, other=True)
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


def _simpler(fit: FittedModel, number: int, *, other: bool = False) -> tuple[JointModel, Float[Tensor, " p"]] | None:
    """The model with the simpler form of one effect, and where to start; None where there is none.

    Args:
        fit: with effects.
        number: of the effect.
        other: also as another effect, that it is with fewer numbers.
    """
    terms = list(fit.model.terms)
    effect = terms[number].effect
    simpler = effect.simpler or (effect.reduces_to if other else None)
    if simpler is None:
        return None
    known = simpler.shapes(fit.model.prepared.time)[0]
    shape = {name: value for name, value in terms[number].shape.items() if name in known}
    terms[number] = replace(terms[number], effect=simpler, shape=shape)
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
