"""Test of an effect's shape against a free curve of the same variables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.environment import Curve, ShapeCheck
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.parallel import run_parallel
from mkc_torch.diagnosis.model.term import Term, continuous
from mkc_torch.diagnosis.search.model_prior import schwarz
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["nearest_power", "shape_of"]

_POWERS = torch.arange(0.0, 4.001, 0.02, dtype=torch.float64)
_POINTS = 60
"""Number of points of a curve."""

_NORMAL_95 = 1.96
"""Half-width of a 95 % interval in standard errors."""


def shape_of(fit: FittedModel, number: int, terms: Sequence[Term], settings: EvidenceSettings) -> ShapeCheck | None:
    """Test the shape of an effect; None without a comparable curve.

    Args:
        fit: with all effects.
        number: of the effect.
        terms: all candidates, including curves.
        settings: thresholds.
    """
    term = fit.model.terms[number]
    curves = _curves(term, terms, fit)
    if term.effect.is_curve or not curves:
        return None
    found = run_parallel([partial(_instead, fit, number, curve) for curve in curves], fit.model.prepared, curves)
    fits = [result for result in found if result is not None]
    if not fits:
        return None
    best = max(
        fits, key=lambda curve_fit: curve_fit.log_likelihood - schwarz(curve_fit) * curve_fit.model.sizes[number]
    )
    gain = best.log_likelihood - fit.log_likelihood
    more = max(
        best.model.sizes[number] - fit.model.sizes[number] - len({*continuous(term), *term.effect.fitted_shape}), 1
    )
    half, value = torch.tensor(0.5 * more).double(), torch.tensor(max(gain, 0.0)).double()
    chance = float(torch.special.gammaincc(half, value))
    if chance >= settings.shape_level or gain <= settings.shape_nats + schwarz(best) * more:
        return ShapeCheck(gain, chance)
    curve = curve_of(best, number)
    return ShapeCheck(gain, chance, curve, nearest_power(curve))


def _curves(term: Term, terms: Sequence[Term], fit: FittedModel) -> list[Term]:
    """Return the curves at the port of an effect."""
    channels = fit.model.prepared.ports[term.port].channels
    found: dict[tuple[str, str], Term] = {}
    for other_term in terms:
        same = other_term.columns == term.columns and fit.model.prepared.ports[other_term.port].channels == channels
        if other_term.effect.is_curve and same:
            found.setdefault((other_term.port, other_term.effect.plot_axis), other_term)
    return list(found.values())


def _instead(fit: FittedModel, number: int, curve: Term) -> FittedModel | None:
    """Refit with a curve in place of a named effect; None if the fit fails."""
    model = fit.model
    terms = (*model.terms[:number], curve, *model.terms[number + 1 :])
    joint = JointModel(model.prepared, terms, model.near)
    parts = list(model.gammas(fit.parameters))
    parts[number] = fit.parameters.new_zeros(joint.sizes[number])
    start = torch.cat([fit.parameters[: model.base], *parts])
    try:
        return fitted(joint, start, fit.bound)
    except NoFitError:
        return None


def curve_of(fit: FittedModel, number: int) -> Curve:
    """Return an effect's change of a rate over the visited range, with its 95 % band."""
    model, term = fit.model, fit.model.terms[number]
    prepared, port = model.prepared, model.prepared.ports[term.port]
    signal = model.signals(fit.parameters)[term.port].detach()
    part = port.parts[term.effect.plot_axis]
    at = signal[:, port.carries.index(part)] if port.carries else signal[:, 0]
    order = at.argsort()[torch.linspace(0, len(at) - 1, _POINTS).long()]
    gamma = model.gammas(fit.parameters)[number].detach()

    def change(values: Tensor) -> Tensor:
        return term.effect.change(values, term.shape, term.context(prepared, signal))[order]

    value, slope = change(gamma), torch.func.jacfwd(change)(gamma)
    start = model.base + sum(model.sizes[:number])
    covariance = _covariance(fit)[start : start + len(gamma), start : start + len(gamma)]
    band = _NORMAL_95 * torch.einsum("ncq,qr,ncr->nc", slope, covariance, slope).clamp(min=0.0).sqrt()
    unit = port.part_units.get(term.effect.plot_axis, "")
    return Curve(part, unit, at[order], value.detach(), band, (f"rate of {port.channels[0]}",), port.unit)


def _covariance(fit: FittedModel) -> Float[Tensor, "p p"]:
    """Return the covariance of the parameters for white noise."""
    tangents = torch.func.jacfwd(fit.model.around(fit.parameters).residual)(fit.parameters)
    weighted = (fit.weights / fit.d.square()).unsqueeze(-1) * tangents
    gram = torch.einsum("nmp,nmq->pq", weighted, tangents)
    size = gram.diagonal().clamp(min=1e-300).rsqrt()
    return size.unsqueeze(-1) * torch.linalg.pinv(size.unsqueeze(-1) * gram * size, hermitian=True) * size


def nearest_power(curve: Curve) -> str:
    """Return the power law nearest to a curve, in addition to a line and a constant, as text."""
    x, y = curve.x, curve.value[:, 0]
    if not bool(y.isfinite().all()):
        return ""
    weight = 1.0 / curve.band[:, 0].clamp(min=float(curve.band.median().clamp(min=1e-300)))
    best: tuple[float, float, float] | None = None
    for power in _POWERS.tolist():
        if abs(power - 1.0) < 0.1 or power < 0.1:
            continue
        columns = torch.stack([x.abs().pow(power) * x.sign(), x, torch.ones_like(x)], -1)
        size = columns.abs().amax(0).clamp(min=1e-300)
        solution = torch.linalg.lstsq((columns / size) * weight.unsqueeze(-1), (y * weight).unsqueeze(-1)).solution
        left = float((((columns / size) @ solution).squeeze(-1) - y).mul(weight).square().sum())
        if best is None or left < best[0]:
            best = left, power, float(solution[0, 0] / size[0])
    if best is None or not math.isfinite(best[2]):
        return ""
    return f"{best[2]:.3g} |{curve.driver}|^{best[1]:.2g} sign({curve.driver}) plus a straight line"
