"""Advice on a diagnosis."""

import dataclasses

import pytest

from mkc_torch.diagnosis.evidence import timing
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.result import Alternative
from mkc_torch.effects.sensor.hard_iron_step import HardIronStep
from mkc_torch.effects.sensor.offset_drift import OffsetDrift
from mkc_torch.report.diagnosis.findings import finding_name
from tests.diagnosis.factory import (
    POOR_FITS,
    PROCESS_NOISE,
    make_diagnosis,
    make_environment,
    make_unfit,
    with_another_shape,
    with_evidence,
)


def advice_for(findings=1, *, alternatives=(), **changes):
    """Return the advice on a diagnosis whose first finding has these rivals."""
    made = make_diagnosis(findings, samples=50, **changes)
    first, *rest = made.findings
    first = dataclasses.replace(first, alternatives=alternatives)
    return advice_of(dataclasses.replace(made, findings=(first, *rest)))


def test_advice_names_the_correction_of_each_effect():
    step, model = advice_for(1)
    assert "use the calibration from after the step" in step
    assert model.startswith("The model found here corrects for hard_iron_step")
    several = advice_for(2)
    assert several[0] == f"hard_iron_step: {step[0].lower()}{step[1:]}"
    assert several[1].startswith("current_field: move the sensor away")


def test_advice_on_a_curve_without_a_column_names_its_variable():
    made = make_diagnosis(1, samples=50)
    curve = dataclasses.replace(made.findings[0].curve, driver="height")
    unknown = dataclasses.replace(
        made.findings[0], effect="unknown", drivers=(), curve=curve, channels=("rate of climb",), alternatives=()
    )
    *_, model = advice_of(dataclasses.replace(made, findings=(unknown,)))
    assert model.startswith("The model found here corrects for the curve along height")
    assert finding_name(unknown) == "an unknown dependence of the rate of climb on height"


def test_advice_restricts_a_location_specific_finding_to_its_recording():
    made = make_diagnosis(1, samples=50)
    placed = dataclasses.replace(made.findings[0], location_specific=True, alternatives=())
    (only,) = advice_of(dataclasses.replace(made, findings=(placed,)))
    assert "model found here" not in only


def test_advice_on_an_intermittent_step_is_to_find_its_cause():
    made = make_diagnosis(1, samples=50)
    step = dataclasses.replace(with_evidence(made.findings[0], timing.intermittency_result(True)), alternatives=())
    (only,) = advice_of(dataclasses.replace(made, findings=(step,)))
    assert only.startswith("Look for a cause that is switched on and off")


def test_advice_is_conditional_until_the_rival_is_distinguished():
    drift = Alternative("offset_drift", (), 0.4, False, recurrence=OffsetDrift.recurrence)
    apart, do, _model = advice_for(1, alternatives=(drift,))
    assert apart.startswith("To distinguish hard_iron_step from offset_drift")
    assert do.startswith("If it is hard_iron_step: look for what changed at that time")


def test_advice_excludes_an_implausible_finding_from_the_simulation():
    made = make_diagnosis(1, samples=50)
    doubted = dataclasses.replace(made.findings[0], plausible=False, alternatives=())
    (only,) = advice_of(dataclasses.replace(made, findings=(doubted,)))
    assert "hard_iron_step is not plausible" in only
    assert "another cause" in only


@pytest.mark.parametrize(
    ("formula", "text"), [("2 |x|^1.5 sign(x)", "the formula 2 |x|^1.5 sign(x)"), ("", "the curve")]
)
def test_advice_excludes_a_finding_of_another_shape_from_the_simulation(formula, text):
    made = make_diagnosis(1, samples=50)
    heat = dataclasses.replace(
        made.findings[0], effect="thermal_loss", advice="Add radiation with this coefficient.", alternatives=()
    )
    (only,) = advice_of(dataclasses.replace(made, findings=(with_another_shape(heat, formula=formula),)))
    assert only.startswith("Do not add thermal_loss to the simulation: the recording shows another shape.")
    assert text in only
    assert "Add radiation" not in only


def test_advice_on_an_unfit_simulation_is_to_correct_it_first():
    (only,) = make_unfit().advice
    assert only.startswith("Do not rely on this simulation yet: check the reasons")


def test_a_poor_fit_never_advises_using_the_simulation():
    lost = make_diagnosis(0, samples=50, environment=make_environment(goodness_of_fit=POOR_FITS, process_noise=()))
    assert lost.verdict == "unfit"
    assert "Use the simulation as it is" not in " ".join(lost.advice)
    followed = make_diagnosis(0, samples=50, environment=make_environment(process_noise=()))
    (advice,) = followed.advice
    assert advice.startswith("The simulation can be used")


def test_advice_on_a_disturbance_is_to_find_it_and_use_process_noise():
    (only,) = make_diagnosis(0, samples=50, verdict="unexplained", environment=make_environment()).advice
    assert only.startswith("Look for the cause of the disturbance of the rate of `rate`")
    assert "use 0.23 rad/s² as the process noise" in only


