"""Reports contain no contradictory statements; ``exclusive`` lists the contradictory pairs and rules."""

import dataclasses
import functools
import re
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")
pytest.importorskip("rich")

from mkc_torch import diagnose
from mkc_torch.diagnosis.decisions import Trail
from mkc_torch.diagnosis.environment import NoiseEnvironment, ShapeCheck
from mkc_torch.diagnosis.evidence import prediction
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.result import Alternative, Diagnosis, DivergedBlock, EffectParameter, HeldOut, ResidualSizes
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.verdict import FitAssessment, Remainder, decisions_on_all, reservations_of, verdict_of
from mkc_torch.diagnosis.vetoes import VetoContext, decisions_on, grade, is_dropped
from mkc_torch.recording import demonstration
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.factory import PROCESS_NOISE, make_diagnosis, make_goodness_of_fit
from tests.diagnosis.swing import Pendulum, UpsideDown, pendulum_recording
from tests.report.exclusive import PAIRS, Pair, _in_text, contradictions, page_rows, terminal_rows

END = 3.98  # s, of the factory's 200 samples
LEVEL = 0.05
DIVERGED = (DivergedBlock(3, before=True, after=False),)

sizes = st.sampled_from((1e-3, 0.3, 0.57, 0.9996, 1.0, 1.004, 1.04, 1.3))
"""Ratios of the residual after to the residual before."""


@st.composite
def held_outs(draw, unit="rad"):
    gain = draw(st.floats(-0.5, 0.5))
    low, high = (draw(st.floats(0.001, 0.6)) for _ in range(2))
    before, ratio = draw(st.floats(0.01, 10.0)), draw(sizes)
    outputs = {"angle": ResidualSizes(before, ratio * before, unit)}
    if draw(st.booleans()):
        outputs["rate"] = ResidualSizes(2.0 * before, 2.0 * draw(sizes) * before, "rad/s")
    return HeldOut(
        gain, (gain - low, gain + high), before, ratio * before, unit,
        outputs if draw(st.booleans()) else {}, draw(st.sampled_from(((), DIVERGED))), 25, decides=draw(st.booleans()),
    )  # fmt: skip


@st.composite
def findings(draw, place):
    (template,) = make_diagnosis(1, samples=20).findings
    begin = draw(st.floats(0.0, END))
    held = draw(st.none() | held_outs())
    value = draw(st.floats(0.01, 5.0))
    spans = ((begin, min(begin + 0.5, END)),) if draw(st.booleans()) else ()
    finding = dataclasses.replace(
        template,
        effect=draw(st.sampled_from(("linear_drag", "coulomb_friction", "constant_force"))),
        channels=(place,),
        intervals=spans,
        onset=draw(st.none() | st.just(begin)),
        parameters=(
            EffectParameter("size", value, draw(st.none() | st.just(draw(st.floats(0.1, 2.0)) * value)), "m/s²"),
        ),
        p_value=draw(st.floats(0.001, LEVEL)),
        alternatives=tuple(
            Alternative("backlash", (), 3.0, draw(st.booleans())) for _ in range(draw(st.integers(0, 1)))
        ),
        plausible=draw(st.booleans()),
        plausibility="such sizes occur",
        evidence=(prediction.held_out_gain_result(held, "" if held else "One side of it is too short."),),
    )
    shape = draw(st.none() | st.just(ShapeCheck(40.0, 0.002, finding.curve, "x^1.5")) | st.just(ShapeCheck(0.5, 0.4)))
    finding = dataclasses.replace(finding, shape=shape)
    return dataclasses.replace(finding, grade=grade(decisions_on(finding)))


@dataclasses.dataclass
class Case:
    """A diagnosis with a short repr for failing tests."""

    diagnosis: Diagnosis

    def __repr__(self):
        d = self.diagnosis
        found = [(f.effect, f.grade, f.held_out) for f in d.findings]
        return f"{d.verdict}: {found}, {d.environment.process_noise}, {d.remaining}"


