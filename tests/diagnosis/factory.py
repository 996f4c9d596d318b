"""Diagnoses made by hand, with residuals that match their findings."""

import dataclasses
import math

import torch

from mkc_torch.diagnosis import vetoes
from mkc_torch.diagnosis.decisions import Trail
from mkc_torch.diagnosis.environment import (
    Curve,
    DisturbanceEstimate,
    GoodnessOfFit,
    NoiseEnvironment,
    ProcessNoise,
    ShapeCheck,
)
from mkc_torch.diagnosis.evidence import prediction, remaining
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.parts import Courses
from mkc_torch.diagnosis.result import (
    Alternative,
    CandidateScore,
    Diagnosis,
    EffectParameter,
    Finding,
    HeldOut,
    HeldOutScore,
    NoiseSummary,
    Reference,
    Separability,
    SmoothCorrection,
    Traces,
)
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.verdict import FitAssessment, Remainder, decisions_on_all, verdict_of

CHANNELS = ("norm", "turn_x", "turn_y", "turn_z")
CATALOGUE = (
    "hard_iron_step", "current_field", "temperature_offset", "offset_drift", "field_gradient", "cubic_nonlinearity",
    "driver_offset", "driver_gain", "mains_interference", "time_lag", "hysteresis", "eddy_current",
)  # fmt: skip


def make_diagnosis(findings=1, *, channels=1, samples=4500, has_time=True, candidates=12, **changes):
    """Return a diagnosis of a simulated magnetometer; fields can be replaced by name, and advice follows from the rest.

    So can the smooth correction: what it reaches is the ``ceiling``, None for none, along columns that are
    ``remaining``.
    """
    found = (_step, _current, _unknown)[:findings]
    names = CHANNELS[:channels]
    traces = make_traces(findings, names, samples, has_time)
    used = traces.weight > 0.5
    before, after = (float(e[used].square().mean().sqrt()) for e in (traces.before, traces.after))
    content = {
        "recording": "flight_07",
        "simulation": "magnetometer",
        "samples": samples,
        "level": 0.05,
        "noise": NoiseSummary(
            "ar",
            {"coefficients": (0.42, -0.08)},
            (2.1,) * channels,
            (0.31,) * channels,
            (12.0,) * channels,
            "noise with a memory of 2 samples and 11 % outliers",
        ),
        "candidates_tried": 64,
        "surrogates": 199,
        "seed": 0,
        "p_value": 0.005 if findings else 0.37,
        "findings": tuple(graded(f(names, has_time)) for f in found),
        "baseline": HeldOutScore(-1.2345, before, (1.1,) * channels, (0.52,) * channels),
        "corrected": HeldOutScore(-0.9012, after, (math.inf,) * channels, (0.31,) * channels),
        "advice": (),
        "warnings": ("3 samples without a finite value were left out.",),
        "candidates": make_candidates(candidates),
        "separability": make_separability(min(candidates, 8)),
        "traces": traces,
    }
    content["verdict"] = "explained" if findings else _verdict_without_findings(**changes)
    ceiling = changes.pop("ceiling", HeldOutScore(-0.8951, 0.97 * after, (1.4,) * channels, (0.3,) * channels))
    smooth = SmoothCorrection(ceiling, changes.pop("remaining", ()))
    content["evidence"] = () if ceiling is None else (remaining.as_result(smooth),)
    diagnosis = Diagnosis(**content | changes)
    return diagnosis if "advice" in changes else dataclasses.replace(diagnosis, advice=advice_of(diagnosis))


def _verdict_without_findings(p_value=1.0, remaining=(), environment=None, **_):
    """Return the verdict of a diagnosis with these fields."""
    fits = () if environment is None else environment.goodness_of_fit
    structure = ("A trend remains.",) if remaining or (p_value is not None and p_value <= 0.05) else ()
    known, limits = FitAssessment(fits, (), None), EvidenceSettings()
    decisions = decisions_on_all(known, Remainder(structure), limits, findings=False, flexible=False)
    return verdict_of(Trail(decisions=decisions))


def graded(finding, grade=None):
    """Return a finding with the grade of its evidence, or another grade."""
    return dataclasses.replace(finding, grade=grade or vetoes.grade(vetoes.decisions_on(finding)))


def with_evidence(thing, *results):
    """Return a finding, graded, or a diagnosis with these results of tests; the other results stay."""
    new = {result.test for result in results}
    kept = (result for result in thing.evidence if result.test not in new)
    changed = dataclasses.replace(thing, evidence=(*kept, *results))
    return graded(changed) if isinstance(changed, Finding) else changed


def make_goodness_of_fit(output="angle", unit="rad", residual=0.0049, variation=0.35, floor=0.005, **changes):
    """Return the goodness of fit of an output."""
    made = GoodnessOfFit(
        output, unit, residual, variation, 1.0 - (residual / variation) ** 2, floor, "declared", variation, 0.021
    )
    return dataclasses.replace(made, **changes)