@pytest.mark.parametrize(("seconds", "example"), [(0.7, False), (300.0, True)])
def test_only_a_drift_over_minutes_may_be_the_warming_up_of_a_sensor(seconds, example):
    drift = dataclasses.replace(PROCESS_NOISE, place="angle", at_rate=False, correlation_time=seconds)
    (only,) = make_diagnosis(
        0, samples=50, verdict="unexplained", environment=make_environment(process_noise=(drift,))
    ).advice
    assert only.startswith("Look for a cause of the drift of `angle`")
    assert ("warming up" in only) == example


def test_a_step_and_a_drift_are_distinguished_by_another_recording():
    drift = Alternative("offset_drift", (), 0.4, False, recurrence=OffsetDrift.recurrence)
    sentence = advice_for(1, alternatives=(drift,))[0]
    assert sentence.startswith("To distinguish hard_iron_step from offset_drift, record again")
    assert "a step does not come at the same moment again" in sentence
    assert "a warm-up comes again after a cold start" in sentence
    assert "hold the other" not in sentence


def test_an_event_and_a_column_are_distinguished_by_changing_the_column_at_other_times():
    current = Alternative("current_field", ("current",), 0.4, False)
    sentence = advice_for(1, alternatives=(current,))[0]
    assert sentence.startswith("To distinguish hard_iron_step from current_field (current), record again")
    assert "let current change at other times" in sentence


@pytest.mark.parametrize(
    ("rival", "how"),
    [
        (Alternative("temperature_offset", ("temperature",), 0.4, False), "change one column and hold the other."),
        (Alternative("driver_linear", ("current",), 0.4, False), "record again with current over a wider range."),
        (Alternative("linear_drag", (), 0.4, False, "rate of speed"), "change at other times."),
    ],
)
def test_two_columns_are_distinguished_by_changing_only_one(rival, how):
    made = make_diagnosis(2, samples=50)
    current = dataclasses.replace(made.findings[1], alternatives=(rival,))
    assert advice_of(dataclasses.replace(made, findings=(current,)))[0].endswith(how)


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("speed", "at other speeds, loads and amplitudes"),
        ("temperature", "from another temperature, with other heating and cooling"),
        ("", "with other inputs and amplitudes"),
    ],
)
def test_rivals_are_distinguished_according_to_the_kind_of_state(kind, how):
    made = make_diagnosis(1, samples=50)
    rival = Alternative("stribeck_friction", (), 0.4, False, "rate of speed")
    first = dataclasses.replace(
        made.findings[0], effect="coulomb_friction", recurrence="", alternatives=(rival,), kind=kind
    )
    assert advice_of(dataclasses.replace(made, findings=(first,)))[0] == (
        f"To distinguish coulomb_friction from stribeck_friction, record again {how}."
    )


def test_the_same_effect_elsewhere_is_named_with_its_place():
    made = make_diagnosis(1, samples=50)
    rivals = (
        Alternative("overflow", (), 0.4, False, "exchange of upper and lower"),
        Alternative("drag", (), 0.5, False),
    )
    first = dataclasses.replace(
        made.findings[0], effect="overflow", channels=("rate of upper",), drivers=(), alternatives=rivals
    )
    (sentence, *_) = advice_of(dataclasses.replace(made, findings=(first,)))
    assert sentence.startswith(
        "To distinguish overflow on the rate of upper from overflow on the exchange of upper and lower, drag, record"
    )


def test_advice_excludes_an_unconfirmed_finding_from_corrections():
    sentences = " ".join(advice_for(3))
    assert "Do not correct for the curve along temperature yet" in sentences
    assert "with temperature over a wider range" in sentences


def test_advice_on_an_adequate_simulation_is_to_use_it():
    (advice,) = advice_of(make_diagnosis(0, samples=50))
    assert advice.startswith("The simulation can be used")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"p_value": 0.04}, "Record again, for longer"),
        ({"verdict": "unexplained"}, "Record again, for longer"),
        ({"remaining": ("load", "rpm")}, "Look for other causes that vary with load, rpm"),
    ],
)
def test_advice_on_an_unexplained_residual_is_not_to_use_the_simulation(changes, text):
    (sentence,) = advice_of(make_diagnosis(0, samples=50, **changes))
    assert sentence.startswith(text)


def test_a_step_and_a_drift_have_different_recurrences():
    assert HardIronStep.recurrence != OffsetDrift.recurrence


def test_two_findings_of_the_same_effect_are_distinguished_by_their_place():
    made = make_diagnosis(1, samples=50)
    first = dataclasses.replace(made.findings[0], alternatives=(), channels=("rate of speed",))
    second = dataclasses.replace(first, grade="unconfirmed", channels=("rate of climb",))
    text = " ".join(advice_of(dataclasses.replace(made, findings=(first, second))))
    assert "corrects for hard_iron_step on the rate of speed:" in text
    assert "Do not correct for hard_iron_step on the rate of climb yet" in text
