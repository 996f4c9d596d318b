"""Open-loop simulations with findings that were fitted with process noise; residuals and figures use them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out, on_all
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_only_drift, has_process_noise, refit_open_loop
from mkc_torch.diagnosis.model.term import run_parallel
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.functional import mkc_nll, mkc_weight
from mkc_torch.nonlinear import NoFitError

_REACH = 3.0
"""Minimum half-width of the density's domain, in robust scales of the residual."""


@dataclass(frozen=True)
class OpenLoop:
    """Fits without findings and with 1, 2, ... findings, and their scores on held-out blocks."""

    base: FittedModel
    found: tuple[SearchResult, ...]
    held_out: tuple[Evidence, ...]


def open_loop_evidence(
    base: FittedModel,
    alone: FittedModel | None,
    found: tuple[SearchResult, ...],
    evidence: tuple[Evidence, ...],
    blocks: HeldOutBlocks,
) -> OpenLoop:
    """Return the open-loop fits; the given fits if an open-loop simulation diverges.

    Args:
        base: fit without findings, possibly with process noise.
        alone: its open-loop fit; None if it diverges.
        found: fits with 1, 2, ... findings, with the remaining process noise.
        evidence: their scores on held-out blocks.
        blocks: the held-out blocks.
    """
    unchanged = OpenLoop(base, found, evidence)
    if not any(has_process_noise(fit) for fit in (base, *(located.fit for located in found))) or alone is None:
        return unchanged
    works = [
        partial(_released if has_only_drift(located.fit) else _refitted, located.fit, known, blocks, alone)
        for located, known in zip(found, evidence[1:], strict=True)
    ]
    runs = run_parallel([partial(_judged, alone, evidence[0], blocks), *works], alone.model.prepared)
    known_runs = [run for run in runs if run is not None]
    if len(known_runs) < len(runs):
        return unchanged
    again = tuple(replace(located, fit=fit) for located, (fit, _) in zip(found, known_runs[1:], strict=True))
    return OpenLoop(alone, again, tuple(judged for _, judged in known_runs))


def running_unjudged(base: FittedModel, alone: FittedModel | None, found: tuple[SearchResult, ...]) -> OpenLoop:
    """Return the open-loop fits with scores on all samples, without held-out blocks.

    Args:
        base, alone, found: as of :func:`open_loop_evidence`.
    """
    fits = [base, *(located.fit for located in found)]
    if any(has_process_noise(fit) for fit in fits) and alone is not None:
        free = [alone, *(refit_open_loop(located.fit) for located in found)]
        known = [run for run in free if run is not None]
        fits = known if len(known) == len(free) else fits
    again = tuple(replace(located, fit=fit) for located, fit in zip(found, fits[1:], strict=True))
    return OpenLoop(fits[0], again, tuple(on_all(fit) for fit in fits))


_Run = tuple[FittedModel, Evidence]


def open_loop_at(fit: FittedModel) -> FittedModel | None:
    """Return the open-loop simulation at a fit's parameters, without a refit; None if it diverges."""
    model = JointModel(fit.model.prepared.open_loop(), fit.model.terms, fit.model.near)
    residual = model.residual(fit.parameters).detach()
    if not bool(residual.isfinite().all()):
        return None
    bound = fit.bound.maximum(_REACH * robust_scale(residual))
    density = fit_density(residual, bound=bound)
    sigma, d = density.sigma, density.d
    return replace(
        fit,
        model=model,
        residual=residual,
        sigma=sigma,
        d=d,
        weights=mkc_weight(residual, sigma, d),
        bound=bound,
        log_likelihood=-float(mkc_nll(residual, sigma, d, bound).sum()),
    )


def _released(fit: FittedModel, known: Evidence, blocks: HeldOutBlocks, alone: FittedModel) -> _Run | None:
    """Simulate open loop with a fit's parameters, and on each fold with the parameters without it."""
    free = open_loop_at(fit)
    if free is None:
        return _refitted(fit, known, blocks, alone)
    unseen = free.residual.clone()
    for number, parameters in enumerate(known.parameters):
        out = free.model.residual(parameters).detach()
        seen = blocks.fold == number
        unseen[seen] = out[seen]
    if not bool(unseen.isfinite().all()):
        return _refitted(fit, known, blocks, alone)
    return free, replace(known, residual=unseen, sigma=free.sigma, d=free.d)


def _refitted(fit: FittedModel, _: Evidence, blocks: HeldOutBlocks, alone: FittedModel) -> _Run | None:
    """Fit open loop, starting from the parameters with process noise and from those without findings."""
    ways = [partial(refit_open_loop, fit), partial(_from_alone, fit, alone)]
    tried = [result for result in run_parallel(ways, alone.model.prepared, fit.model.terms) if result is not None]
    return _judged(max(tried, key=lambda result: result.log_likelihood), None, blocks) if tried else None


def _from_alone(fit: FittedModel, alone: FittedModel) -> FittedModel | None:
    model = JointModel(fit.model.prepared.open_loop(), fit.model.terms, alone.model.near)
    start = torch.cat([alone.parameters, fit.parameters.new_zeros(model.size - alone.model.size)])
    try:
        return fitted(model, start, fit.bound, graduate=False)
    except NoFitError:
        return None


def _judged(fit: FittedModel, _: Evidence | None, blocks: HeldOutBlocks) -> _Run | None:
    try:
        return fit, held_out(fit, blocks)
    except NoFitError:
        return None