POOR_FITS = (make_goodness_of_fit(residual=0.36, explained=0.12), make_goodness_of_fit("rate", "rad/s", 1.9, 1.4, 0.02))
"""Two outputs with a poor fit."""

PROCESS_NOISE = ProcessNoise(
    "rate",
    at_rate=True,
    correlation_time=0.7,
    size=0.2284,
    standard_error=0.021,
    unit="rad/s²",
    log_likelihood_gain=311.0,
)


def make_disturbance(samples=1800, noise=PROCESS_NOISE):
    """Return the estimated disturbance of a pendulum's rate."""
    time = torch.arange(samples, dtype=torch.float64) / 20.0
    value = noise.size * (torch.sin(1.1 * time) + 0.6 * torch.sin(3.7 * time + 1.0))
    x = torch.linspace(-1.0, 1.0, 40, dtype=torch.float64)
    curves = tuple(
        Curve(name, unit, x, (slope * x).unsqueeze(-1), torch.full((40, 1), 0.05), (noise.place,), noise.unit)
        for name, unit, slope in (("angle", "rad", 0.01), ("rate", "rad/s", -0.2), ("torque", "N m", 0.03))
    )
    sentences = (
        "It is not white: it is correlated up to 0.7 s.",
        "It goes along with none of the inputs, at no lag.",
    )
    band = torch.full_like(value, 0.09)
    return DisturbanceEstimate(noise.place, noise.at_rate, noise.unit, time, value, band, curves, sentences)


def make_environment(**changes):
    """Return the environment of a pendulum with a good fit, a disturbed rate, and a held torque."""
    environment = NoiseEnvironment(
        goodness_of_fit=(make_goodness_of_fit(),),
        process_noise=(PROCESS_NOISE,),
        input_hold={"torque": "held"},
        disturbance=(make_disturbance(),),
        starts=12,
    )
    return dataclasses.replace(environment, **changes)


def make_unfit(**changes):
    """Return the diagnosis of a pendulum with a poor fit."""
    reasons = (
        "Another start reaches 0.006 rad: `gravity` = −9.81 with the other sign.",
        "`damping` ends at its bound, 0.",
    )
    environment = NoiseEnvironment(goodness_of_fit=POOR_FITS, reasons=reasons, starts=12)
    return make_diagnosis(
        0, **{"simulation": "Pendulum", "samples": 400, "verdict": "unfit", "environment": environment} | changes
    )


def with_another_shape(finding, gain=163.0, formula="0.0071 |x|^1.52 sign(x)", curve=None):
    """Return a finding of another shape than the recording's."""
    shape = ShapeCheck(gain, 0.002, curve or finding.curve, formula)
    return dataclasses.replace(finding, grade="nearest", shape=shape)


def make_traces(findings, channels, samples, has_time):
    generator = torch.Generator().manual_seed(1)
    n, m = samples, len(channels)
    time = torch.arange(n, dtype=torch.float64) / (50.0 if has_time else 1.0)
    share = torch.arange(n) / max(n, 1)
    noise = 0.4 * torch.randn(n, m, generator=generator, dtype=torch.float64)
    outlier = torch.rand(n, m, generator=generator) < 0.12
    noise[outlier] += 8.0 * torch.randn(int(outlier.sum()), generator=generator, dtype=torch.float64)
    current = 15.0 + 9.0 * torch.sin(share * 40.0) + torch.randn(n, generator=generator)
    temperature = 24.0 + 11.0 * (1.0 - torch.exp(-3.0 * share)) + 0.05 * torch.randn(n, generator=generator)
    effect = torch.zeros(n, m, dtype=torch.float64)
    turning = torch.cos(share.unsqueeze(-1) * 120.0 + torch.arange(m))
    if findings > 0:
        effect += 1.2 * turning * (share > 0.45).unsqueeze(-1)
    if findings > 1:
        effect += 0.06 * (current - 15.0).unsqueeze(-1)
    if findings > 2:
        effect += 0.02 * (temperature - 30.0).square().unsqueeze(-1)
    drivers = {"current": current.double(), "temperature": temperature.double()}
    return Traces(
        time=time,
        has_time=has_time,
        before=noise + effect,
        after=noise,
        weight=torch.where(outlier, 0.05, 0.95).double(),
        channels=channels,
        unit="µT",
        drivers=drivers,
        driver_units={"current": "A", "temperature": "°C"},
    )


def with_courses(diagnosis, *, runs=1, held_out=True, one_step=False):
    """Return the diagnosis with a recording of its channels, from which its residuals are."""
    t = diagnosis.traces
    share = torch.arange(len(t.time), dtype=torch.float64).unsqueeze(-1) / max(len(t.time), 1)
    recorded = 20.0 * torch.sin(25.0 * share + torch.arange(len(t.channels))) + 5.0
    run = (share.squeeze(-1) * runs).long()
    fold = (share.squeeze(-1) * 25).long() % 5 == 2
    courses = Courses(recorded, recorded - t.before, recorded - t.after, fold & held_out, run, one_step)
    return dataclasses.replace(diagnosis, traces=dataclasses.replace(t, courses=courses))


