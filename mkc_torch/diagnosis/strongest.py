"""The candidates that a joint refit makes the most of, from starts that a bad first fit cannot hide."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.closing_in import refined
from mkc_torch.diagnosis.linearise import Linearised, Tangents, linearise, tangents_of
from mkc_torch.diagnosis.model import Key, Term, one_sided
from mkc_torch.diagnosis.preference import Preference
from mkc_torch.diagnosis.refit import FittedModel, clipped_residual, fitted_beside, repeats
from mkc_torch.diagnosis.side_by_side import fitted_each
from mkc_torch.order_statistic import robust_scale
from mkc_torch.simulation.protocol import Beginning

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["refitted", "strongest"]

_SHORT_LIST = 6
_PARTS, _BETTER = 2, 0.8
_AWAY = 5.0
"""Times that a parameter is larger, or smaller, than where its fit began."""

_LEADING, _THIRD, _MUCH = 2, 0.6, 50.0
"""Fits whose shapes are tried; a third one, where it has this share of the first one's score and as many nats."""

_SHAPES = 5

Start = tuple[Tensor, tuple[Tensor, Tensor]]
"""Parameters to linearise around, and the pseudo-residual there with what counts of it."""

Listed = tuple[Term, Tensor, Tensor]
"""A candidate worth a joint refit, with the parameters and the γ to start from."""


def strongest(base: FittedModel, terms: tuple[Term, ...], prefer: Preference, *, parts: bool) -> list[FittedModel]:
    """The joint refits, the likeliest first; the leading ones each at its best shape, and behind them the others.

    Candidates are ranked by the likelihood's own score and by a clipped one, which still sees a stretch of samples that
    the fit rejects; and, where one model over all of the recording runs away, around fits to parts of it, and around
    where its fit began.
    """
    around, likeliest = base.parameters, base.parameters.new_zeros(len(terms))
    tangents = tangents_of(base.model, around, terms)
    listed = _short_list(base, terms, (around, base.pseudo), tangents, _SHORT_LIST, likeliest)
    listed += _short_list(base, terms, (around, clipped_residual(base.residual)), tangents, 2, likeliest)
    fits: dict[Key, FittedModel] = {}
    _refit_all(fits, base, listed, prefer)
    if parts:
        least = torch.stack([fit.d for fit in fits.values()]).amin(0)
        listed = []
        for start in (*_part_starts(base, least), *_first_start(base)):
            listed += _short_list(base, terms, start, tangents_of(base.model, start[0], terms), 2, likeliest)
        _refit_all(fits, base, listed, prefer)
    leading = sorted(fits.values(), key=lambda fit: prefer.score(fit, base), reverse=True)[: _LEADING + 1]
    close = max(_THIRD * prefer.score(leading[0], base), _MUCH)
    leading = [fit for place, fit in enumerate(leading) if place < _LEADING or prefer.score(fit, base) > close]
    order = [terms[number] for number in likeliest.argsort().tolist()]

    def shaped_best(fit: FittedModel) -> FittedModel:
        fit.model.residual(fit.parameters)  # what other shapes of it begin with, where a simulation remembers
        return refined(_best_shape(fit, base, order, prefer), base)

    shaped = fitted_each(base, [partial(shaped_best, fit) for fit in leading], terms)
    shaped = [fit for fit in shaped if repeats(fit)] or [fit for fit in fits.values() if repeats(fit)]
    if not shaped:
        raise ValueError(
            f"The simulation gave finite outputs while {len(fits)} effects were fitted, and gives none now at the same "
            "parameters: it is at the edge of what can be solved. Shorten the experiments, or give a `segment`."
        )
    keys = {fit.model.terms[-1].key for fit in shaped}
    parted = shaped, [fit for key, fit in fits.items() if key not in keys]
    return [fit for part in parted for fit in sorted(part, key=lambda fit: prefer.score(fit, base), reverse=True)]


