"""Attribution of a finding's gain to states and runs.

The gain of an effect is the integral of the likelihood's gradient from amplitude 0 to its amplitude, and the gradient
is
a sum over the times at which the effect acts: integrated gradients (Sundararajan, Taly & Yan, ICML 2017), through the
simulation. Each term belongs to the states at its time, although the outputs show it later.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.forward_mode import vector_jacobian_product
from mkc_torch.diagnosis.evidence.held_out import scored
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.result import Region, StateMap
from mkc_torch.simulation.dynamics.surroundings import unit_of

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_NODES = 8
"""Gauss-Legendre nodes of the integral over the amplitude, denser near the full amplitude."""

_TIMES = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Candidate shares of time of a region."""

_CLEARLY = 0.3
"""Minimum excess of a region's share of gain over its share of time."""

_MOST = 1.25
"""Sum of positive gains, in shares of the total, above which gains and losses do not localise the effect."""

_SLICES = 20
"""Number of slices of a state's range."""

_BINS = 24
"""Cells of a map along each state."""

_REVERSES = 0.05
"""Minimum share of time of each sign for the regions "near zero" and "far from zero"."""


@dataclass(frozen=True)
class Attribution:
    """Gain of an effect at each time.

    Attributes:
        nats: (G,), gain at each time of the port; the sum is the total gain.
        places: components of the port's signal by name, (G,) each.
        units: of the components, if known.
        parts: roles of components, such as ``{"own": "speed", "position": "angle"}``.
        run: (G,), run number at each time; None without runs.
    """

    nats: Float[Tensor, " G"]
    places: Mapping[str, Float[Tensor, " G"]]
    units: Mapping[str, str]
    parts: Mapping[str, str]
    run: Int[Tensor, " G"] | None


def attributed(fit: FittedModel, number: int) -> Attribution | None:
    """Attribute the gain of an effect, with all other parameters fixed.

    Args:
        fit: the model.
        number: of the effect among its terms.

    Returns:
        The attribution; None for a port without component roles, and if the simulation diverges without the effect.
    """
    model, term = fit.model, fit.model.terms[number]
    prepared, port = model.prepared, model.prepared.ports[term.port]
    if not port.parts:
        return None
    start = model.base + sum(model.sizes[:number])
    mine = slice(start, start + model.sizes[number])
    gamma = fit.parameters[mine]
    width = len(port.channels)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    signal = model.signals(fit.parameters)[term.port].detach()
    nats = torch.zeros_like(signal[:, 0])
    less = 0.5 * (nodes + 1.0)  # the square is 1 minus the relative amplitude
    for node, weight in zip(1.0 - less**2, less * weights, strict=True):
        parameters = fit.parameters.clone()
        parameters[mine] = node * gamma
        model = model.around(parameters)  # each evaluation starts from a solution
        there = model.signals(parameters)[term.port]

        def likelihood(change: Tensor, parameters: Tensor = parameters, model: JointModel = model) -> Tensor:
            residual = model.residual_with_change(parameters, term.port, change)
            return scored(residual, fit.sigma, fit.d, fit.bound, fit.recorded).sum()

        slope = vector_jacobian_product(likelihood, there.new_zeros(len(there), width), there.new_ones(()))
        added = term.effect.change(gamma, term.shape, term.context(prepared, there))[:, :width]
        nats = nats + float(weight) * (slope * added).sum(-1)
    if not bool(nats.isfinite().all()):
        return None
    names = port.carries or port.channels
    units = {name: port.part_units[part] for part, name in port.parts.items() if port.part_units.get(part)}
    if prepared.dynamics is not None:
        # inputs that the effect does not refer to have units too
        units = {name: unit_of(prepared.dynamics.system, name) for name in names} | units
    # a rate is not a state
    places = {
        name: course for name, course in zip(names, signal.unbind(-1), strict=False) if name != port.parts.get("rate")
    }
    return Attribution(nats.detach(), places, units, port.parts, port.run)


def region_of(found: Attribution) -> Region | None:
    """Return the part of a state's range with the largest excess of gain over time; None without a clear excess."""
    whole = float(found.nats.sum())
    if not whole > 0.0:
        return None
    best: Region | None = None
    for name, values in found.places.items():
        if _gained(found.nats, values) > _MOST * whole:
            continue
        for kind, bound, inside in _parts_of(values):
            time = float(inside.double().mean())
            gain = float(found.nats[inside].sum()) / whole
            region = Region(name, found.units.get(name, ""), kind, bound, min(gain, 1.0), time)
            if best is None or gain - time > best.share_of_gain - best.share_of_time:
                best = region
    if best is None or best.share_of_gain - best.share_of_time < _CLEARLY:
        return None
    return best


def _gained(nats: Float[Tensor, " G"], values: Float[Tensor, " G"]) -> float:
    """Return the sum of positive gains over slices of a state's range with equal numbers of samples."""
    return sum(max(float(part.sum()), 0.0) for part in nats[values.argsort()].chunk(_SLICES))


def _parts_of(values: Float[Tensor, " G"]) -> Iterator[tuple[str, float, Bool[Tensor, " G"]]]:
    """Yield regions at the ends of the range and, with values of both signs, near and far from zero."""
    if float(values.max()) == float(values.min()):
        return
    shares = values.new_tensor(_TIMES)
    low, high = values.quantile(shares).tolist(), values.quantile(1.0 - shares).tolist()
    yield from (("below", bound, values <= bound) for bound in low)
    yield from (("above", bound, values >= bound) for bound in high)
    if min(float((values > 0).double().mean()), float((values < 0).double().mean())) > _REVERSES:
        size = values.abs()
        near, far = size.quantile(shares).tolist(), size.quantile(1.0 - shares).tolist()
        yield from (("near zero", bound, size <= bound) for bound in near)
        yield from (("far from zero", bound, size >= bound) for bound in far)


def shares_of_runs(found: Attribution) -> tuple[float, ...]:
    """Return each run's share of the gain; empty for a single run, and if runs have opposite gains."""
    if found.run is None or not float(found.nats.sum()) > 0.0:
        return ()
    count = int(found.run.max()) + 1
    if count < 2:
        return ()
    total = found.nats.new_zeros(count).index_add(0, found.run, found.nats)
    shares = total / total.sum()
    return tuple(shares.tolist()) if float(shares.max()) <= _MOST else ()


def map_of(found: Attribution) -> StateMap | None:
    """Return the gain over position and speed, or over two components of the effect; None for a single component."""
    order = [found.parts[part] for part in ("position", "own", "other", "sideways") if part in found.parts]
    names = list(dict.fromkeys(name for name in (*order, *found.places) if name in found.places))
    names = [name for name in names if float(found.places[name].max()) > float(found.places[name].min())][:2]
    if len(names) < 2:
        return None
    x, y = (found.places[name] for name in names)
    edges = [torch.linspace(float(v.min()), float(v.max()), _BINS + 1, dtype=v.dtype) for v in (x, y)]
    across, up = (torch.bucketize(v.contiguous(), e[1:-1].contiguous()) for v, e in zip((x, y), edges, strict=True))
    cell = across * _BINS + up
    zero = found.nats.new_zeros(_BINS * _BINS)
    count = zero.index_add(0, cell, torch.ones_like(found.nats))
    nats = zero.index_add(0, cell, found.nats)
    nats = torch.where(count > 0, nats, torch.nan).reshape(_BINS, _BINS)
    return StateMap((names[0], names[1]), tuple(found.units.get(n, "") for n in names), (edges[0], edges[1]), nats)
