"""Log-likelihoods of series with and without each candidate under many noise models, in one computation.

For each noise model a Kalman filter whitens all series together: the recording, the surrogates, and the tangents of the
simulation's parameters and of the candidates. One regression per candidate remains. The log-likelihood is
restricted, with its scale profiled out, so that log det S is the penalty of process noise, and the log det of the
tangents that of the parameters (Harville, Journal of the American Statistical Association 72, 1977).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from typing import TYPE_CHECKING

import numpy as np

from mkc_torch._parallel.deadline import check_deadline
from mkc_torch._parallel.pool import shared
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models
from mkc_torch.simulation.dynamics.whitening import (
    FilterGains,
    SeriesAlong,
    gains_of,
    joined,
    whitened,
    whitened_in_blocks,
    whitened_transposed,
)

if TYPE_CHECKING:
    from jaxtyping import Float

_SINGULAR = 1e-9
"""Share of a candidate's squares, or of their largest eigenvalue, below which a direction counts as absent."""

PRICE = NoiseSettings().disturbance_gain
"""Nats that a disturbance has to gain to enter the noise model, by default."""

CELLS = 1 << 17
"""Numbers of whitened tangents per block: 1 MB, which fits into a processor's cache."""

COVARIANCES = 8_000_000
"""Numbers of the filters' covariances that are held at once: 64 MB, a few times over."""

_PARTS = 8
"""Parts of the noise models that processes take in turn."""

_DEPENDENT = 1e-10
"""Share of the largest singular value of the parameters' tangents below which a direction counts as absent."""


@dataclass(frozen=True)
class Limits:
    """Priors of parameters with two limits: gravity cannot double to explain drag.

    Attributes:
        off: (k,), distance of each limited parameter from its mean, in standard deviations.
        slope: (k, p), its derivative by the parameters.
    """

    off: Float[np.ndarray, " k"]
    slope: Float[np.ndarray, "k p"]

    @classmethod
    def of(
        cls, values: Float[np.ndarray, " p"], mean: Float[np.ndarray, " p"], precision: Float[np.ndarray, " p"]
    ) -> Limits:
        """Return the priors at these values of the parameters; a precision of 0 is no prior.

        Example:
            >>> limits = Limits.of(np.array([9.9, 1.0]), np.array([9.8, 0.0]), np.array([100.0, 0.0]))
            >>> print(limits.off.round(2), limits.slope)
            [1.] [[10.  0.]]
        """
        limited, root = precision > 0.0, np.sqrt(precision)
        return cls((root * (values - mean))[limited], np.diag(root)[limited])

    def appended(
        self, y: Float[np.ndarray, "M Y"], moved: Float[np.ndarray, "M p"], scale: float
    ) -> tuple[Float[np.ndarray, "M+k Y"], Float[np.ndarray, "M+k p"]]:
        """Append the priors to series and to the parameters' tangents, in noise of that scale."""
        off = np.repeat(scale * self.off[:, None], y.shape[1], 1)
        return np.concatenate([y, off]), np.concatenate([moved, scale * self.slope])


@dataclass(frozen=True)
class Columns:
    """Tangents along a trajectory: of the parameters, then of each candidate.

    Attributes:
        series: the tangents.
        parameters: number of parameters.
        sizes: numbers of each candidate.
        one_sided: (C,), whether a candidate's size has one sign only.
        limits: of the parameters; None without priors.
    """

    series: SeriesAlong
    parameters: int
    sizes: tuple[int, ...]
    one_sided: tuple[bool, ...]
    limits: Limits | None = None

    def places(self, number: int) -> slice:
        """Return the columns of a candidate's tangents."""
        first = self.parameters + sum(self.sizes[:number])
        return slice(first, first + self.sizes[number])


Products = list[tuple[np.ndarray, np.ndarray]]
"""For each group of candidates of q numbers: products (c, q, q) of their tangents over the norms, and norms (c, q)."""