def _short_list(
    base: FittedModel,
    terms: tuple[Term, ...],
    start: Start,
    tangents: Tangents,
    most: int,
    likeliest: Float[Tensor, " C"],
) -> list[Listed]:
    """The strongest candidates, noise taken for white; ``likeliest`` takes the log of each one's p."""
    parameters, (pseudo, counts) = start
    plain = linearise(base.model, parameters, pseudo, counts, tangents, white=True, wander=False)
    log_p = plain.search.gains(plain.series.unsqueeze(-1)).log_p[:, 0]
    torch.minimum(likeliest, log_p, out=likeliest)
    chosen: dict[Key, Listed] = {}
    for number in log_p.argsort().tolist():
        term = terms[number]
        if term.key not in chosen:
            gamma, _ = plain.search.estimate(number, plain.series)
            if one_sided(term.effect):
                gamma = gamma.clamp(max=0.0)
                if not bool(gamma.any()):
                    continue
            chosen[term.key] = term, parameters, -gamma
        if len(chosen) >= most:
            break
    if not chosen:
        # none has a size of a sign that its physics allows; one of them is still to be told to be nothing
        chosen[terms[0].key] = terms[0], parameters, parameters.new_zeros(_size(terms[0], base))
    return list(chosen.values())


def _size(term: Term, base: FittedModel) -> int:
    return base.model.with_term(term).sizes[-1]


def _part_starts(base: FittedModel, d: Float[Tensor, " m"]) -> list[Start]:
    """Around fits to parts of the recording; those only that fit their part clearly better than d allows for."""
    prepared = base.model.prepared
    N = len(prepared.time)
    starts = []
    for part in range(_PARTS):
        rows = torch.zeros(N, dtype=torch.bool)
        rows[part * N // _PARTS : (part + 1) * N // _PARTS] = True
        try:
            theta = prepared.start(rows)
        except ValueError:
            continue
        parameters = torch.cat([theta, base.parameters[base.model.base :]])
        residual = base.model.residual(parameters)
        if bool((robust_scale(residual[rows]) < _BETTER * d).any()):
            starts.append((parameters, clipped_residual(residual)))
    return starts


def _first_start(base: FittedModel) -> list[Start]:
    """Around where the fit began, if a parameter of the equations went far from there: what they lack can drive it."""
    prepared = base.model.prepared
    if not isinstance(prepared, Beginning):
        return []
    theta, own = prepared.start(), base.model.base - prepared.beginnings
    sizes = torch.stack([theta[:own], base.parameters[:own]]).abs()
    if not bool((sizes.amax(0) > _AWAY * sizes.amin(0)).any()):
        return []
    parameters = torch.cat([theta, base.parameters[base.model.base :]])
    residual = base.model.residual(parameters)
    return [(parameters, clipped_residual(residual))] if bool(residual.isfinite().all()) else []


def _refit_all(fits: dict[Key, FittedModel], base: FittedModel, listed: Sequence[Listed], prefer: Preference) -> None:
    """Put the joint refit of each into ``fits``, where it is the better one of its physics."""
    first: dict[tuple[Key, int], Listed] = {}
    for one in listed:
        first.setdefault((one[0].key, id(one[1])), one)
    works = [
        partial(fitted_beside, base, base.model.with_term(term), torch.cat([parameters, gamma]))
        for term, parameters, gamma in first.values()
    ]
    found = fitted_each(base, works, [term for term, _, _ in first.values()])
    for (key, _), fit in zip(first, found, strict=True):
        if key not in fits or prefer.score(fit, base) > prefer.score(fits[key], base):
            fits[key] = fit


def _best_shape(fit: FittedModel, base: FittedModel, terms: Sequence[Term], prefer: Preference) -> FittedModel:
    """The fit, or a better one with another shape of the same effect, the likeliest of ``terms`` first.

    Onsets are many, and closed in on later.
    """
    own = fit.model.terms[-1]
    others = [t for t in terms if t.key == own.key and t.shape != own.shape]
    if "onset" in own.shape or not others:
        return fit
    refits = [_reshaped(fit, base, other) for other in others[:_SHAPES]]
    return max([fit, *refits], key=lambda f: prefer.score(f, base))


def _reshaped(fit: FittedModel, base: FittedModel, term: Term) -> FittedModel:
    model = base.model.with_term(term)
    kept = fit.parameters[: model.size]
    more = kept.new_zeros(model.size - len(kept))
    return fitted_beside(base, model, torch.cat([kept, more]), graduate=False)


def refitted(best: FittedModel, base: FittedModel, term: Term, linearised: Linearised, number: int) -> FittedModel:
    gamma, _ = linearised.search.estimate(number, linearised.series)
    gamma = gamma.clamp(max=0.0) if one_sided(term.effect) else gamma
    start = torch.cat([best.parameters[: base.model.size], -gamma])
    return fitted_beside(base, base.model.with_term(term), start)
