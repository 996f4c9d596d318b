"""Smooth curves of every column and of time at the ports of a simulation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.forward_mode import forward_jacobian, vector_jacobian_product
from mkc_torch.diagnosis.evidence.held_out import HeldOutBlocks
from mkc_torch.diagnosis.model.joint import JointModel, port_jacobian, through_port
from mkc_torch.diagnosis.model.term import Driver
from mkc_torch.diagnosis.noise.spectrum import cosines
from mkc_torch.simulation.ports import Port

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

DEGREE = 5
"""Degree of the Legendre curves of columns."""

COURSES = 10
"""Number of cosines of time; a polynomial would diverge in the first and last block."""

TIME = ""
"""Name of time among the columns."""

MOST_COLUMNS = 300
"""Maximum number of tangents; with more columns, the most promising are selected."""

_TINY = torch.finfo(torch.float64).tiny

_FREE = 1e-3
"""Roughness that is added to every degree."""


@dataclass(frozen=True)
class Smooth:
    """Tangents of the simulation's parameters and of the curves.

    Attributes:
        tangents: (N, m, P), of the residual.
        own: number of the parameters' tangents.
        groups: for each column and port, the numbers of its tangents.
        names: of the groups' columns.
        roughness: (P,), penalty of each tangent, increasing with the degree; 0 for the parameters.
        allowed: (folds, groups), groups that the fit without each fold may select.
    """

    tangents: Float[Tensor, "N m P"]
    own: int
    groups: tuple[Tensor, ...]
    names: tuple[str, ...]
    roughness: Float[Tensor, " P"]
    allowed: Bool[Tensor, "folds groups"]


def legendre(values: Float[Tensor, "N k"], degree: int) -> Float[Tensor, "N k degree"]:
    """Return Legendre polynomials P_1 to P_degree over the range of each column, minus their means.

    Example:
        >>> legendre(torch.tensor([[0.0], [1.0], [2.0]]), 2)[:, 0]
        tensor([[-1.0000,  0.5000],
                [ 0.0000, -1.0000],
                [ 1.0000,  0.5000]])
    """
    low, high = values.amin(0), values.amax(0)
    t = (2.0 * values - low - high) / (high - low)
    found = [torch.ones_like(t), t]
    for n in range(1, degree):
        found.append(((2 * n + 1) * t * found[n] - n * found[n - 1]) / (n + 1))
    curves = torch.stack(found[1:], -1)
    return curves - curves.mean(0)


def curves_of(drivers: Sequence[Driver], N: int) -> dict[str, Float[Tensor, "N degree"]]:
    """Return the curves of time, which is first, and of each column."""
    found = {TIME: cosines(COURSES, N)}
    if drivers:
        columns = [name for driver in drivers for name in driver.columns]
        made = legendre(torch.cat([driver.values for driver in drivers], -1), DEGREE)
        found |= dict(zip(columns, made.unbind(1), strict=True))
    return found


@dataclass(frozen=True)
class _Around:
    """A model linearised at parameters: tangents of the parameters and of pointwise ports."""

    model: JointModel
    parameters: Tensor  # (p,)
    own: Tensor  # (N, m, p)
    pointwise: Mapping[str, Tensor | None]  # (N, m, c)

    @classmethod
    def of(cls, model: JointModel, parameters: Tensor) -> _Around:
        model = model.around(parameters)
        pointwise = {
            name: port_jacobian(model, parameters, name) if port.pointwise else None
            for name, port in model.prepared.ports.items()
        }
        values = len(model.prepared.time) * len(model.prepared.independent)
        own = forward_jacobian(model.residual, parameters, values)
        return cls(model, parameters, own, pointwise)

    @property
    def ports(self) -> dict[str, Port]:
        """Ports at which curves can act, without duplicates."""
        places: dict[tuple[tuple[str, ...], str], str] = {}
        for name, port in self.model.prepared.ports.items():
            places.setdefault((port.channels, port.unit), name)
        return {name: self.model.prepared.ports[name] for name in places.values()}

    def backward(self, port: str, left: Float[Tensor, "N m"]) -> Float[Tensor, "N c"]:
        """Return the gradient of residuals by a change at a port, by reverse mode for a port that is not pointwise."""
        known = self.pointwise[port]
        if known is not None:
            return torch.einsum("nmc,nm->nc", known, left)
        entrance = self.model.prepared.ports[port]
        zero = left.new_zeros(len(left), len(entrance.channels))

        def residual(change: Tensor) -> Tensor:
            return self.model.residual_with_change(self.parameters, port, entrance.at(change))

        return vector_jacobian_product(residual, zero, left)


def smooth_tangents(
    model: JointModel,
    parameters: Float[Tensor, " p"],
    curves: Mapping[str, Float[Tensor, "N degree"]],
    weights: Float[Tensor, "N m"],
    blocks: HeldOutBlocks,
) -> Smooth:
    """Return the tangents of curves at every port of a simulation.

    Args:
        model, parameters: point of the linearisation.
        curves: of each column.
        weights: of the residuals, over the squares of their scales.
        blocks: folds; the most promising columns are selected without each fold.
    """
    around = _Around.of(model, parameters)
    ports = around.ports
    own, width = around.own.shape[-1], sum(len(port.channels) for port in ports.values())
    room = (MOST_COLUMNS - own - COURSES * width) // (DEGREE * width)
    allowed = _promising(around, curves, weights, blocks, max(room, 1))
    used = [k for k in range(len(curves)) if bool(allowed[:, k].any())]
    names = [list(curves)[k] for k in used]
    joined = torch.cat([curves[name] for name in names], -1)
    tangents, groups, roughness, start = [around.own], [], [joined.new_zeros(own)], own
    for port in ports:
        c, known = len(ports[port].channels), around.pointwise[port]
        if known is not None and ports[port].clock is None:
            # product of each course and each channel, without expanded copies
            tangents.append((known[:, :, None, :] * joined[:, None, :, None]).flatten(2))
        else:
            courses = joined[:, None, :, None] * torch.eye(c, dtype=joined.dtype)[:, None, :]
            entering = ports[port].at(courses.flatten(2))
            tangents.append(through_port(around.model, parameters, port, entering, known))
        for name in names:
            degree = torch.arange(curves[name].shape[-1], dtype=joined.dtype)
            groups.append(torch.arange(start, start + c * len(degree)))
            roughness.append((degree.square() + _FREE).repeat_interleave(c))
            start += c * len(degree)
    return Smooth(
        torch.cat(tangents, -1),
        own,
        tuple(groups),
        tuple(names) * len(ports),
        torch.cat(roughness),
        allowed[:, used].repeat(1, len(ports)),
    )


def _promising(
    around: _Around, curves: Mapping[str, Tensor], weights: Float[Tensor, "N m"], blocks: HeldOutBlocks, room: int
) -> Bool[Tensor, "folds curves"]:
    """Return for each fold the columns whose curves correlate most with the training residuals; time is always
    included.

    The number of columns is limited by the union over the folds.
    """
    allowed = torch.ones(len(blocks.train), len(curves), dtype=torch.bool)
    columns = [k for k, name in enumerate(curves) if name != TIME]
    if len(columns) <= room:
        return allowed
    basis = torch.linalg.qr(torch.stack([curve for name, curve in curves.items() if name != TIME])).Q
    scores = _scores(around, basis, [weights * train.unsqueeze(-1) for train in blocks.train])
    order = scores.argsort(descending=True)
    most = 1
    while len(order[:, : most + 1].unique()) <= room:
        most += 1
    allowed[:, columns] = torch.zeros_like(scores, dtype=torch.bool).scatter(1, order[:, :most], True)
    return allowed


def _scores(
    around: _Around, basis: Float[Tensor, "D N degree"], weights: Sequence[Float[Tensor, "N m"]]
) -> Float[Tensor, "folds D"]:
    """Return the squared projection of the residual, after the parameters' fit, on each column's curves, over all
    ports.
    """
    left = [_left(around, weight) for weight in weights]
    total = basis.new_zeros(len(weights), len(basis))
    for port in around.ports:
        back = torch.stack([around.backward(port, series) for series in left])
        # ports have units of their own
        back = back / back.square().mean((1, 2), keepdim=True).sqrt().clamp(min=_TINY)
        total += torch.einsum("dnj,fnc->fdjc", basis, back).square().sum((2, 3))
    return total


def _left(around: _Around, weights: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """Return the weighted residuals after a linear fit of the parameters."""
    residual = around.model.residual(around.parameters).detach()
    weighted = weights.unsqueeze(-1) * around.own
    gram = torch.einsum("nmp,nmq->pq", weighted, around.own)
    step = torch.linalg.lstsq(gram, torch.einsum("nmp,nm->p", weighted, residual).unsqueeze(-1)).solution
    return weights * (residual - (around.own @ step).squeeze(-1))
