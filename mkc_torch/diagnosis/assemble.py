"""A :class:`Diagnosis` from what the searches found and what was told of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.diagnosis.evidence.after_the_search import Ending, nameless
from mkc_torch.diagnosis.evidence.density import density_warnings
from mkc_torch.diagnosis.evidence.driver_shift import shift_warning
from mkc_torch.diagnosis.evidence.extrapolation import extrapolation_warning
from mkc_torch.diagnosis.evidence.held_out import Evidence, HeldOutBlocks, gain_interval
from mkc_torch.diagnosis.evidence.remaining import remaining_warning
from mkc_torch.diagnosis.files.model import model_of
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.findings.finding import finding_of
from mkc_torch.diagnosis.findings.noise import noise_summary
from mkc_torch.diagnosis.findings.separability import separability
from mkc_torch.diagnosis.linearised.estimate import Estimate
from mkc_torch.diagnosis.model.drivers import Drivers
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.grid import described
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.noise.rejected import rejected_warning
from mkc_torch.diagnosis.result import Candidate, Diagnosis, HeldOut, Separability, Spread, Traces, Verdict
from mkc_torch.diagnosis.rounds import Asked, Search
from mkc_torch.diagnosis.search.locate import Located
from mkc_torch.recording.unit_warnings import unit_warnings
from mkc_torch.simulation.protocol import PreparedSimulation, Simulation

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


_BESIDE = "Judged beside the other findings: while those are left out, they hide it."

_IN_USE = 0.5
"""Weight from which a sample is one that the fit believes."""


def assembled(
    simulation: Simulation,
    prepared: PreparedSimulation,
    drivers: Drivers,
    tried: int,
    base: FittedModel,
    search: Search,
    ending: Ending,
    asked: Asked,
) -> Diagnosis:
    generator = torch.Generator().manual_seed(asked.seed)
    found, blocks, evidence, first = search.found, search.blocks, search.evidence, search.first
    final = ending.final
    inliers = (evidence[-1].residual.abs() <= 3.0 * evidence[-1].d) & (final.fit.weights > _IN_USE)

    def judged(k: int, term: Term, without: Evidence | None) -> tuple[HeldOut | None, str]:
        if without is None:
            return _held(evidence[k], evidence[k + 1], blocks, inliers, term, prepared, generator)
        held, note = _held(without, evidence[-1], blocks, inliers, term, prepared, generator)
        return held, note if held is None else _BESIDE

    findings = [
        replace(
            finding_of(s, final, k, *judged(k, s.term, more.without)),
            extrapolation=more.extrapolation,
            driver_shift=more.driver_shift,
            onset_interval=more.onset_interval,
        )
        for k, (s, more) in enumerate(zip(found, ending.beyond, strict=True))
    ]
    noise = noise_summary(final)
    diagnosis = Diagnosis(
        recording=prepared.recording.name,
        simulation=prepared.name,
        samples=len(prepared.time),
        level=asked.level,
        noise=noise,
        candidates_tried=tried,
        surrogates=asked.surrogates,
        seed=asked.seed,
        p_value=first.p_value if first else 1.0,
        verdict=_verdict(first, found, final.fit, ending.left, search.cut, asked),
        findings=tuple(findings),
        baseline=_spread(evidence[0], inliers),
        corrected=_spread(evidence[-1], inliers),
        ceiling=_spread(ending.reach.evidence, inliers),
        advice=(),
        warnings=(
            *prepared.recording.warnings,
            *unit_warnings(prepared.recording),
            *prepared.warnings,
            *drivers.warnings,
            *_time_warnings(prepared),
            *remaining_warning(ending.left),
            *_in_one_stretch(first, prepared.time),
            *(() if prepared.recording.time is None else rejected_warning(prepared.time, final.fit.weights)),
            *ending.stand_in,
            *(sentence for finding in findings for sentence in shift_warning(finding)),
            *(sentence for finding in findings for sentence in extrapolation_warning(finding)),
            *density_warnings(noise.checks),
        ),
        candidates=_candidates(first),
        separability=separability(first) if first else _nothing_to_separate(),
        traces=_traces(prepared, drivers, base, final),
        remaining=ending.left,
        model=model_of(final, simulation),
    )
    return replace(diagnosis, advice=advice_of(diagnosis))


def _verdict(
    first: Located | None,
    found: Sequence[Located],
    final: FittedModel,
    left: Sequence[str],
    cut: bool,
    asked: Asked,
) -> Verdict:
    """Whether there is structure beyond the noise, and whether the findings account for it."""
    if not found:
        there = bool(left) or (first is not None and first.p_value <= asked.level)
        return "unexplained" if there else "adequate"
    return "unexplained" if nameless(final) or left or cut else "explained"


def with_rest(diagnosis: Diagnosis, search: Search) -> Diagnosis:
    """With what the last search found that does not count, and why there was no other."""
    more = [_not_confirmed(search.unconfirmed)] if search.unconfirmed else []
    if search.given_up:
        more.append(f"The search beside what was found was given up. {search.given_up}")
    if search.cut:
        more.append(
            f"There is more structure beside the {len(search.found)} findings, which are as many as were asked for; "
            "ask for more with `max_findings`."
        )
    return replace(diagnosis, warnings=(*diagnosis.warnings, *more))


def _held(
    before: Evidence,
    after: Evidence,
    blocks: HeldOutBlocks,
    inliers: Bool[Tensor, "N m"],
    term: Term,
    prepared: PreparedSimulation,
    generator: torch.Generator,
) -> tuple[HeldOut | None, str]:
    """The held-out evidence of one effect, or why there is none."""
    onset, time = term.shape.get("onset"), prepared.time
    if onset is not None:
        shorter = min(int((time < onset).sum()), int((time >= onset).sum()))
        if shorter < 2 * len(time) // (int(blocks.block.max()) + 1):
            return None, "one side of the step is shorter than two of the held-out blocks"
    difference = after.log_likelihood - before.log_likelihood
    gain, interval = gain_interval(difference, blocks.block, generator)
    return HeldOut(gain, interval, _rms(before, inliers), _rms(after, inliers), prepared.unit), ""


def _rms(evidence: Evidence, inliers: Bool[Tensor, "N m"]) -> float:
    return float(evidence.residual[inliers].square().mean().sqrt())


def _spread(evidence: Evidence, inliers: Bool[Tensor, "N m"]) -> Spread:
    return Spread(
        float(evidence.log_likelihood.mean()),
        _rms(evidence, inliers),
        tuple(evidence.sigma.tolist()),
        tuple(evidence.d.tolist()),
    )


def _candidates(first: Located | None) -> tuple[Candidate, ...]:
    if first is None:
        return ()
    return tuple(
        Candidate(
            first.terms[r.number].effect.id,
            first.terms[r.number].columns,
            described(first.terms[r.number].effect, first.terms[r.number].shape),
            r.gain,
            math.sqrt(2.0 * max(r.gain, 0.0)),
            first.terms[r.number].at,
            r.gap,
        )
        for r in first.ranking
    )


def _nothing_to_separate() -> Separability:
    return Separability((), torch.zeros(0, 0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))


def _not_confirmed(located: Located) -> str:
    shape = described(located.term.effect, located.term.shape)
    what = f"{_called(located.term)} ({shape})" if shape else _called(located.term)
    return (
        f"{what}: p = {located.p_value:.2g} after the whole search, but it does not predict blocks better that the fit "
        "has not seen, so it does not count as a finding."
    )


def _in_one_stretch(located: Located | None, time: Float[Tensor, " N"]) -> tuple[str, ...]:
    if located is None or located.stretch is None:
        return ()
    begin, end = (float(time[n]) for n in (located.stretch[0], located.stretch[1] - 1))
    return (
        f"From {begin:.1f} to {end:.1f} s the recording is off as {_called(located.term)} would have it, but hardly "
        "elsewhere. Other stretches are off too and no effect explains them, so this one counts as another burst of "
        "outliers. Record again, for longer.",
    )


def _called(term: Term) -> str:
    if term.effect.unrecorded:
        return "a cause that no column recorded"
    along = "a curve along" if term.effect.is_curve else f"{term.effect.id} by"
    if term.columns:
        return f"{along} {', '.join(term.columns)}"
    return "a curve without a name" if term.effect.is_curve else term.effect.id


def _time_warnings(prepared: PreparedSimulation) -> tuple[str, ...]:
    if prepared.recording.time is not None:
        return ()
    return (
        "The recording has no column `time`: sample numbers stand in for seconds, and samples count as evenly spaced.",
    )


def _traces(prepared: PreparedSimulation, drivers: Drivers, base: FittedModel, final: Estimate) -> Traces:
    shown = {
        name: driver.values[:, k] + driver.reference[k]
        for driver in drivers.drivers
        for k, name in enumerate(driver.columns)
    }
    units = {name: unit for driver in drivers.drivers for name, unit in zip(driver.columns, driver.units, strict=True)}
    return Traces(
        time=prepared.time,
        has_time=prepared.recording.time is not None,
        before=base.residual,
        after=final.fit.residual,
        weight=final.fit.weights,
        channels=prepared.channels,
        unit=prepared.unit,
        drivers=shown,
        driver_units=units,
    )