@st.composite
def diagnoses(draw):
    """A diagnosis built as `mkc_torch.diagnosis.pipeline.build` does it, with its grades, verdict and advice."""
    found = [draw(findings(place)) for place in ("rate of rate", "rate of angle", "torque")[: draw(st.integers(0, 3))]]
    found = [item for item in found if not is_dropped(decisions_on(item))]
    white = draw(st.booleans())
    process_noise = () if draw(st.booleans()) else (dataclasses.replace(PROCESS_NOISE, at_rate=draw(st.booleans())),)
    noise = 0.005 * draw(st.floats(0.9, 1.2) if white and not process_noise else st.floats(1.0, 20.0))
    lost = draw(st.booleans()) and draw(st.booleans())
    source = draw(st.sampled_from(("samples", "declared")))
    fit = (
        make_goodness_of_fit(residual=0.36, explained=0.12)
        if lost
        else make_goodness_of_fit(residual=noise, floor_source=source)
    )
    known = FitAssessment((fit,), (), SimpleNamespace(selected=SimpleNamespace(disturbances=process_noise)), lost=lost)
    if lost:
        found = []
    p_value = found[0].p_value if found else draw(st.floats(0.001, 1.0))
    remaining = ("torque",) if draw(st.booleans()) and not lost else ()
    structure = ("A candidate is significant.",) if (p_value <= LEVEL and not found) or remaining else ()
    left = Remainder(structure, 0.0 if white else 3.0)
    flexible = bool(found) and draw(st.booleans())
    corrected = dataclasses.replace(fit, explained=draw(st.sampled_from((0.6, 0.99))))
    if flexible and not lost:
        known = dataclasses.replace(known, follows=(dataclasses.replace(fit, explained=0.4),), corrected=(corrected,))
    of_findings = [
        one for number, item in enumerate(found, start=1) for one in decisions_on(item, VetoContext(number=number))
    ]
    decisions = (
        *of_findings,
        *decisions_on_all(known, left, EvidenceSettings(), findings=bool(found), flexible=flexible),
    )
    verdict = verdict_of(Trail(decisions=decisions))
    reasons = ("Another start reaches 0.006 rad.",) if verdict == "unfit" else ()
    environment = NoiseEnvironment((fit,), reasons, process_noise, {"torque": "held"})
    made = make_diagnosis(
        0, samples=200, simulation="Pendulum", p_value=p_value, verdict=verdict, environment=environment,
        remaining=remaining, warnings=(),
    )  # fmt: skip
    made = dataclasses.replace(made, findings=tuple(found))
    held = [f.held_out for f in found if f.held_out is not None]
    if held:
        made = dataclasses.replace(
            made,
            baseline=dataclasses.replace(made.baseline, rmse=held[0].rmse_before),
            corrected=dataclasses.replace(made.corrected, rmse=held[-1].rmse_after),
        )
    made = dataclasses.replace(made, decisions=Trail(decisions=(*decisions, *reservations_of(made))))
    return Case(dataclasses.replace(made, advice=advice_of(made)))


@settings(max_examples=250, deadline=None)
@given(case=diagnoses())
def test_no_summary_of_any_diagnosis_contradicts_itself(case):
    assert contradictions(case.diagnosis, page=False) == []


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(case=diagnoses())
def test_no_page_of_any_diagnosis_contradicts_itself(case):
    assert contradictions(case.diagnosis) == []


RECORDINGS = {
    "nothing hidden": lambda: diagnose(Pendulum(), pendulum_recording("none", N=300)[0], surrogates=39),
    "drag hidden": lambda: diagnose(Pendulum(), pendulum_recording("none", N=300, drag=0.3)[0], surrogates=39),
    "slow process noise": lambda: diagnose(Pendulum(), pendulum_recording("slow", N=300)[0], surrogates=39),
    "gravity of the wrong sign": lambda: diagnose(UpsideDown(), pendulum_recording("none", N=300)[0], surrogates=39),
    "loudspeaker": lambda: diagnose(Magnetometer(), demonstration.simulated_recording()[0], surrogates=39),
}


@functools.cache
def diagnosis_of(name):
    return RECORDINGS[name]()


