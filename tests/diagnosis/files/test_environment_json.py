"""Goodness of fit, noise, disturbances and remaining residual in diagnosis.json."""

import dataclasses
import json
import math

import pytest

pytest.importorskip("jsonschema")

from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.evidence import prediction
from mkc_torch.diagnosis.io.diagnosis_json import DiagnosisFileError, diagnosis_to_json, validate
from mkc_torch.diagnosis.result import DivergedBlock, EvidenceResult, HeldOut, ResidualSizes
from tests.diagnosis.factory import (
    PROCESS_NOISE,
    graded,
    make_diagnosis,
    make_disturbance,
    make_environment,
    make_goodness_of_fit,
    make_unfit,
    with_another_shape,
    with_evidence,
)

WHITENESS = EvidenceResult(
    "whiteness",
    content={
        "unit": "s",
        "channels": [
            {"channel": "angle", "white": False, "lag": 0.7, "neighbours": 0.6, "p_value": 0.0, "lags": 20},
            {"channel": "rate", "white": True, "lag": 0.0, "neighbours": 0.01, "p_value": 0.4, "lags": 20},
        ],
    },
)


def written(diagnosis):
    return json.loads(diagnosis_to_json(diagnosis))


def disturbed(**changes):
    return make_diagnosis(0, verdict="unexplained", samples=200, environment=make_environment(**changes))


def test_a_diagnosis_without_an_environment_is_written():
    content = written(make_diagnosis(1, environment=NoiseEnvironment()))
    assert content["goodness_of_fit"] == {}
    assert content["disturbance"] == content["reasons"] == []
    assert {key: content["noise"][key] for key in ("process", "sensor", "input_hold")} == {
        "process": {}, "sensor": {}, "input_hold": {},
    }  # fmt: skip
    assert content["search"]["starts"] == 1
    assert content["remaining"] == {
        "white": None, "largest_lag": None, "unit": "", "channels": [], "disturbed_states": [], "smooth_along": [],
    }  # fmt: skip


def test_goodness_of_fit_is_written_in_the_unit_of_each_output():
    unknown = make_goodness_of_fit("rate", "rad/s", rmse_of_last_value=math.nan, floor_source="quantisation")
    content = written(disturbed(goodness_of_fit=(make_goodness_of_fit(), unknown)))
    assert content["goodness_of_fit"]["angle"] == {
        "unit": "rad", "residual": 0.0049, "variation": 0.35, "explained": pytest.approx(0.9998, abs=1e-4),
        "noise_floor": 0.005, "floor_source": "declared", "rmse_of_mean": 0.35, "rmse_of_last_value": 0.021,
    }  # fmt: skip
    assert content["goodness_of_fit"]["rate"]["rmse_of_last_value"] is None


def test_process_noise_and_input_hold_are_written():
    slow = dataclasses.replace(PROCESS_NOISE, place="angle", at_rate=False, unit="rad")
    weak = dataclasses.replace(PROCESS_NOISE, correlation_time=0.0, size=0.05, standard_error=math.inf)
    noise = written(disturbed(process_noise=(PROCESS_NOISE, slow, weak)))["noise"]
    assert noise["process"]["rate"]["size"] == 0.2284
    assert noise["process"]["rate"]["unit"] == "rad/s²"
    assert [item["size"] for item in noise["process"]["rate"]["weaker"]] == [0.05]
    assert noise["process"]["rate"]["weaker"][0]["standard_error"] is None
    assert set(noise["sensor"]) == {"angle"}
    assert noise["input_hold"] == {"torque": "held"}


@pytest.mark.parametrize(("samples", "points"), [(300, 300), (500, 500), (501, 251), (40_000, 500)])
def test_a_long_disturbance_is_decimated(samples, points):
    (forcing,) = written(disturbed(disturbance=(make_disturbance(samples),)))["disturbance"]
    assert len(forcing["time"]) == len(forcing["value"]) == len(forcing["band"]) == points
    assert forcing["state"] == "rate"
    assert forcing["time"][:3] == [0.0, *forcing["time"][1:3]]
    assert max(len(f"{v:.12g}".lstrip("-0.").replace(".", "")) for v in forcing["value"]) <= 6


def test_disturbance_lists_of_unequal_length_are_refused():
    content = written(disturbed())
    content["disturbance"][0]["band"].pop()
    with pytest.raises(DiagnosisFileError, match=r"disturbance\.0` has lists of different lengths"):
        validate(content)


def test_whiteness_of_the_residual_is_written():
    stored = written(with_evidence(disturbed(), WHITENESS))["remaining"]
    assert stored == {
        "white": False, "largest_lag": 0.7, "unit": "s", "channels": ["angle"], "disturbed_states": ["rate"],
        "smooth_along": [],
    }  # fmt: skip


def test_an_unfit_simulation_has_reasons_and_names_no_physics():
    content = written(make_unfit())
    assert content["verdict"] == "unfit"
    assert content["reasons"] == list(make_unfit().environment.reasons)
    assert "`damping`" in content["reasons"][1]
    with pytest.raises(DiagnosisFileError, match="findings"):
        diagnosis_to_json(make_diagnosis(1, verdict="unfit"))


def test_an_adequate_simulation_has_only_unconfirmed_findings():
    made = make_diagnosis(1, samples=200, verdict="adequate")
    weak = dataclasses.replace(made, findings=(graded(made.findings[0], "unconfirmed"),))
    assert written(weak)["findings"][0]["grade"] == "unconfirmed"
    with pytest.raises(DiagnosisFileError, match="findings"):
        diagnosis_to_json(made)


def test_grades_shapes_and_sizes_of_each_output_are_written():
    held = HeldOut(
        0.3, (0.2, 0.4), 0.9, 0.5, "",
        {"angle": ResidualSizes(0.2, 0.1, "rad"), "speed": ResidualSizes(math.inf, 2.0, "rad/s")},
        (DivergedBlock(7, before=True, after=False),), 25,
    )  # fmt: skip
    made = make_diagnosis(1, samples=200)
    finding = with_another_shape(with_evidence(made.findings[0], prediction.held_out_gain_result(held, "")))
    (stored,) = written(dataclasses.replace(made, findings=(finding,)))["findings"]
    assert stored["grade"] == "nearest"
    assert stored["shape"] == {"free_curve_gain": 163.0, "p_value": 0.002, "formula": "0.0071 |x|^1.52 sign(x)"}
    assert stored["held_out"]["outputs"] == {
        "angle": {"before": 0.2, "after": 0.1, "unit": "rad"},
        "speed": {"before": None, "after": 2.0, "unit": "rad/s"},
    }
    assert stored["held_out"]["diverged_blocks"] == [{"number": 7, "before": True, "after": False}]
    assert stored["held_out"]["blocks"] == 25
    assert written(made)["findings"][0]["shape"] is None
