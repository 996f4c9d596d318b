"""What was found beside noise, as a free run: what residuals are computed from, and pictures show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, held_out, on_all
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.parallel import run_parallel
from mkc_torch.diagnosis.model.process_noise import open_loop, refit_open_loop, has_process_noise
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.functional import mkc_nll, mkc_weight
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

__all__ = ["OpenLoop", "open_loop_evidence", "running_unjudged"]


_REACH = 3.0
"""Robust scales of a residual that the domain of its density reaches to at least."""


@dataclass(frozen=True)
class OpenLoop:
    """The simulation alone and with one finding more each, on all samples and on blocks that each fit has not seen."""

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
    """The free runs; what was found as it is, where one of them loses the recording.

    Args:
        base: the simulation alone, perhaps under process noise.
        alone: as it runs freely; None where that loses the recording.
        found: with one finding more each, under the noise that is left.
        evidence: of these on blocks.
        blocks: the blocks.
    """
    as_it_is = OpenLoop(base, found, evidence)
    if not any(has_process_noise(fit) for fit in (base, *(one.fit for one in found))) or alone is None:
        return as_it_is
    works = [
        partial(_released if _of_sensors(element.fit) else _refitted, element.fit, known, blocks, alone)
        for element, known in zip(found, evidence[1:], strict=True)
    ]
    runs = run_parallel([partial(_judged, alone, evidence[0], blocks), *works], alone.model.prepared)
    known_runs = [run for run in runs if run is not None]
    if len(known_runs) < len(runs):
        return as_it_is
    again = tuple(replace(item, fit=fit) for item, (fit, _) in zip(found, known_runs[1:], strict=True))
    return OpenLoop(alone, again, tuple(judged for _, judged in known_runs))


def running_unjudged(base: FittedModel, alone: FittedModel | None, found: tuple[SearchResult, ...]) -> OpenLoop:
    """The same on all samples, where nobody asks blocks that the fits have not seen.

    Args:
        base, alone, found: as of :func:`open_loop_evidence`.
    """
    fits = [base, *(one.fit for one in found)]
    if any(has_process_noise(fit) for fit in fits) and alone is not None:
        free = [alone, *(refit_open_loop(element.fit) for element in found)]
        known = [run for run in free if run is not None]
        fits = known if len(known) == len(free) else fits
    again = tuple(replace(item, fit=fit) for item, fit in zip(found, fits[1:], strict=True))
    return OpenLoop(fits[0], again, tuple(on_all(fit) for fit in fits))


def _of_sensors(fit: FittedModel) -> bool:
    """Whether only errors of sensors are left beside a fit: its parameters are then those of a free run."""
    prepared = fit.model.prepared
    observer = prepared.observer if isinstance(prepared, PreparedDynamics) else None
    return observer is not None and not any(disturbance.at_rate for disturbance in observer.disturbances)


_Run = tuple[FittedModel, Evidence]


def _released(fit: FittedModel, known: Evidence, blocks: HeldOutBlocks, alone: FittedModel) -> _Run | None:
    """The free run at a fit's own parameters, on all samples and, at each fold's, on blocks."""
    model = JointModel(open_loop(fit.model.prepared), fit.model.terms, fit.model.near)
    residual = model.residual(fit.parameters).detach()
    if not bool(residual.isfinite().all()):
        return _refitted(fit, known, blocks, alone)
    unseen = residual.clone()
    for number, parameters in enumerate(known.parameters):
        out = model.residual(parameters).detach()
        seen = blocks.fold == number
        unseen[seen] = out[seen]
    if not bool(unseen.isfinite().all()):
        return _refitted(fit, known, blocks, alone)
    bound = fit.bound.maximum(_REACH * robust_scale(residual))
    density = fit_density(residual, bound=bound)
    sigma, d = density.sigma, density.d
    free = replace(
        fit,
        model=model,
        residual=residual,
        sigma=sigma,
        d=d,
        weights=mkc_weight(residual, sigma, d),
        bound=bound,
        log_likelihood=-float(mkc_nll(residual, sigma, d, bound).sum()),
    )
    return free, replace(known, residual=unseen, sigma=sigma, d=d)


def _refitted(fit: FittedModel, _: Evidence, blocks: HeldOutBlocks, alone: FittedModel) -> _Run | None:
    """A fit of the free run: from the parameters beside process noise, which may need it, and from those without."""
    ways = [partial(refit_open_loop, fit), partial(_from_alone, fit, alone)]
    tried = [model_fit for model_fit in run_parallel(ways, alone.model.prepared, fit.model.terms) if model_fit is not None]
    return _judged(max(tried, key=lambda one: one.log_likelihood), None, blocks) if tried else None


def _from_alone(fit: FittedModel, alone: FittedModel) -> FittedModel | None:
    model = JointModel(open_loop(fit.model.prepared), fit.model.terms, alone.model.near)
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
