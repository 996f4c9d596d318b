"""The linear search: profiled likelihood ratios of all candidates in one batch.

At the current fit the pseudo-residual is ``-J δ - T γ + noise``. J are the tangents of the simulation's own parameters,
projected out of everything; T are those of a candidate; the noise is a whitened part plus a drift at the simulation's
ports, whose size is refitted with every candidate. The same search on surrogates of the fitted noise tests the largest
ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.noise.drift import DriftFamily, DriftStatistics, NoiseFit, without_drift

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_LEFT = 1e-4
"""Share of a candidate's direction that the simulation's own parameters have to leave; other directions are dropped."""

_SINGULAR = 1e-10
"""Ratio of the smallest to the largest eigenvalue of normalised parameters below which they are inseparable."""

CELLS = 3_000_000
"""Largest number of candidates' inner products with series, over several sizes, that are held at once."""

_EQUAL = 3.0
"""Weight of the prior of equal channels in each channel's share of the drift, in numbers of cosines."""


@dataclass(frozen=True)
class SearchGains:
    """Likelihood ratios of C candidates on B series (twice the gain in nats), and log chi-square p-values."""

    ratio: Float[Tensor, "C B"]
    log_p: Float[Tensor, "C B"]
    dof: Float[Tensor, " C"]


def log_survival(ratio: Tensor, dof: Tensor) -> Tensor:
    """Return the log of the chi-square survival function, also where the function underflows.

    Example:
        >>> log_survival(torch.tensor([3.841, 2000.0], dtype=torch.float64), torch.tensor([1.0, 3.0])).exp()
        tensor([0.0500, 0.0000], dtype=torch.float64)
    """
    half, x = 0.5 * dof.to(ratio), 0.5 * ratio.clamp(min=0.0)
    direct = torch.special.gammaincc(half.expand_as(x), x.clamp(max=600.0)).clamp(min=1e-300).log()
    safe = x.clamp(min=1.0)
    far = -safe + (half - 1.0) * safe.log() - torch.lgamma(half) - torch.log1p(-((half - 1.0) / safe).clamp(max=0.5))
    return torch.where(x > 300.0, far, direct)


