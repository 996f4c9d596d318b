"""The verdict by four questions: does it follow, is the rest noise, is it physics with a name, what is it if not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mkc_torch.diagnosis.environment import GoodnessOfFit, NoiseEnvironment, Verdict
from mkc_torch.diagnosis.findings.disturbances import forcing_of, pushes_of
from mkc_torch.diagnosis.findings.reasons import reasons_of, wrong_turns
from mkc_torch.diagnosis.goodness_of_fit import goodness_of_fit, pooled, poor_fits
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.process_noise import ProcessNoiseFit, estimate_noise, refit_open_loop
from mkc_torch.diagnosis.result import Finding
from mkc_torch.diagnosis.settings import EvidenceSettings, NoiseSettings
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

__all__ = ["FitAssessment", "assess", "assess_baseline", "lost_from_the_start", "noise_environment", "verdict_of"]


@dataclass(frozen=True)
class FitAssessment:
    """What stands around a simulation's fits: how it follows alone and corrected, and the noise that is left.

    ``lost`` says that no finding can make it follow: its recorded turns are wrong.
    """

    follows: tuple[GoodnessOfFit, ...]
    corrected: tuple[GoodnessOfFit, ...]
    noise: StateSpaceNoise | None
    lost: bool = False

    def unfit(self, settings: EvidenceSettings) -> bool:
        """Whether neither the simulation nor it with its findings explains what the recording varies by."""
        if self.lost:
            return True
        if not poor_fits(self.follows, settings.followed):
            return False
        shares = [pooled(one) for one in (self.follows, self.corrected) if one]
        return not shares or max(shares) < settings.useful


def assess_baseline(base: ProcessNoiseFit, declared: Mapping[str, float]) -> tuple[GoodnessOfFit, ...]:
    """How the simulation alone follows each output."""
    free = base.free
    prepared = base.fit.model.prepared if free is None else free.model.prepared
    floor = None if base.noise is None else base.noise.disturbed.sensor.tolist()
    return goodness_of_fit(prepared, None if free is None else free.residual, declared, floor)


def lost_from_the_start(base: ProcessNoiseFit) -> bool:
    """Whether nothing is to be searched: its recorded turns are what they cannot be."""
    return bool(wrong_turns(base.fit.model.prepared))


def assess(
    base: ProcessNoiseFit, final: FittedModel, declared: Mapping[str, float], noise: NoiseSettings
) -> FitAssessment:
    """What stands around the simulation alone and with what was found.

    Args:
        base: alone.
        final: with all findings, under the pushes that are left.
        declared: standard deviation of the white noise of outputs that it is known of.
        noise: settings.
    """
    follows = assess_baseline(base, declared)
    left = base.noise if not final.model.terms else estimate_noise(final, declared, noise)
    corrected: tuple[GoodnessOfFit, ...] = ()
    if final.model.terms:
        free = refit_open_loop(final)
        floor = [one.noise_floor for one in follows]
        corrected = () if free is None else goodness_of_fit(free.model.prepared, free.residual, declared, floor)
    return FitAssessment(follows, corrected, left, bool(wrong_turns(final.model.prepared)))


def noise_environment(
    base: ProcessNoiseFit, final: FittedModel, known: FitAssessment, *, unfit: bool
) -> NoiseEnvironment:
    """What is told of the world around."""
    prepared = final.model.prepared
    reasons: tuple[str, ...] = ()
    if unfit:
        fits = [base.fit] if base.free is None else [base.fit, base.free]
        reasons = reasons_of(fits, known.follows)
    if not isinstance(prepared, PreparedDynamics) or known.noise is None:
        return NoiseEnvironment(known.follows, reasons, starts=base.starts)
    return NoiseEnvironment(
        known.follows,
        reasons,
        pushes_of(prepared, known.noise),
        dict(prepared.input_hold),
        () if unfit else forcing_of(final, known.noise),
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
    """The answer to the four questions.

    Args:
        known: what stands around the fits.
        findings: with their grades.
        structure: whether there is some beyond the findings: a candidate that noise rarely makes, or what remains.
        white: whether what is left over is white.
        settings: the numbers that decide.
    """
    if known.unfit(settings):
        return "unfit"
    disturbances = () if known.noise is None else known.noise.disturbed.disturbances
    # beside a finding a sensor's own slow error is noise, and told as that
    pushed = any(one.at_rate or not findings for one in disturbances)
    above = [
        one
        for one in (known.corrected if findings else known.follows)
        if one.floor_source == "declared" and one.residual > settings.above_floor * one.noise_floor
    ]
    clean = white and not pushed and not structure and not above
    if not findings:
        follows = not poor_fits(known.follows, settings.followed)
        return "adequate" if clean and follows else "unexplained"
    named = all(one.grade in ("left out", "real but small") for one in findings)
    return "explained" if named and clean else "unexplained"
