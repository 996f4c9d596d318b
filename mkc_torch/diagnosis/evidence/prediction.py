"""Prediction as evidence: of held-out blocks, and of high values of a driver from low values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.order_statistic import robust_scale
from mkc_torch.density.fit import fit_density
from mkc_torch.diagnosis.evidence.base import EvidenceContext, EvidenceResult
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval, held_out, on_all, scored
from mkc_torch.diagnosis.goodness_of_fit import size_of
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_only_drift, has_process_noise, refit_open_loop
from mkc_torch.diagnosis.model.term import Term, run_parallel
from mkc_torch.diagnosis.result import DivergedBlock, Extrapolation, HeldOut, ResidualSizes
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.functional import mkc_nll, mkc_weight
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.protocol import PreparedSimulation

if TYPE_CHECKING:
    from jaxtyping import Bool


_RANGE = 1.0
"""Residual, in ranges of the recorded output, beyond which a sample has diverged."""

_MOST_DIVERGED = 0.2
"""Share of diverged samples above which a block has diverged; a few outliers are no divergence."""

_GIVEN_OTHERS = "Scored given the other findings; without them, it is masked."

_TOO_SHORT = "a side of the step is shorter than two held-out blocks"

_BLOCKS, _FEWEST = 25, 5
"""Blocks of the bootstrap, and the minimum number of blocks with high values."""

_REACH = 3.0
"""Minimum half-width of the density's domain, in robust scales of the residual."""

_Run = tuple[FittedModel, Evidence]


def kept_blocks(
    prepared: PreparedSimulation, models: Sequence[Evidence], blocks: HeldOutBlocks
) -> tuple[Bool[Tensor, " N"], list[list[int]]]:
    """Return the samples of blocks in which no model diverges, and each model's diverged blocks, from 0."""
    known = prepared.measured
    count = int(blocks.block.max()) + 1
    kept = torch.ones_like(blocks.block, dtype=torch.bool)
    diverged = []
    for model in models:
        residual = model.residual
        if known.shape == residual.shape:
            reach = _RANGE * (known.amax(0) - known.amin(0))
            out = ~(residual.abs() <= reach) & (reach > 0)
        else:
            out = ~residual.isfinite()
        many = torch.zeros(count).index_add(0, blocks.block, out.any(-1).float())
        size = torch.zeros(count).index_add(0, blocks.block, torch.ones(len(out)))
        gone = many > _MOST_DIVERGED * size
        diverged.append(gone.nonzero().squeeze(-1).tolist())
        kept &= ~gone[blocks.block]
    return kept, diverged


def sizes_of(
    prepared: PreparedSimulation, units: Sequence[str], before: Evidence, after: Evidence, blocks: HeldOutBlocks
) -> tuple[dict[str, ResidualSizes], tuple[DivergedBlock, ...]]:
    """Return each output's residual before and after, in its unit, and the diverged blocks, which are excluded."""
    kept, (lost_before, lost_after) = kept_blocks(prepared, (before, after), blocks)
    diverged = tuple(
        DivergedBlock(block + 1, block in lost_before, block in lost_after)
        for block in sorted({*lost_before, *lost_after})
    )
    if not bool(kept.any()):
        return {}, diverged
    size_before, size_after = size_of(before.residual[kept]), size_of(after.residual[kept])
    return {
        name: ResidualSizes(float(size_before[k]), float(size_after[k]), units[k])
        for k, name in enumerate(prepared.channels)
    }, diverged


def without_finding(case: EvidenceContext) -> Evidence | None:
    """Score the final model without the finding, if later findings may have masked its gain and if it can be fitted."""
    if not case.overlaid or confirmed_alone(case):
        return None
    try:
        return held_out(case.without_and_with[0], case.blocks)
    except NoFitError:
        return None


def confirmed_alone(case: EvidenceContext) -> bool:
    """Whether held-out blocks confirm the finding without the later findings."""
    before, after = case.pairs[case.number] if case.pairs else case.held_out[case.number : case.number + 2]
    difference = after.log_likelihood - before.log_likelihood
    return gain_interval(difference, case.blocks.block, torch.Generator().manual_seed(case.seed))[1][0] > 0.0