@dataclass(frozen=True)
class LogLikelihoods:
    """Log-likelihoods of Y series under B noise models, and the first series' estimates.

    Attributes:
        models: the noise models.
        without: (B, Y), without a candidate, in nats.
        with_candidate: (B, C, Y), with each candidate.
        sizes: (B, q), of all candidates one after the other, for the first series.
        rank: (C,), number of directions of each candidate that the parameters leave.
        scale: (B, C), of the first series' noise with each candidate, relative to the model's.
        products: of the candidates' tangents under each model; None for an impossible model.
    """

    models: tuple[NoiseModel, ...]
    without: Float[np.ndarray, "B Y"]
    with_candidate: Float[np.ndarray, "B C Y"]
    sizes: Float[np.ndarray, "B q"]
    rank: Float[np.ndarray, " C"]
    scale: Float[np.ndarray, "B C"]
    products: tuple[Products | None, ...]

    def and_more(self, other: LogLikelihoods) -> LogLikelihoods:
        """Append the log-likelihoods under other models."""
        return LogLikelihoods(
            (*self.models, *other.models),
            np.concatenate([self.without, other.without]),
            np.concatenate([self.with_candidate, other.with_candidate]),
            np.concatenate([self.sizes, other.sizes]),
            np.maximum(self.rank, other.rank),
            np.concatenate([self.scale, other.scale]),
            (*self.products, *other.products),
        )

    def near_the_best(self, within: float) -> LogLikelihoods:
        """Keep the first model, and those near the most likely of a series, without or with a candidate.

        The first is the white noise of the sensors, under which the residual is that of the open loop.
        """
        gap = np.minimum(_gap(self.without).min(1), _gap(self.with_candidate).min((1, 2), initial=np.inf))
        kept = np.flatnonzero((gap <= within) | (np.arange(len(gap)) == 0))
        return LogLikelihoods(
            tuple(self.models[number] for number in kept),
            self.without[kept],
            self.with_candidate[kept],
            self.sizes[kept],
            self.rank,
            self.scale[kept],
            tuple(self.products[number] for number in kept),
        )


def _gap(values: Float[np.ndarray, "B *c Y"]) -> Float[np.ndarray, "B *c Y"]:
    """Return by how much each model is less likely than the best; inf for an impossible model."""
    best = values.max(0)
    return np.where(np.isfinite(values), np.where(np.isfinite(best), best, 0.0) - values, np.inf)


