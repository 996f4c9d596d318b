"""What diagnosis.json says of the world around a simulation, and files of the first edition."""

import dataclasses
import json
import math

import pytest

pytest.importorskip("jsonschema")

from mkc_torch.diagnosis.environment import NoiseEnvironment
from mkc_torch.diagnosis.evidence import held_out_gain
from mkc_torch.diagnosis.io.diagnosis_json import DiagnosisFileError, diagnosis_to_json, json_schema, validate
from mkc_torch.diagnosis.result import EvidenceResult, HeldOut, ResidualSizes
from tests.diagnosis.factory import (
    PUSHED,
    graded,
    make_diagnosis,
    make_follows,
    make_forcing,
    make_unfit,
    make_world,
    nearest,
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


def pushed(**changes):
    return make_diagnosis(0, verdict="unexplained", samples=200, world=make_world(**changes))


def first_edition():
    """What a diagnosis.json of the first edition holds."""
    content = written(make_diagnosis(1))
    for key in ("follows", "reasons", "forcing", "remaining"):
        del content[key]
    for key in ("process", "sensor", "between"):
        del content["noise"][key]
    for key in ("starts", "quick", "stopped"):
        del content["search"][key]
    for finding in content["findings"]:
        del finding["grade"], finding["shape"], finding["held_out"]["outputs"], finding["held_out"]["left"]
    return content | {"schema": "mkc-diagnosis/1"}


def test_files_of_the_first_edition_are_still_read():
    validate(first_edition())
    later = first_edition()
    later["findings"][0]["grade"] = "left out"
    with pytest.raises(DiagnosisFileError, match="'grade' was unexpected"):
        validate(later)
    with pytest.raises(DiagnosisFileError, match="is a required property"):
        validate(first_edition() | {"schema": "mkc-diagnosis/2"})


def test_both_schemas_are_schemas():
    from jsonschema import Draft202012Validator

    for named in ("mkc-diagnosis/1", "mkc-diagnosis/2"):
        Draft202012Validator.check_schema(json_schema(named))
        assert json_schema(named)["properties"]["schema"] == {"const": named}


def test_a_diagnosis_that_knows_nothing_of_the_world_is_written():
    content = written(make_diagnosis(1, world=NoiseEnvironment()))
    assert content["follows"] == {}
    assert content["forcing"] == content["reasons"] == []
    assert {key: content["noise"][key] for key in ("process", "sensor", "between")} == {
        "process": {}, "sensor": {}, "between": {},
    }  # fmt: skip
    assert content["search"]["starts"] == 1
    assert content["remaining"] == {
        "white": None, "largest_lag": None, "unit": "", "channels": [], "driven": [], "smooth_along": [],
    }  # fmt: skip


def test_how_each_output_is_followed_is_written_in_its_own_unit():
    unknown = make_follows("rate", "rad/s", last_value_predicts=math.nan, floor_source="quantisation")
    content = written(pushed(follows=(make_follows(), unknown)))
    assert content["follows"]["angle"] == {
        "unit": "rad", "residual": 0.0049, "variation": 0.35, "explained": pytest.approx(0.9998, abs=1e-4),
        "noise_floor": 0.005, "floor_source": "declared", "mean_predicts": 0.35, "last_value_predicts": 0.021,
    }  # fmt: skip
    assert content["follows"]["rate"]["last_value_predicts"] is None


def test_pushes_and_what_inputs_do_are_written():
    slow = dataclasses.replace(PUSHED, place="angle", at_rate=False, unit="rad")
    weak = dataclasses.replace(PUSHED, lasting=0.0, size=0.05, standard_error=math.inf)
    noise = written(pushed(pushes=(PUSHED, slow, weak)))["noise"]
    assert noise["process"]["rate"]["size"] == 0.2284
    assert noise["process"]["rate"]["unit"] == "rad/s²"
    assert [one["size"] for one in noise["process"]["rate"]["besides"]] == [0.05]
    assert noise["process"]["rate"]["besides"][0]["standard_error"] is None
    assert set(noise["sensor"]) == {"angle"}
    assert noise["between"] == {"torque": "held"}


@pytest.mark.parametrize(("samples", "points"), [(300, 300), (500, 500), (501, 251), (40_000, 500)])
def test_a_forcing_of_any_length_is_written_briefly(samples, points):
    (forcing,) = written(pushed(forcing=(make_forcing(samples),)))["forcing"]
    assert len(forcing["time"]) == len(forcing["value"]) == len(forcing["band"]) == points
    assert forcing["state"] == "rate"
    assert forcing["time"][:3] == [0.0, *forcing["time"][1:3]]
    assert max(len(f"{v:.12g}".lstrip("-0.").replace(".", "")) for v in forcing["value"]) <= 6


def test_lists_of_a_forcing_go_together():
    content = written(pushed())
    content["forcing"][0]["band"].pop()
    with pytest.raises(DiagnosisFileError, match=r"forcing\.0` has lists of different lengths"):
        validate(content)


def test_what_remains_is_white_or_correlated_up_to_a_lag():
    told = written(with_evidence(pushed(), WHITENESS))["remaining"]
    assert told == {
        "white": False, "largest_lag": 0.7, "unit": "s", "channels": ["angle"], "driven": ["rate"], "smooth_along": [],
    }  # fmt: skip


def test_an_unfit_simulation_has_reasons_and_names_no_physics():
    content = written(make_unfit())
    assert content["verdict"] == "unfit"
    assert content["reasons"][1] == "`damping` ends at its bound, 0."
    with pytest.raises(DiagnosisFileError, match="findings"):
        diagnosis_to_json(make_diagnosis(1, verdict="unfit"))


def test_an_adequate_simulation_lacks_nothing_that_counts():
    made = make_diagnosis(1, samples=200, verdict="adequate")
    weak = dataclasses.replace(made, findings=(graded(made.findings[0], "not confirmed"),))
    assert written(weak)["findings"][0]["grade"] == "not confirmed"
    with pytest.raises(DiagnosisFileError, match="findings"):
        diagnosis_to_json(made)


def test_grades_shapes_and_sizes_of_each_output_are_written():
    held = HeldOut(
        0.3, (0.2, 0.4), 0.9, 0.5, "", {"angle": ResidualSizes(0.2, 0.1, "rad"), "speed": ResidualSizes(math.inf, 2.0, "rad/s")},
        "In 1 of 25 blocks the simulation alone leaves the recording's range.",
    )  # fmt: skip
    made = make_diagnosis(1, samples=200)
    finding = nearest(with_evidence(made.findings[0], held_out_gain.said(held, "")))
    (told,) = written(dataclasses.replace(made, findings=(finding,)))["findings"]
    assert told["grade"] == "nearest in the catalogue"
    assert told["shape"] == {"free_curve_gain": 163.0, "p_value": 0.002, "formula": "0.0071 |x|^1.52 sign(x)"}
    assert told["held_out"]["outputs"] == {
        "angle": {"before": 0.2, "after": 0.1, "unit": "rad"},
        "speed": {"before": None, "after": 2.0, "unit": "rad/s"},
    }
    assert told["held_out"]["left"].startswith("In 1 of 25 blocks")
    assert written(made)["findings"][0]["shape"] is None