def held_out_gain_evidence(case: EvidenceContext) -> EvidenceResult:
    """Return the log-likelihood gain with its interval, and the residuals before and after."""
    if not _long_enough(case, case.number):
        return held_out_gain_result(None, _TOO_SHORT)
    before, after = case.held_out[case.number : case.number + 2]
    worse, better = case.pairs[case.number] if case.pairs else (before, after)
    note = ""
    if case.ahead is not None:
        before, after, note = case.ahead, case.held_out[-1], _GIVEN_OTHERS
        worse, better = before, after
    gain, interval = gain_interval(better.log_likelihood - worse.log_likelihood, case.blocks.block, _draws(case))
    outputs, diverged = sizes_of(case.prepared, case.units, before, after, case.blocks)
    only = next(iter(outputs.values())) if len(outputs) == 1 and case.of_states else None
    sizes = (case.rms(before), case.rms(after)) if only is None else (only.before, only.after)
    count, decides = int(case.blocks.block.max()) + 1, not case.located.with_noise
    held = HeldOut(gain, interval, *sizes, case.prepared.unit, outputs, diverged, count, decides)
    return held_out_gain_result(held, note)


def held_out_gain_result(held: HeldOut | None, note: str) -> EvidenceResult:
    """Return the gain, or the reason why it was not measured."""
    return EvidenceResult("held_out", (held, note), keys={"held_out": held, "held_out_note": note})


def _long_enough(case: EvidenceContext, number: int) -> bool:
    """Whether both sides of a finding's onset can be held out."""
    onset, time = case.found[number].term.shape.get("onset"), case.prepared.time
    if onset is None:
        return True
    shorter = min(int((time < onset).sum()), int((time >= onset).sum()))
    return shorter >= 2 * len(time) // (int(case.blocks.block.max()) + 1)


def _draws(case: EvidenceContext) -> torch.Generator:
    """Return the generator after the draws of the previous findings."""
    generator = torch.Generator().manual_seed(case.seed)
    for number in range(case.number):
        if _long_enough(case, number):
            gain_interval(case.held_out[0].log_likelihood, case.blocks.block, generator)
    return generator


def extrapolation_of_finding(case: EvidenceContext) -> Extrapolation | None:
    return extrapolated(*case.without_and_with, case.term, case.seed, case.settings.evidence)


def extrapolation_evidence(case: EvidenceContext) -> EvidenceResult:
    """Score the finding at high values of its driver."""
    return extrapolation_result(case.ahead)


def extrapolation_result(extrapolation: Extrapolation | None) -> EvidenceResult:
    return EvidenceResult("extrapolation", extrapolation)


def extrapolated(
    without: FittedModel, fit: FittedModel, term: Term, seed: int, settings: EvidenceSettings
) -> Extrapolation | None:
    """Fit with and without an effect to low values of its driver, and compare the scores at high values.

    A driver of several columns is high if it is far from its mean. The shapes of effects and the bound are fixed.

    Args:
        without: the model without the effect.
        fit: the model with the effect.
        term: the effect.
        seed: of the block bootstrap.
        settings: definition of low values.

    Returns:
        None without a recorded driver, if its low values hardly vary (a switch), if the high values are in too few
        blocks, or if a model cannot be fitted to the low values.
    """
    reach = _reach(term)
    if reach is None:
        return None
    low = reach <= torch.quantile(reach, settings.low_share)
    high = ~low
    block = (torch.arange(len(reach)) * _BLOCKS).div(len(reach), rounding_mode="floor")[high]
    seen, block = block.unique_consecutive(return_inverse=True)
    spread = float(reach[low].max() - reach[low].min())
    if spread < settings.low_spread * float(reach.max() - reach.min()) or len(seen) < _FEWEST:
        return None
    try:
        before, after = (_score(model, low)[high] for model in (without, fit))
    except NoFitError:
        return None
    gain, interval = gain_interval(after - before, block, torch.Generator().manual_seed(seed))
    return Extrapolation(gain, interval)


def _reach(term: Term) -> Tensor | None:
    if term.driver is None:
        return None
    values = term.driver.values
    return values[:, 0] if values.shape[1] == 1 else torch.linalg.vector_norm(values, dim=-1)


def _score(fit: FittedModel, rows: Tensor) -> Tensor:
    found = fitted(fit.model, fit.parameters, fit.bound, rows=rows.to(fit.residual.dtype), graduate=False)
    return scored(found.residual, found.sigma, found.d, found.bound, found.recorded)


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
