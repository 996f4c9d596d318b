"""Tangents of a residual: its derivatives by each parameter, each candidate and each slow cosine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.forward_mode import forward_jacobian
from mkc_torch.diagnosis.linearised.candidates import Candidates, parts_of
from mkc_torch.diagnosis.model.joint import JointModel, port_jacobian, through_port
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.cosine_basis import cosines, course_of, dct, dct_of_courses
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["ModelTangents", "SlowBasis", "tangents_of"]


@dataclass(frozen=True)
class ModelTangents:
    """The tangents of a residual.

    Attributes:
        nuisance: of the parameters, (N, m, p).
        candidates: of each candidate's γ, (N, m, q); for long recordings computed on access.
        pointwise: through each pointwise port, (N, m, channels); None for the other ports.
        slow: of slow cosines at the port with a drift; None without such a port.
    """

    nuisance: Float[Tensor, "N m p"]
    candidates: Sequence[Float[Tensor, "N m q"]]
    pointwise: dict[str, Tensor | None]
    slow: SlowBasis | None

    @property
    def parts(self) -> tuple[object, ...]:
        """All large parts."""
        slow = () if self.slow is None else (self.slow.tangents, self.slow.scales)
        return (
            self.nuisance,
            *parts_of(self.candidates),
            *(jacobian for jacobian in self.pointwise.values() if jacobian is not None),
            *slow,
        )

    @property
    def bare(self) -> ModelTangents:
        """The tangents without candidates."""
        return replace(self, candidates=())


@dataclass(frozen=True)
class SlowBasis:
    """Slow cosines of a port's channels, and their standard deviations in each drift family (F, k).

    ``tangents`` are those of each cosine of each channel, (N, m, k); at a ``pointwise`` port those of the channels,
    (N, m, c), which the cosines modulate. Another family than the first has to gain ``walk_first`` nats more.
    """

    port: str
    channels: int
    tangents: Tensor
    pointwise: bool
    scales: Tensor
    walk_first: float

    @property
    def count(self) -> int:
        """Number of cosines per channel."""
        return self.scales.shape[1] // self.channels

    def transformed(self, counts: Float[Tensor, "N m"], kept: int) -> Float[Tensor, "K m k"]:
        """Return the K slowest cosine coefficients of the tangents at the samples that count."""
        moved = counts.unsqueeze(-1) * self.tangents
        return dct_of_courses(moved, self.count, kept) if self.pointwise else dct(moved, kept)

    def waveform(self, amplitudes: Float[Tensor, " k"]) -> Float[Tensor, "N m"]:
        """Return the residual's change by cosines of these amplitudes, (N, m)."""
        if not self.pointwise:
            return self.tangents @ amplitudes
        drift = course_of(amplitudes.unflatten(0, (-1, self.channels)), len(self.tangents))
        return torch.einsum("nmc,nc->nm", self.tangents, drift)

    def with_shares(self, shares: Float[Tensor, " c"]) -> SlowBasis:
        """Return the basis with the variance of each channel scaled."""
        return replace(self, scales=self.scales * shares.sqrt().repeat(self.scales.shape[1] // len(shares)))

    def of_family(self, number: int) -> SlowBasis:
        """Return the basis with one drift family only."""
        return replace(self, scales=self.scales[number : number + 1])


def tangents_of(
    model: JointModel, parameters: Float[Tensor, " p"], settings: NoiseSettings, terms: Sequence[Term] = ()
) -> ModelTangents:
    """Compute the tangents at these parameters, by forward mode.

    Args:
        model, parameters: where to linearise.
        settings: the drift families.
        terms: candidates.

    Raises:
        NoFitError: the residual has no finite derivative by a parameter there.
    """
    prepared, model = model.prepared, model.around(parameters)
    pointwise = {
        name: port_jacobian(model, parameters, name) if port.pointwise else None
        for name, port in prepared.ports.items()
    }
    independent = parameters.new_tensor([float(channel) for channel in prepared.independent])
    values = len(prepared.time) * len(prepared.independent)
    nuisance = forward_jacobian(model.residual, parameters, values)
    if not bool(nuisance.isfinite().all()):
        effects = [
            f"the size of {t.effect.id}" for t, n in zip(model.terms, model.sizes, strict=True) for _ in range(n)
        ]
        finite = nuisance.isfinite().flatten(0, 1).all(0).tolist()
        names = zip((*prepared.parameter_names, *effects), finite, strict=True)
        lost = dict.fromkeys(name for name, known in names if not known)
        raise NoFitError(
            f"The simulation's outputs have no finite derivative by {', '.join(lost)} at the fitted values. Bound "
            "these parameters, or start them elsewhere."
        )
    start = model.base
    for term, size in zip(model.terms, model.sizes, strict=True):
        if term.effect.follows_signal:
            nuisance[..., start : start + size] *= independent[:, None]
        start += size
    slow = _slow_courses(model, parameters, pointwise, settings)
    return ModelTangents(nuisance, Candidates(model, parameters, terms, pointwise), pointwise, slow)


def _slow_courses(
    model: JointModel, parameters: Tensor, pointwise: dict[str, Tensor | None], settings: NoiseSettings
) -> SlowBasis | None:
    N = len(model.prepared.time)
    count = min(settings.slow_courses, N // 10)
    drifting = [name for name, port in model.prepared.ports.items() if port.allows_drift]
    if not drifting or count == 0:
        return None
    name = drifting[0]
    c = len(model.prepared.ports[name].channels)
    k = torch.arange(1, count + 1, dtype=parameters.dtype).repeat_interleave(c)
    others = ((1.0 + (k / corner).square()).reciprocal() + (walk / k).square() for corner, walk in settings.plateaus)
    scales = torch.stack([1.0 / k, *(square.sqrt() for square in others)])
    known = pointwise[name]
    if known is not None:
        return SlowBasis(name, c, known, True, scales, settings.walk_first)
    courses = cosines(count, N)
    eye = torch.eye(c, dtype=courses.dtype)
    spread = (courses[:, None, :, None] * eye[:, None, :]).reshape(N, c, count * c)
    return SlowBasis(name, c, through_port(model, parameters, name, spread, None), False, scales, settings.walk_first)