def log_likelihoods(
    flow: Flow,
    models: Sequence[NoiseModel],
    series: SeriesAlong,
    columns: Columns,
    largest: Float[np.ndarray, " p+m"] | None = None,
    thing: str = "",
    known: Sequence[Products | None] | None = None,
    price: float = PRICE,
) -> LogLikelihoods:
    """Compute the log-likelihoods; -inf if a disturbance, at its most likely scale, is implausibly large.

    Args:
        flow: of the trajectory; its ``counts`` mask the samples.
        models: of the noise; all declare the white noise of the same outputs.
        series: Y series to explain, the recording's first.
        columns: tangents that may explain them.
        largest: plausible size of a disturbance of each rate and each output, in their units; None for any.
        thing: name of a part of the noise models in the progress.
        known: products of the tangents under each model, from an earlier result for the same flow and tangents.
        price: nats that each disturbance has to gain.
    """
    length = -(-len(models) // _PARTS)
    parts = [slice(first, first + length) for first in range(0, len(models), length)]
    groups = _by_size(columns.sizes)
    own, candidates = _split(columns, groups)
    data = joined(series, own), candidates, columns, groups
    works = [
        partial(_in_this_process, flow, models[part], *data, largest, None if known is None else known[part], price)
        for part in parts
    ]
    return reduce(LogLikelihoods.and_more, shared(works, thing=thing))


def _in_this_process(
    flow: Flow,
    models: Sequence[NoiseModel],
    series: SeriesAlong,
    candidates: SeriesAlong,
    columns: Columns,
    groups: Sequence[tuple[np.ndarray, np.ndarray]],
    largest: Float[np.ndarray, " p+m"] | None,
    known: Sequence[Products | None] | None,
    price: float,
) -> LogLikelihoods:
    """Compute the log-likelihoods of series that the parameters' tangents follow."""
    B, C, Y = len(models), len(columns.sizes), series.count - columns.parameters
    used = flow.counts > 0
    without, with_candidate = np.full((B, Y), -np.inf), np.full((B, C, Y), -np.inf)
    sizes, scale, rank = np.zeros((B, sum(columns.sizes))), np.ones((B, C)), np.zeros(C)
    free = not any(models[0].known)
    kept: list[Products | None] = [None] * B
    for number, gains, place, values in _under_each(flow, models, series):
        check_deadline()
        rows = values[used]
        if not np.isfinite(rows).all():
            continue
        y, moved = np.split(rows, [Y], 1)
        basis, log_det = _basis(moved)
        left = y - basis @ (basis.T @ y)
        limits, count = columns.limits, len(rows)
        if limits is not None:
            alone = float(
                _scale(np.square(left[:, :1]).sum(), count - basis.shape[1], free, models[number].least_scale)
            )
            y, moved = limits.appended(y, moved, alone)
            basis, log_det = _basis(moved)
            left = y - basis @ (basis.T @ y)
        before = None if known is None else known[number]
        seen = left[:count]
        products = None if before is None else _products_with(flow, gains, place, candidates, seen, before)
        products = products or products_of(flow, gains, place, candidates, basis[:count], seen, groups)
        if products is None:
            continue
        kept[number] = [(gram, norm) for gram, _, norm in products]
        n = len(y) - basis.shape[1]
        level = -gains.log_spread[place] - log_det - price * len(models[number].components)
        power = np.square(left).sum(0)
        reach = _reach(models[number], largest)
        least = models[number].least_scale
        size = _scale(power, n, free, least)
        without[number] = np.where(size <= reach, level + _log_likelihood(power, n if free else 0, size), -np.inf)
        for (members, index), (gram, inner, norm) in zip(groups, products, strict=True):
            explained, solved, found = _explained(gram, inner, members, columns.one_sided)
            remains = np.maximum(power - explained, 1e-12 * power)
            size = _scale(remains, n, free, least)
            gained = level + _log_likelihood(remains, n if free else 0, size)
            with_candidate[number, members] = np.where(size <= reach, gained, -np.inf)
            sizes[number, index] = solved / norm
            rank[members] = np.maximum(rank[members], found)
            scale[number, members] = size[:, 0]
    return LogLikelihoods(tuple(models), without, with_candidate, sizes, rank, scale, tuple(kept))


def _under_each(
    flow: Flow, models: Sequence[NoiseModel], series: SeriesAlong
) -> Iterator[tuple[int, FilterGains, int, Float[np.ndarray, "N m K"]]]:
    """Yield for each model: its number, gains of a block of models, its number there, the whitened series."""
    states = flow.transition.shape[1] + max(len(model.components) for model in models)
    block = max(1, COVARIANCES // (len(flow.new) * states**2))
    for first in range(0, len(models), block):
        gains = gains_of(flow, filter_models(flow, models[first : first + block]))
        for number, values in whitened(flow, gains, series):
            yield first + number, gains, number, values


def _by_size(sizes: Sequence[int]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Group candidates by their number of columns: members, and the columns of their tangents."""
    first = np.concatenate([[0], np.cumsum(sizes)])
    groups = []
    for size in sorted(set(sizes)):
        members = np.array([c for c, width in enumerate(sizes) if width == size], dtype=int)
        groups.append((members, first[members][:, None] + np.arange(size)))
    return groups


def _basis(own: Float[np.ndarray, "M p"]) -> tuple[Float[np.ndarray, "M k"], float]:
    """Return an orthonormal basis of the parameters' tangents, and half the log det of their products."""
    if not own.shape[1]:
        return own, 0.0
    basis, values, _ = np.linalg.svd(own, full_matrices=False)
    kept = values > _DEPENDENT * max(values.max(), 1e-300)
    return basis[:, kept], float(np.log(values[kept]).sum())


def _log_likelihood(
    power: Float[np.ndarray, "*c Y"], n: int, scale: Float[np.ndarray, "*c Y"]
) -> Float[np.ndarray, "*c Y"]:
    """Return the log-likelihood of n numbers in white noise of that scale, up to a constant; n = 0 if known."""
    square = np.maximum(np.square(scale), 1e-300)
    result: np.ndarray = -0.5 * (n * np.log(square) + power / square - n)
    return result


def _scale(power: Float[np.ndarray, "*c Y"], n: int, free: bool, least: float) -> Float[np.ndarray, "*c Y"]:
    """Return the scale of the noise relative to its model: the most likely, but at least the recording's resolution."""
    return np.maximum(np.sqrt(power / max(n, 1)), least) if free else np.ones_like(power)


def _reach(model: NoiseModel, largest: Float[np.ndarray, " p+m"] | None) -> float:
    """Return the scale up to which the disturbances of a model are plausible."""
    if largest is None:
        return np.inf
    return min((float(largest[place]) / size for place, size, _ in model.components if size > 0.0), default=np.inf)


def _split(columns: Columns, groups: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[SeriesAlong, SeriesAlong]:
    """Split the tangents into the parameters' and the candidates', the latter by group and then by number."""
    new, shift, p = columns.series.new, columns.series.shift, columns.parameters
    order = np.concatenate([p + index.T.ravel() for _, index in groups] or [np.zeros(0, dtype=int)])
    own = SeriesAlong(new[..., :p], shift[..., :p])
    return own, SeriesAlong(np.ascontiguousarray(new[..., order]), np.ascontiguousarray(shift[..., order]))


def products_of(
    flow: Flow,
    gains: FilterGains,
    number: int,
    candidates: SeriesAlong,
    basis: Float[np.ndarray, "M k"],
    left: Float[np.ndarray, "M Y"],
    groups: Sequence[tuple[np.ndarray, np.ndarray]],
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]] | None:
    """Return products of the candidates' whitened tangents, summed over blocks that fit into the cache.

    Returns:
        For each group of c candidates of q numbers: the products (c, q, q) of what the parameters leave of the
        tangents, over their norms; their products (c, q, Y) with the series, likewise; the norms (c, q). None if some
        are not finite.
    """
    m, K = candidates.new.shape[1:]
    used = flow.counts > 0
    first = np.concatenate([[0], np.cumsum(used.sum(1))])
    known = np.concatenate([basis, left], 1).T
    crossed = np.zeros((len(known), K))
    pairs = [np.zeros((*index.shape[1:], *index.shape[::-1])) for _, index in groups]
    places = np.cumsum([0, *(index.size for _, index in groups)])
    for rows, values in whitened_in_blocks(flow, gains, number, candidates, max(CELLS // max(m * K, 1), 16)):
        counts = used[rows]
        block = values.reshape(-1, K) if counts.all() else values[counts]
        crossed += known[:, first[rows.start] : first[rows.stop]] @ block
        for pair, place in zip(pairs, places, strict=False):
            q, _, c = pair.shape
            parts = [block[:, place + a * c : place + (a + 1) * c] for a in range(q)]
            for a in range(q):
                for b in range(a + 1):
                    pair[a, b] += np.einsum("nc,nc->c", parts[a], parts[b])
    found = []
    for pair, place in zip(pairs, places, strict=False):
        q, _, c = pair.shape
        here = crossed[:, place : place + q * c].reshape(-1, q, c)
        along, inner = here[: basis.shape[1]], here[basis.shape[1] :]
        norm = np.maximum(np.sqrt(np.einsum("aac->ac", pair)), 1e-300)
        lower = np.tril(np.ones((q, q)), -1)[..., None] * pair
        whole = pair + lower.swapaxes(0, 1)
        rest = (whole - np.einsum("kac,kbc->abc", along, along)) / norm[:, None] / norm
        if not (np.isfinite(rest).all() and np.isfinite(inner).all()):
            return None
        found.append((rest.transpose(2, 0, 1), (inner / norm).transpose(2, 1, 0), norm.T))
    return found


def _products_with(
    flow: Flow,
    gains: FilterGains,
    number: int,
    candidates: SeriesAlong,
    left: Float[np.ndarray, "M Y"],
    known: Products,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]] | None:
    """Return the result of :func:`products_of` with known products of the tangents; None where that is not possible.

    The transposed whitening of the few series replaces the whitening of the many tangents.
    """
    innovations = np.zeros((*flow.counts.shape, left.shape[1]))
    innovations[flow.counts > 0] = left
    back = whitened_transposed(flow, gains, number, innovations)
    if back is None:
        return None
    K, Y = candidates.count, left.shape[1]
    inner = candidates.new.reshape(-1, K).T @ back.new.reshape(-1, Y)
    inner += candidates.shift.reshape(-1, K).T @ back.shift.reshape(-1, Y)
    if not np.isfinite(inner).all():
        return None
    found, place = [], 0
    for gram, norm in known:
        c, q = norm.shape
        here = inner[place : place + q * c].reshape(q, c, Y).swapaxes(0, 1)
        found.append((gram, here / norm[..., None], norm))
        place += q * c
    return found


def _explained(
    gram: Float[np.ndarray, "c q q"],
    own: Float[np.ndarray, "c q Y"],
    members: np.ndarray,
    one_sided: Sequence[bool],
) -> tuple[Float[np.ndarray, "c Y"], Float[np.ndarray, "c q"], Float[np.ndarray, " c"]]:
    """Return explained squares for candidates of one size, minus the first series' estimates, and the ranks."""
    values, vectors = np.linalg.eigh(gram)
    kept = values > np.maximum(_SINGULAR, _SINGULAR * values[:, -1:])
    inverse = (vectors * np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)[:, None]) @ vectors.swapaxes(1, 2)
    solved = inverse @ own
    # the residual decreases by what an effect adds: a negative slope is a positive size
    barred = np.array([one_sided[c] for c in members])[:, None] & (solved >= 0).all(1)
    explained = np.where(barred, 0.0, (own * solved).sum(1))
    return explained, np.where(barred[:, :1], 0.0, -solved[:, :, 0]), kept.sum(1)
