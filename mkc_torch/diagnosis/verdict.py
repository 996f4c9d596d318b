"""The verdict from four questions: is the fit good, is the residual noise, do the findings have names, what remains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment, Verdict
from mkc_torch.diagnosis.findings.disturbances import forcing_of, process_noise_of
from mkc_torch.diagnosis.findings.reasons import reasons_of
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, pooled, poor_fits
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, estimate_noise, refit_open_loop
from mkc_torch.diagnosis.result import Finding
from mkc_torch.diagnosis.settings import EvidenceSettings, NoiseSettings
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise, sized_noise

__all__ = ["FitAssessment", "assess", "assess_baseline", "impossible_rotations", "noise_environment", "verdict_of"]


@dataclass(frozen=True)
class FitAssessment:
    """Goodness of fit without and with the findings, and the remaining noise.

    Attributes:
        follows: goodness of fit of the simulation without findings, by output.
        corrected: goodness of fit with the findings, by output.
        noise: the remaining noise of differential equations; None for other simulations.
        lost: True if no finding can make the fit good: the recorded rotations are wrong.
    """

    follows: tuple[GoodnessOfFit, ...]
    corrected: tuple[GoodnessOfFit, ...]
    noise: StateSpaceNoise | None
    lost: bool = False

    def unfit(self, settings: EvidenceSettings) -> bool:
        """Whether the simulation explains too little of the variation, both without and with its findings."""
        if self.lost:
            return True
        if not poor_fits(self.follows, settings.followed):
            return False
        shares = [pooled(fits) for fits in (self.follows, self.corrected) if fits]
        return not shares or max(shares) < settings.useful


def assess_baseline(base: ProcessNoiseFit, declared: Mapping[str, float]) -> tuple[GoodnessOfFit, ...]:
    """Return the goodness of fit of the simulation without findings, by output."""
    free = base.free
    prepared = base.fit.model.prepared if free is None else free.model.prepared
    floor = None if base.noise is None else base.noise.selected.sensor.tolist()
    return goodness_of_fit(prepared, None if free is None else free.residual, declared, floor)


def impossible_rotations(base: ProcessNoiseFit) -> bool:
    """Whether a search is pointless: the recorded rotations are impossible."""
    return bool(base.fit.model.prepared.faults)


def assess(
    base: ProcessNoiseFit, final: FittedModel, declared: Mapping[str, float], noise: NoiseSettings
) -> FitAssessment:
    """Assess the simulation without and with the findings.

    Args:
        base: the fit without findings.
        final: the fit with all findings, under the remaining process noise.
        declared: known standard deviations of the outputs' white noise.
        noise: settings.
    """
    follows = assess_baseline(base, declared)
    left = base.noise if not final.model.terms else estimate_noise(final, declared, noise)
    corrected: tuple[GoodnessOfFit, ...] = ()
    if final.model.terms:
        free = refit_open_loop(final)
        floor = [fit.noise_floor for fit in follows]
        corrected = () if free is None else goodness_of_fit(free.model.prepared, free.residual, declared, floor)
    return FitAssessment(follows, corrected, left, bool(final.model.prepared.faults))


def noise_environment(
    base: ProcessNoiseFit, final: FittedModel, known: FitAssessment, *, unfit: bool
) -> NoiseEnvironment:
    """Return the goodness of fit and the noise for the report."""
    prepared = final.model.prepared.dynamics
    reasons: tuple[str, ...] = ()
    if unfit:
        fits = [base.fit] if base.free is None else [base.fit, base.free]
        reasons = reasons_of(fits, known.follows)
    if prepared is None or known.noise is None:
        return NoiseEnvironment(known.follows, reasons, starts=base.starts)
    model, theta = final.model, final.parameters
    noise = sized_noise(prepared, theta[: model.base], model.changes(theta), model.near, known.noise)
    return NoiseEnvironment(
        known.follows,
        reasons,
        process_noise_of(prepared, noise),
        dict(prepared.input_hold),
        () if unfit else forcing_of(final, noise),
        base.starts,
    )


def verdict_of(
    known: FitAssessment,
    findings: Sequence[Finding],
    *,
    structure: bool,
    white: bool,
    settings: EvidenceSettings,
) -> Verdict:
    """Return the verdict.

    Args:
        known: the assessed fits.
        findings: with their grades.
        structure: whether there is structure beyond the findings: a significant candidate, or a smooth remainder.
        white: whether the residual is white.
        settings: thresholds.
    """
    if known.unfit(settings):
        return "unfit"
    disturbances = () if known.noise is None else known.noise.selected.disturbances
    # with a finding, a sensor's own slow error counts as noise
    disturbed_state = any(disturbance.at_rate or not findings for disturbance in disturbances)
    above = [
        fit
        for fit in (known.corrected if findings else known.follows)
        if fit.floor_source == "declared" and fit.residual > settings.above_floor * fit.noise_floor
    ]
    clean = white and not disturbed_state and not structure and not above
    if not findings:
        follows = not poor_fits(known.follows, settings.followed)
        return "adequate" if clean and follows else "unexplained"
    named = all(finding.grade in ("left_out", "small") for finding in findings)
    return "explained" if named and clean else "unexplained"