@pytest.mark.e2e
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name == "slow process noise" or "wrong sign" in name else name
        for name in RECORDINGS
    ],
)
def test_no_report_of_a_recording_contradicts_itself(name):
    assert contradictions(diagnosis_of(name)) == []


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: f"{pair.first[:30]}, {pair.second[:30]}")
def test_patterns_of_a_pair_compile_and_do_not_match_empty_text(pair):
    assert re.compile(pair.first).pattern
    assert not re.search(pair.first, "")
    assert not re.search(pair.second, "")
    assert re.compile(pair.unless)


CORRUPTED = {
    "adequate with a finding": {"verdict": "adequate"},
    "unfit with a finding": {"verdict": "unfit"},
    "not confirmed": {"grade": "unconfirmed"},
    "outside of the recording": {"onset": 99.0},
    "a claim above the level": {"p_value": 0.3},
    "a claim whose size is 0": {"parameters": (EffectParameter("size", 0.1, 0.4, "µT"),)},
    "an interval that ends before": {"intervals": ((2.0, 1.0),)},
    "left out, and of another shape": {
        "shape": ShapeCheck(40.0, 0.002, make_diagnosis(1, samples=20).findings[0].curve)
    },
    "to be corrected and not to be": {
        "advice": (
            "The model found here corrects for linear_drag: confirm it on a second recording.",
            "Do not correct for linear_drag yet: blocks that the fit has not seen do not confirm it.",
        )
    },
    "The simulation can be used": {"advice": ("The simulation can be used within the range of this recording.",)},
}


@pytest.mark.parametrize("name", CORRUPTED)
def test_contradictions_of_a_corrupted_diagnosis_are_detected(name):
    made = make_diagnosis(1, samples=200)
    (finding,) = made.findings
    held = finding.held_out
    made = dataclasses.replace(
        made,
        findings=(dataclasses.replace(finding, onset=1.0),),
        baseline=dataclasses.replace(made.baseline, rmse=held.rmse_before),
    )
    assert contradictions(made, page=False) == []
    of_finding = {k: v for k, v in CORRUPTED[name].items() if hasattr(finding, k) and k != "advice"}
    of_all = {k: v for k, v in CORRUPTED[name].items() if k not in of_finding}
    corrupted = dataclasses.replace(made, findings=(dataclasses.replace(made.findings[0], **of_finding),), **of_all)
    assert any(name in result for result in contradictions(corrupted, page=False)), contradictions(
        corrupted, page=False
    )


@pytest.mark.parametrize(
    "row",
    [
        "held out  angle 0.300 → 0.300 rad (no change); surely better on held-out blocks",
        "held out  residual 1.00 → 0.06 m (94 % less); not shown to be better on held-out blocks",
        "where  throughout the recording, mainly from 1.0 to 2.0 s",
        "The recording shows no missing physics. linear drag: left out of the simulation",
        "The simulation does not fit the recording. The simulation can be used",
    ],
)
def test_contradictory_texts_in_a_row_are_detected(row):
    assert list(_in_text([row], make_diagnosis(1, samples=20)))


def test_texts_on_different_findings_are_not_compared():
    pair = Pair("surely better", "[Nn]ot confirmed", "finding")
    assert pair in PAIRS
    rows = ["1 · Drag", "surely better on held-out blocks", "2 · Friction", "not confirmed on held-out blocks"]
    assert not list(_in_text(rows, make_diagnosis(2, samples=20)))
    assert list(_in_text([*rows, "surely better on held-out blocks"], make_diagnosis(2, samples=20)))


def test_page_and_terminal_are_split_into_rows():
    page = "<style>p{}</style><h1>One</h1><table><tr><th>where</th><td>from<br>1&nbsp;s</td></tr></table><p>two</p>"
    assert page_rows(page) == ["One", "where from 1 s", "two"]
    rows = terminal_rows(make_diagnosis(1, samples=20))
    advice, command = [row for row in rows if row.startswith("to do")]
    assert "confirm it on a second recording" in advice
    assert command.split()[:4] == ["to", "do", "mkc", "apply"]