def make_candidates(count):
    gains = [900.0 * 0.6**i for i in range(count)]
    return tuple(
        CandidateScore(
            CATALOGUE[i % len(CATALOGUE)] if i < len(CATALOGUE) else "driver_offset",
            () if i == 0 else ("current",) if i < len(CATALOGUE) else (f"column_{i}",),
            "step at 41.3 s" if i == 0 else "",
            gain,
            math.sqrt(2.0 * gain),
        )
        for i, gain in enumerate(gains)
    )


def make_separability(count):
    generator = torch.Generator().manual_seed(2)
    share = torch.rand(count, count, generator=generator, dtype=torch.float64)
    share = 0.5 * (share + share.mT)
    share.fill_diagonal_(0.0)
    labels = tuple(CATALOGUE[i % len(CATALOGUE)] for i in range(count))
    return Separability(labels, share, torch.linspace(0.99, 0.23, count, dtype=torch.float64))


def _step(channels, has_time):
    return Finding(
        effect="hard_iron_step",
        drivers=(),
        channels=("mag_x", "mag_y", "mag_z"),
        intervals=(),
        onset=41.32 if has_time else 2025.0,
        equation="B = A (m − b − Δb·1[t > t₀])",
        explanation="The sensor's offset changes at one moment, as when a magnetised part comes near and stays.",
        parameters=(
            EffectParameter("offset change", (3.2137, -1.1042, 0.3251), (0.0812, 0.0774, 0.0921), "µT"),
            EffectParameter("onset", 41.32, 0.14, "s"),
        ),
        p_value=0.005,
        evidence=(prediction.held_out_gain_result(HeldOut(0.3124, (0.2811, 0.3502), 0.912, 0.521, "µT"), ""),),
        alternatives=(
            Alternative("offset_drift", (), 41.2, True),
            Alternative("current_field", ("current",), 1.3, False),
        ),
        plausible=True,
        plausibility="3.4 µT; steps of 1 to 50 µT occur.",
        curve=_curve("time", "s" if has_time else "", channels, lambda x: (x > 0.45).double()),
        advice="Look for what changed at that time; use the calibration from after the step.",
        recurrence="a step does not come at the same moment again",
    )


def _current(channels, has_time):
    return Finding(
        effect="current_field",
        drivers=("current",),
        channels=("mag_x", "mag_y", "mag_z"),
        intervals=((12.1, 18.4), (60.0, 71.5)) if has_time else ((600.0, 900.0),),
        onset=None,
        equation="δB = k (I − Ī)",
        explanation="A current near the sensor adds a field in proportion to it.",
        parameters=(
            EffectParameter("k", (-0.1702, 0.3311, 0.0298), (0.0123, 0.0119, 0.0131), "µT/A"),
            EffectParameter("α", 4.02e-6, 1.1e-7, "1/µT²"),
        ),
        p_value=0.01,
        evidence=(prediction.held_out_gain_result(None, "The event has no second occurrence to be held out."),),
        alternatives=(),
        plausible=True,
        plausibility="0.37 µT/A; up to 1 µT/A occurs.",
        curve=_curve("current", "A", channels, lambda x: x - 0.5),
        references=(Reference("current", 15.0, "A"),),
        advice="Move the sensor away from the power wires.",
    )


def _unknown(channels, _has_time):
    return Finding(
        effect="unknown",
        drivers=("temperature",),
        channels=channels,
        intervals=(),
        onset=None,
        equation="residual = f(temperature)",
        explanation="The residual depends on this column in a way that no effect in the catalogue has.",
        parameters=(EffectParameter("knots", tuple(0.1 * i for i in range(20)), None, "µT"),),
        p_value=0.045,
        evidence=(
            prediction.held_out_gain_result(
                HeldOut(0.0021, (-0.0004, 0.0046), 0.5214, 0.5198, "µT"), "Blocks of 4 s with gaps of 1 s."
            ),
        ),
        alternatives=(Alternative("temperature_offset", ("temperature",), 7.9, True),),
        plausible=False,
        plausibility="A curve has no size to compare.",
        curve=_curve("temperature", "°C", channels, lambda x: (2.0 * x - 1.0).square()),
    )


def _curve(driver, unit, channels, shape):
    x = torch.linspace(0.0, 1.0, 60, dtype=torch.float64)
    value = shape(x).unsqueeze(-1) * (0.6 + 0.4 * torch.arange(len(channels)))
    low, high = {"time": (0.0, 90.0), "current": (5.0, 25.0), "temperature": (24.0, 35.0)}[driver]
    return Curve(driver, unit, low + (high - low) * x, value, torch.full_like(value, 0.12), channels, "µT")