class LinearSearch:
    """A linearised simulation with candidates, to be applied to any number of series.

    Args:
        nuisance: (M, p) whitened tangents of the simulation's own parameters; M samples times channels.
        candidates: whitened tangents of each candidate, (M, q).
        drift: (M, k) whitened tangents of slow cosines at the ports; k may be 0.
        scales: standard deviations of those cosines, up to one size, for each drift family, (F, k).
        walk_first: nats by which another family has to be more likely than the first, a random walk.
    """

    def __init__(
        self,
        nuisance: Float[Tensor, "M p"],
        candidates: Sequence[Float[Tensor, "M q"]],
        drift: Float[Tensor, "M k"],
        scales: Float[Tensor, "F k"],
        walk_first: float,
    ) -> None:
        self._basis = torch.linalg.qr(nuisance / torch.linalg.vector_norm(nuisance, dim=0).clamp(min=1e-300)).Q
        self._dof = nuisance.shape[0] - nuisance.shape[1]
        self._drift = drift
        self._drift_basis = self._basis.mT @ drift
        gram = _gram(drift) - _gram(self._drift_basis)
        self._families = [DriftFamily(scale, gram) for scale in scales] if drift.shape[1] else []
        self._possible = range(len(self._families))
        self._walk_first = walk_first
        self._try(candidates)

    def _try(self, candidates: Sequence[Float[Tensor, "M q"]]) -> None:
        self._widths = [c.shape[1] for c in candidates]
        columns = torch.cat([self._basis[:, :0], *candidates], -1)
        on_basis = self._basis.mT @ columns
        self._flat = columns
        self._cross = self._drift.mT @ columns - self._drift_basis.mT @ on_basis  # (k, cols)
        self._groups = self._grouped(columns, on_basis)

    def with_candidates(self, candidates: Sequence[Float[Tensor, "M q"]]) -> LinearSearch:
        """Return the same simulation and noise with another set of candidates."""
        other = copy(self)
        other._try(candidates)
        return other

    def with_more(self, candidates: Sequence[Float[Tensor, "M q"]]) -> LinearSearch:
        """Return the search with these candidates after its own."""
        return self.with_candidates([*self._flat.split(self._widths, -1), *candidates])

    def without(self, columns: Float[Tensor, "M q"]) -> LinearSearch:
        """Return the search with these tangents projected out of everything too."""
        nuisance = torch.cat([self._basis, columns], -1)
        own = self._flat.split(self._widths, -1)
        return LinearSearch(nuisance, own, self._drift, self._scales, self._walk_first)

    def scaled(self, factor: Float[Tensor, " M"]) -> LinearSearch:
        """Return the search with each row times a factor."""
        nuisance, columns, drift = (factor.unsqueeze(-1) * known for known in (self._basis, self._flat, self._drift))
        other = LinearSearch(nuisance, columns.split(self._widths, -1), drift, self._scales, self._walk_first)
        other._possible = self._possible
        return other

    def of_family(self, number: int | None) -> LinearSearch:
        """Return the search with one drift family, if there is a drift; None for all families."""
        other = copy(self)
        other._possible = range(len(self._families)) if number is None else range(number, number + 1)
        return other

    @property
    def _scales(self) -> Float[Tensor, "F k"]:
        """Scales of each drift family."""
        scales = [family.scale for family in self._families]
        return torch.stack(scales) if scales else self._drift.new_zeros(0, self._drift.shape[1])

    @property
    def _allowed(self) -> list[DriftFamily]:
        """The drift families that the noise may belong to."""
        return [self._families[number] for number in self._possible]

    def _grouped(self, columns: Tensor, on_basis: Tensor) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Return for each width: numbers of the candidates, their columns, whitening (C, q, q) and dof."""
        starts = torch.tensor([0, *self._widths]).cumsum(0)
        groups = []
        for width in sorted(set(self._widths)):
            member = torch.tensor([i for i, w in enumerate(self._widths) if w == width])
            index = starts[member].unsqueeze(-1) + torch.arange(width)
            block, shadow = columns[:, index].movedim(0, -1), on_basis[:, index].movedim(0, -1)
            full = block @ block.mT
            gram = full - shadow @ shadow.mT
            size = torch.diagonal(full, dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
            values, vectors = torch.linalg.eigh(gram * size.unsqueeze(-1) * size.unsqueeze(-2))
            kept = values > _LEFT
            root = torch.where(kept, values.clamp(min=_LEFT).rsqrt(), 0.0)
            # orthonormal coordinates of each candidate's own space; dropped directions become zero columns
            groups.append((member, index, size.unsqueeze(-1) * vectors * root.unsqueeze(-2), kept.sum(-1).double()))
        return groups

    def weighted(self, factor: Float[Tensor, " K"]) -> LinearSearch:
        """Return the search on the first K rows times these factors, without a drift."""
        rows = len(factor)
        nuisance, columns = (factor.unsqueeze(-1) * known[:rows] for known in (self._basis, self._flat))
        return LinearSearch(nuisance, columns.split(self._widths, -1), nuisance[:, :0], nuisance.new_zeros(0, 0), 0.0)

    @property
    def dof(self) -> Float[Tensor, " C"]:
        """Number of directions of each candidate that the simulation's own parameters leave."""
        out = torch.zeros(len(self._widths), dtype=torch.float64)
        for member, _, _, dof in self._groups:
            out[member] = dof
        return out

    def white(self, count: int, generator: torch.Generator) -> Float[Tensor, "M B"]:
        """Draw the white part, with variance 1."""
        return torch.randn(self._basis.shape[0], count, generator=generator, dtype=self._flat.dtype)

    def drift(self, count: int, noise: NoiseFit, generator: torch.Generator) -> Float[Tensor, "M B"]:
        """Draw the fitted drift, on the scale on which the white part has variance 1."""
        if noise.size == 0:
            return self._drift.new_zeros(self._basis.shape[0], count)
        scale = noise.size**0.5 * self._families[noise.family].scale
        courses = torch.randn(len(scale), count, generator=generator, dtype=self._flat.dtype)
        return self._drift @ (scale.unsqueeze(-1).to(courses) * courses)

    def drift_spread(self, noise: NoiseFit) -> float:
        """Return the standard deviation of the fitted drift over the recording, in its port's unit (equal channels)."""
        scale = self._families[noise.family].scale
        distinct = scale.square().sum() / (scale == scale.max()).sum()
        return float((noise.size * noise.variance * distinct).sqrt())

    def gains(self, series: Float[Tensor, "M B"]) -> SearchGains:
        """Return the likelihood ratio of each candidate on each series, with the noise's sizes profiled out."""
        series = series.to(self._flat.dtype)
        on_basis = self._basis.mT @ series
        power = (series.square().sum(0) - on_basis.square().sum(0)).double()
        inner = (self._flat.mT @ series - (self._flat.mT @ self._basis) @ on_basis).double()
        slow = (self._drift.mT @ series - self._drift_basis.mT @ on_basis).double()
        null, best = self._profile(power, inner, slow)
        ratio = (2.0 * (best - null)).clamp(min=0.0)
        dof = self.dof
        log_p = log_survival(ratio, dof.clamp(min=1.0).unsqueeze(-1))
        return SearchGains(ratio, torch.where(dof.unsqueeze(-1) > 0, log_p, 0.0), dof)

    def residuals_of_best(
        self, series: Float[Tensor, "M B"], possible: Bool[Tensor, " C"]
    ) -> tuple[Float[Tensor, "M B"], Float[Tensor, "M B"], Float[Tensor, " B"]]:
        """Return the residual of each series without and with its most likely candidate, and that candidate's dof.

        The candidate is the most likely if all noise is white (Akaike's criterion).

        Args:
            series: B of them.
            possible: candidates that may be chosen.
        """
        left = series - self._basis @ (self._basis.mT @ series)
        found = self.gains(series)
        score = torch.where(possible.unsqueeze(-1), 0.5 * found.ratio - found.dof.unsqueeze(-1), -torch.inf)
        with_best, chosen = left.clone(), score.argmax(0)
        for number in chosen.unique().tolist():
            mine = chosen == number
            basis = self._space(number)
            with_best[:, mine] -= basis @ (basis.mT @ left[:, mine])
        return left, with_best, found.dof[chosen]

    def _space(self, number: int) -> Float[Tensor, "M q"]:
        """Return orthonormal directions of a candidate that the nuisance leaves; zeros for the other directions."""
        for member, index, own, _ in self._groups:
            for place in torch.nonzero(member == number).flatten().tolist():
                columns = self._flat[:, index[place]]
                return (columns - self._basis @ (self._basis.mT @ columns)) @ own[place].to(columns)
        raise IndexError(number)

    def noise_fit(self, series: Float[Tensor, " M"]) -> NoiseFit:
        """Return family and squared size of the drift without any candidate."""
        series = series.to(self._flat.dtype).unsqueeze(-1)
        on_basis = self._basis.mT @ series
        power = (series.square().sum(0) - on_basis.square().sum(0)).double()
        slow = (self._drift.mT @ series - self._drift_basis.mT @ on_basis).double()
        no_drift = float(-0.5 * self._dof * power.log())
        best = NoiseFit(0, 0.0, float(power / self._dof), no_drift, 0.0)
        for number in self._possible:
            family = self._families[number]
            left, log_det = without_drift(power, family.axes.mT @ (family.scale.unsqueeze(-1) * slow), family)
            values = (-0.5 * log_det - 0.5 * self._dof * left.log()).squeeze(-1) - (self._walk_first if number else 0.0)
            place = int(values.argmax())
            value = float(values[place])
            if value > best.log_likelihood:
                size = float(family.sizes[1 + place])
                best = NoiseFit(number, size, float(left[place] / self._dof), value, value - no_drift)
        return best

    def estimate(self, number: int, series: Float[Tensor, " M"]) -> tuple[Tensor, Tensor]:
        """Return γ of a candidate by generalised least squares, (q,), and its covariance, at the most likely noise.

        The sign is that of the regression of the series; directions that the nuisance explains are 0.
        """
        value, gamma, covariance = self._estimates(number, series)
        best = int(value.argmax())
        return gamma[best], covariance[best]

    def doubted_error(self, number: int, series: Float[Tensor, " M"], within: float) -> Float[Tensor, " q"]:
        """Return standard errors of γ: the largest over the drift families within some nats of the most likely.

        A recording holds little information on the drift at even slower frequencies, and the size of a slow effect is
        as uncertain as that.
        """
        value, _, covariance = self._estimates(number, series)
        rows = [slice(0, 1)]
        for family in self._allowed:
            rows.append(slice(rows[-1].stop, rows[-1].stop + len(family.sizes) - 1))
        best = [part.start + int(value[part].argmax()) for part in rows]
        near = [row for row in best if float(value[row]) > float(value.max()) - within]
        return covariance[near].diagonal(dim1=-2, dim2=-1).amax(0).clamp(min=0.0).sqrt()

    def _estimates(self, number: int, series: Float[Tensor, " M"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-likelihood (R,), γ (R, q), its covariance (R, q, q) without a drift and at each of its sizes."""
        start = sum(self._widths[:number])
        index = torch.arange(start, start + self._widths[number])
        columns = self._flat[:, index]
        size_of = columns.square().sum(0).clamp(min=1e-300).rsqrt()
        columns = columns - self._basis @ (self._basis.mT @ columns)
        left = series - self._basis @ (self._basis.mT @ series)
        gram, inner, power = columns.mT @ columns, columns.mT @ left, left.square().sum()
        q = len(index)
        # one row per size of the drift; the first row is without a drift
        grams, inners = [gram.flatten().unsqueeze(0)], [inner.unsqueeze(0)]
        powers, log_dets = [power.reshape(1)], [power.new_zeros(1)]
        slow = self._drift.mT @ left
        for place in self._possible:
            family = self._families[place]
            cross = family.axes.mT @ (family.scale.unsqueeze(-1) * self._cross[:, index])
            rotated = family.axes.mT @ (family.scale * slow)
            share, sizes = family.shares, family.sizes[1:].unsqueeze(-1)
            grams.append(gram.flatten() - share @ (cross.unsqueeze(-1) * cross.unsqueeze(-2)).flatten(1))
            inners.append(inner - share @ (cross * rotated.unsqueeze(-1)))
            powers.append(power - share @ rotated.square())
            log_dets.append(torch.log1p(sizes * family.strength).sum(-1) + 2.0 * (self._walk_first if place else 0.0))
        scale = size_of.unsqueeze(-1) * size_of
        scaled = torch.cat(grams).unflatten(-1, (q, q)) * scale
        inverse = torch.linalg.pinv(scaled, hermitian=True, atol=_SINGULAR, rtol=0.0) * scale
        inner = torch.cat(inners)
        gamma = (inverse @ inner.unsqueeze(-1)).squeeze(-1)
        rest = torch.cat(powers) - (inner * gamma).sum(-1)
        value = -0.5 * torch.cat(log_dets) - 0.5 * self._dof * rest.clamp(min=1e-300).log()
        return value, gamma, inverse * (rest / self._dof)[:, None, None]

    def trace(self, number: int, series: Float[Tensor, " M"]) -> tuple[Tensor, Tensor, float]:
        """Return a candidate at its best γ, less what the nuisance explains.

        Returns:
            Its trace (M,), an orthonormal basis of the candidate's space (M, q'), and the share of the trace's square
            that the nuisance leaves.
        """
        start = sum(self._widths[:number])
        columns = self._flat[:, start : start + self._widths[number]]
        left = columns - self._basis @ (self._basis.mT @ columns)
        gamma = self.estimate(number, series)[0]
        if float(gamma.abs().max()) == 0:
            gamma = torch.ones_like(gamma)
        trace, whole = left @ gamma, columns @ gamma
        basis, size, _ = torch.linalg.svd(left, full_matrices=False)
        share = float(trace.square().sum() / whole.square().sum().clamp(min=1e-300))
        return trace, basis[:, size > 1e-6 * size[0].clamp(min=1e-300)], share

    def courses(self, series: Float[Tensor, " M"]) -> Float[Tensor, " k"]:
        """Return the best linear predictor of the cosines' amplitudes in the most likely drift, (k,)."""
        fit = self.noise_fit(series)
        if fit.size == 0:
            return self._drift.new_zeros(self._drift.shape[1])
        family = self._families[fit.family]
        left = series - self._basis @ (self._basis.mT @ series)
        rotated = family.axes.mT @ (family.scale * (self._drift.mT @ left))
        return family.scale * (family.axes @ (fit.size / (1.0 + fit.size * family.strength) * rotated))

    def drift_statistics(self, series: Float[Tensor, " M"]) -> DriftStatistics:
        """Return the statistics of a series for the most likely drift."""
        fit = self.noise_fit(series)
        family = self._families[fit.family]
        left = series - self._basis @ (self._basis.mT @ series)
        inner = family.scale * (self._drift.mT @ left)
        gram = (family.axes * family.strength) @ family.axes.mT
        return DriftStatistics(float(left.square().sum()), self._dof, inner, gram, family.scale, fit.size)

    def shares(self, series: Float[Tensor, " M"], channels: int) -> Float[Tensor, " c"]:
        """Return the relative variance of the drift in each channel, as far as the series determines it; mean 1.

        MacKay's fixed point for variance components, "Bayesian interpolation", Neural Computation 4 (1992), with a
        prior of equal channels.
        """
        fit = self.noise_fit(series)
        if fit.size == 0:
            return self._drift.new_ones(channels)
        family = self._families[fit.family]
        left = series - self._basis @ (self._basis.mT @ series)
        rotated = family.axes.mT @ (family.scale * (self._drift.mT @ left))
        share = fit.size / (1.0 + fit.size * family.strength)
        square = (family.axes @ (share * rotated)).square() / (fit.size * fit.variance)
        known = family.axes.square() @ (1.0 - share / fit.size)
        found = (square.unflatten(0, (-1, channels)).sum(0) + _EQUAL) / (
            known.unflatten(0, (-1, channels)).sum(0) + _EQUAL
        )
        return found / found.mean()

    def stationary(self, series: Float[Tensor, " M"]) -> Float[Tensor, " M"]:
        """Return the expected square of the stationary noise of each coordinate, under the most likely drift.

        It is the square of the residual after the prediction of the simulation's own tangents and the drift, plus the
        variance of that prediction, because the prediction absorbs some of the noise (the E-step for variance
        components).
        """
        fit = self.noise_fit(series)
        left = series - self._basis @ (self._basis.mT @ series)
        taken = self._basis.square().sum(-1)
        if fit.size > 0:
            family = self._families[fit.family]
            axes = family.scale.unsqueeze(-1) * family.axes
            courses = self._drift - self._basis @ self._drift_basis
            share = fit.size / (1.0 + fit.size * family.strength)
            left = left - courses @ (axes @ (share * (axes.mT @ (courses.mT @ left))))
            # half of the run time, and only a variance: single precision is enough
            taken = taken + ((courses.float() @ axes.float()).square() @ share.float()).double()
        return left.square() + fit.variance * taken

    def _profile(self, power: Tensor, inner: Tensor, slow: Tensor) -> tuple[Tensor, Tensor]:
        """Return the largest log-likelihood over the noise's sizes: without a candidate (B,), and with each (C, B)."""
        null = self._log_likelihood(power)
        best = torch.full((len(self._widths), len(power)), -torch.inf, dtype=torch.float64)
        in_family = [
            (family, family.axes.mT @ (family.scale.unsqueeze(-1) * slow), self._cross_in(family))
            for family in self._allowed
        ]
        lefts = [without_drift(power, rotated, family) for family, rotated, _ in in_family]
        for left, log_det in lefts:
            null = torch.maximum(null, (self._log_likelihood(left) - 0.5 * log_det).amax(0))
        for member, index, own, dof in self._groups:
            score = own.mT @ inner[index]  # (C, q, B)
            found = self._log_likelihood(_remaining(power, score.square().sum(-2)))
            for (family, rotated, cross), (left, log_det) in zip(in_family, lefts, strict=True):
                shadow = own.mT @ cross[index]  # (C, q, k)
                several = max(1, CELLS // max(score.numel(), 1))
                for share, rest, price in zip(
                    family.shares.split(several), left.split(several), log_det.split(several), strict=True
                ):
                    explained = _explained(score, shadow, share, rotated)
                    value = self._log_likelihood(_remaining(rest.unsqueeze(1), explained)) - 0.5 * price.unsqueeze(-1)
                    found = torch.maximum(found, value.amax(0))
            best[member] = torch.where(dof.unsqueeze(-1) > 0, found, -torch.inf)
        return null, best

    def _cross_in(self, family: DriftFamily) -> Float[Tensor, "cols k"]:
        """Return inner products of the candidates' columns with a drift's own axes."""
        return self._cross.double().mT @ (family.scale.unsqueeze(-1) * family.axes)

    def _log_likelihood(self, left: Tensor) -> Tensor:
        """Return the log-likelihood from a sum of squares, its level profiled out, up to a constant."""
        return -0.5 * self._dof * left.log()


# For hundreds of courses NumPy's BLAS took half to three quarters of the time of torch's, on an AMD processor.
def _gram(columns: Float[Tensor, "M k"]) -> Float[Tensor, "k k"]:
    """Return inner products; NumPy detects the symmetry and computes half of them."""
    known = columns.numpy()
    return torch.from_numpy(known.T @ known)


def _remaining(power: Tensor, explained: Tensor) -> Tensor:
    """Return the remaining power."""
    return (power - explained).clamp(min=1e-12 * power)


def _explained(
    score: Float[Tensor, "C q B"],
    shadow: Float[Tensor, "C q k"],
    share: Float[Tensor, "S k"],
    rotated: Float[Tensor, "k B"],
) -> Float[Tensor, "S C B"]:
    """Return what candidates explain of series given drifts of S sizes.

    Args:
        score: inner products of the candidates' directions with the series.
        shadow: those with the drift's axes.
        share: share of each axis that the drift explains.
        rotated: inner products of its axes with the series.
    """
    C, q, B = score.shape
    taken = shadow.flatten(0, 1) @ (share.mT.unsqueeze(-1) * rotated.unsqueeze(1)).flatten(1)
    score = score - taken.unflatten(0, (C, q)).unflatten(-1, (len(share), B)).movedim(-2, 0)
    pairs = (shadow.unsqueeze(2) * shadow.unsqueeze(1)).flatten(0, 2)  # (C q q, k)
    gram = torch.eye(q, dtype=shadow.dtype) - (share @ pairs.mT).unflatten(-1, (C, q, q))
    solved = score / gram if q == 1 else torch.linalg.solve(gram, score)
    return (score * solved).sum(-2)
