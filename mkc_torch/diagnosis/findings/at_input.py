"""The size of an effect on a rate in the unit of the only input that moves this rate, such as a torque."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch._support.unit_text import tidy
from mkc_torch.diagnosis.parts import EffectParameter, SizeAtInput
from mkc_torch.diagnosis.search.estimate import FinalEstimate
from mkc_torch.simulation.dynamics.entries import gain_of, lone_input
from mkc_torch.simulation.dynamics.ports import RATES
from mkc_torch.simulation.dynamics.surroundings import unit_of

if TYPE_CHECKING:
    from jaxtyping import Float

_UNEQUAL = 1e-3
"""Relative spread of a gain along a recording up to which it is constant."""


def size_at_input(final: FinalEstimate, number: int) -> SizeAtInput | None:
    """Return the size of an effect on a rate as a change of the input that moves this rate.

    A friction of an acceleration is a friction of the torque, if the torque moves this acceleration only, and in
    proportion: both are the same model. Each amplitude whose unit contains that of the rate is divided by the gain; its
    error includes that of the simulation's parameters, such as an inertia.

    Args:
        final: the final parameters.
        number: of the effect among the model's terms.

    Returns:
        None for effects elsewhere and for curves, if there is no such input or if its unit is unknown.
    """
    model = final.fit.model
    term, prepared = model.terms[number], model.prepared.dynamics
    port = model.prepared.ports[term.port]
    if prepared is None or port.kind not in RATES or len(port.channels) > 1 or term.effect.is_curve:
        return None
    name = lone_input(prepared, port.channels[0])
    unit = "" if name is None else unit_of(prepared.system, name)
    if name is None or not unit:
        return None
    theta, system = final.fit.parameters[: model.base], prepared.open_loop()

    def gain(values: Tensor) -> Float[Tensor, " S"]:
        return gain_of(system, name, values)[:, system.system.states.index(port.channels[0])]

    along = gain(theta)
    middle = float(along.median())
    if not middle > 0.0 or float((along - middle).abs().amax()) > _UNEQUAL * middle:
        return None
    slope = torch.func.jacfwd(dual_constants(lambda values: gain(values).median()))(theta)
    context = term.context(model.prepared, model.signals(final.fit.parameters).get(term.port))
    here = term.effect.quantities(term.shape, context)
    there = term.effect.quantities(term.shape, replace(context, signal_unit=unit))
    start = model.base + sum(model.sizes[:number])
    sizes = []
    for own, other in zip(here, there, strict=True):
        if own.size == 1 and tidy(own.unit) != tidy(other.unit):
            value = float(final.fit.parameters[start]) / middle
            by = torch.zeros_like(final.fit.parameters)
            by[: model.base], by[start] = -value / middle * slope, 1.0 / middle
            error = float((by @ final.covariance @ by).clamp(min=0.0).sqrt())
            sizes.append(EffectParameter(own.name, value, error, tidy(other.unit)))
        start += own.size
    return SizeAtInput(name, tuple(sizes)) if sizes else None
