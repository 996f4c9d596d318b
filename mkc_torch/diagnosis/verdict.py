"""The verdict by four questions: does it follow, is the rest noise, is it physics with a name, what is it if not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mkc_torch.diagnosis.findings.pushes import forcing_of, pushes_of
from mkc_torch.diagnosis.findings.reasons import reasons_of, wrong_turns
from mkc_torch.diagnosis.follows import follows_of, misses, pooled
from mkc_torch.diagnosis.model.fit import FittedModel
from mkc_torch.diagnosis.model.in_the_world import InTheWorld, freed, noise_around
from mkc_torch.diagnosis.result import Finding
from mkc_torch.diagnosis.settings import EvidenceSettings, NoiseSettings
from mkc_torch.diagnosis.world import Follows, Verdict, World
from mkc_torch.simulation.dynamics.noise import NoiseOfTheWorld
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

__all__ = ["Around", "alone", "around", "lost_from_the_start", "verdict_of", "world_of"]


@dataclass(frozen=True)
class Around:
    """What stands around a simulation's fits: how it follows alone and corrected, and the noise that is left.

    ``lost`` says that no finding can make it follow: its recorded turns are wrong.
    """

    follows: tuple[Follows, ...]
    corrected: tuple[Follows, ...]
    noise: NoiseOfTheWorld | None
    lost: bool = False

    def unfit(self, settings: EvidenceSettings) -> bool:
        """Whether neither the simulation nor it with its findings explains what the recording varies by."""
        if self.lost:
            return True
        if not misses(self.follows, settings.followed):
            return False
        shares = [pooled(one) for one in (self.follows, self.corrected) if one]
        return not shares or max(shares) < settings.useful


def alone(base: InTheWorld, declared: Mapping[str, float]) -> tuple[Follows, ...]:
    """How the simulation alone follows each output."""
    free = base.free
    prepared = base.fit.model.prepared if free is None else free.model.prepared
    floor = None if base.noise is None else base.noise.disturbed.sensor.tolist()
    return follows_of(prepared, None if free is None else free.residual, declared, floor)


def lost_from_the_start(base: InTheWorld) -> bool:
    """Whether nothing is to be searched: its recorded turns are what they cannot be."""
    return bool(wrong_turns(base.fit.model.prepared))


def around(base: InTheWorld, final: FittedModel, declared: Mapping[str, float], noise: NoiseSettings) -> Around:
    """What stands around the simulation alone and with what was found.

    Args:
        base: alone.
        final: with all findings, under the pushes that are left.
        declared: standard deviation of the white noise of outputs that it is known of.
        noise: settings.
    """
    follows = alone(base, declared)
    left = base.noise if not final.model.terms else noise_around(final, declared, noise)
    corrected: tuple[Follows, ...] = ()
    if final.model.terms:
        free = freed(final)
        floor = [one.noise_floor for one in follows]
        corrected = () if free is None else follows_of(free.model.prepared, free.residual, declared, floor)
    return Around(follows, corrected, left, bool(wrong_turns(final.model.prepared)))


def world_of(base: InTheWorld, final: FittedModel, known: Around, *, unfit: bool) -> World:
    """What is told of the world around."""
    prepared = final.model.prepared
    reasons: tuple[str, ...] = ()
    if unfit:
        fits = [base.fit] if base.free is None else [base.fit, base.free]
        reasons = reasons_of(fits, known.follows)
    if not isinstance(prepared, PreparedDynamics) or known.noise is None:
        return World(known.follows, reasons, starts=base.starts)
    return World(
        known.follows,
        reasons,
        pushes_of(prepared, known.noise),
        dict(prepared.between),
        () if unfit else forcing_of(final, known.noise),
        base.starts,
    )


def verdict_of(
    known: Around,
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
        follows = not misses(known.follows, settings.followed)
        return "adequate" if clean and follows else "unexplained"
    named = all(one.grade in ("left out", "real but small") for one in findings)
    return "explained" if named and clean else "unexplained"
