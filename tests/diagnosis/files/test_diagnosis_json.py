import dataclasses
import json
import math

import numpy as np
import pytest

pytest.importorskip("jsonschema")

from mkc_torch.density import ChannelTails
from mkc_torch.diagnosis.evidence import prediction, residual_noise, timing
from mkc_torch.diagnosis.io.diagnosis_json import DiagnosisFileError, diagnosis_to_json, json_schema, validate
from mkc_torch.diagnosis.parts import OutputSize, SizeAtInput
from mkc_torch.diagnosis.result import (
    DensityCheck,
    DriverShift,
    EffectParameter,
    EvidenceResult,
    Extrapolation,
    HeldOut,
    Reference,
    Region,
    Stop,
)
from tests.diagnosis.factory import make_diagnosis, with_evidence


def written(diagnosis):
    return json.loads(diagnosis_to_json(diagnosis))


def with_finding(diagnosis, *said, **changes):
    first, *rest = diagnosis.findings
    first = with_evidence(dataclasses.replace(first, **changes), *said)
    return dataclasses.replace(diagnosis, findings=(first, *rest))


@pytest.fixture
def content():
    return written(make_diagnosis(3))


@pytest.mark.parametrize("findings", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 4])
def test_diagnoses_of_every_size_are_written(findings, channels):
    content = written(make_diagnosis(findings, channels=channels, samples=300))
    assert content["schema"] == "mkc-diagnosis/3"
    assert len(content["findings"]) == findings
    assert len(content["noise"]["sigma"]) == channels


def test_keys_are_those_of_the_format(content):
    assert set(content) == {
        "schema", "recording", "simulation", "samples", "level", "p_value", "verdict", "answer", "doubts",
        "goodness_of_fit", "before_the_search", "reasons", "noise",
        "search", "findings", "disturbance", "remaining", "baseline", "corrected", "ceiling", "advice", "warnings",
        "notes", "conditions", "rejected_intervals", "decisions",
    }  # fmt: skip
    assert set(content["search"]) == {
        "candidates", "surrogates", "seed", "starts", "restart_after", "quick", "stopped",
    }  # fmt: skip
    assert set(content["findings"][0]) == {
        "effect", "grade", "drivers", "channels", "intervals", "onset", "equation", "explanation", "parameters",
        "p_value", "shape", "held_out", "held_out_note", "alternatives", "plausible", "plausibility", "advice",
    }  # fmt: skip
    assert set(content["baseline"]) == {"log_likelihood", "rmse", "sigma", "d"}


def test_the_scores_have_the_size_of_each_output_in_its_unit_if_known():
    made = make_diagnosis(1)
    sizes = {"angle": OutputSize(0.02, "rad"), "rate": OutputSize(0.3, "rad/s")}
    changed = dataclasses.replace(made, corrected=dataclasses.replace(made.corrected, outputs=sizes))
    content = written(changed)
    assert content["corrected"]["outputs"]["rate"] == {"rmse": 0.3, "unit": "rad/s"}
    assert "outputs" not in content["baseline"]
    content["corrected"]["outputs"]["rate"]["rmse"] = -1.0
    with pytest.raises(DiagnosisFileError, match=r"corrected\.outputs\.rate\.rmse"):
        validate(content)


def test_the_ceiling_has_scores_and_density_in_the_file():
    diagnosis = make_diagnosis(1, channels=4)
    stored = written(diagnosis)["ceiling"]
    assert stored["rmse"] == diagnosis.ceiling.rmse
    assert stored["log_likelihood"] == diagnosis.ceiling.log_likelihood
    assert len(stored["sigma"]) == len(stored["d"]) == 4


def test_results_for_the_report_only_are_not_written():
    diagnosis = with_finding(
        make_diagnosis(1),
        prediction.extrapolation_result(Extrapolation(0.2, (0.1, 0.3))),
    )
    assert written(diagnosis) == written(make_diagnosis(1))


def test_region_and_shares_of_runs_are_written_if_known():
    region = Region("level", "cm", "above", 14.2, 0.91, 0.1)
    (finding,) = written(with_finding(make_diagnosis(1), region=region, experiments=(0.25, 0.75)))["findings"]
    assert finding["region"] == dataclasses.asdict(region)
    assert finding["experiments"] == [0.25, 0.75]
    (without,) = written(make_diagnosis(1))["findings"]
    assert "region" not in without
    assert "experiments" not in without


def test_recordings_with_a_size_of_their_own_are_written():
    drag = EffectParameter("drag", (0.01, 0.02), (0.001, 0.001), "1/m", ("a", "b"))
    (finding,) = written(with_finding(make_diagnosis(1), parameters=(drag,), recordings=("a", "b")))["findings"]
    assert finding["recordings"] == ["a", "b"]
    assert finding["parameters"][0]["components"] == ["a", "b"]
    assert "recordings" not in written(make_diagnosis(1))["findings"][0]


def test_the_driver_shift_is_written():
    (finding,) = written(with_finding(make_diagnosis(1), timing.driver_shift_result(DriverShift(38, 2, 22.5))))[
        "findings"
    ]
    assert finding["driver_shift"] == {"copies": 38, "as_good": 2, "reach": 22.5}
    assert "driver_shift" not in written(make_diagnosis(1))["findings"][0]


def test_components_references_and_event_times_of_a_finding_are_written():
    parameter = EffectParameter("gradient", (1.0, -2.0), (0.1, 0.2), "µT/m", ("∂B_x/∂y", "∂B_x/∂z"))
    changes = {
        "parameters": (parameter,), "event_times": (61.1, 77.8), "advice": "Do it.",
        "references": (Reference("current", 10.5, "A"),),
        "at_input": SizeAtInput("torque", (EffectParameter("friction", 0.05, 0.001, "N m"),)),
    }  # fmt: skip
    said = timing.intermittency_result(True), timing.onset_result((60.9, 61.2))
    (finding,) = written(with_finding(make_diagnosis(1), *said, **changes))["findings"]
    assert finding["parameters"][0]["components"] == ["∂B_x/∂y", "∂B_x/∂z"]
    assert finding["event_times"] == [61.1, 77.8]
    assert finding["references"] == [{"column": "current", "value": 10.5, "unit": "A"}]
    assert finding["at_input"] == {
        "input": "torque",
        "parameters": [{"name": "friction", "value": 0.05, "standard_error": 0.001, "unit": "N m"}],
    }
    assert finding["advice"] == "Do it."
    assert finding["comes_and_goes"] is True
    assert finding["onset_interval"] == [60.9, 61.2]
    bare = dict.fromkeys(("event_times", "references"), ()) | {"advice": ""}
    assert not {"event_times", "references", "advice", "at_input"} & set(
        written(with_finding(make_diagnosis(1), **bare))["findings"][0]
    )


def test_units_tails_and_density_check_of_the_noise_are_written():
    made = make_diagnosis(1)
    check = DensityCheck("norm", 0.02, 0.03, 4.0, 0.05, False)
    tails = (ChannelTails(31.5, 0.041, 0.006),)
    noise = dataclasses.replace(made.noise, units={"drift": "µT"}, unit="µT", tails=tails)
    stored = written(with_evidence(dataclasses.replace(made, noise=noise), residual_noise.as_result([check])))["noise"]
    assert (stored["unit"], stored["units"]) == ("µT", {"drift": "µT"})
    assert stored["tails"] == [{"likelihood_ratio": 31.5, "share_beyond": 0.041, "share_error": 0.006}]
    assert stored["density_check"] == [
        {
            "channel": "norm", "distance": 0.02, "student_t_distance": 0.03, "degrees_of_freedom": 4.0,
            "allowed": 0.05,
        }
    ]  # fmt: skip


def test_results_of_a_new_test_are_under_its_id_and_the_key_order_is_kept():
    said = EvidenceResult(
        "my_test",
        content={"lag": 0.4, "by": ({"channel": "norm", "held_out": HeldOut(0.1, (0.0, 0.2), 1.0, 0.9, "µT")},)},
    )
    made = with_evidence(
        with_finding(make_diagnosis(1), said, timing.onset_result((1.0, 2.0)), timing.intermittency_result(True)),
        said,
    )
    content = written(made)
    held_out = {
        "log_likelihood_gain": 0.1,
        "confidence_interval": [0.0, 0.2],
        "rmse_before": 1.0,
        "rmse_after": 0.9,
        "unit": "µT",
        "outputs": {},
        "diverged_blocks": [],
        "blocks": 0,
    }
    expected = {"my_test": {"lag": 0.4, "by": [{"channel": "norm", "held_out": held_out}]}}
    assert content["evidence"] == content["findings"][0]["evidence"] == expected
    for place, schema in ((content, json_schema()), (content["findings"][0], json_schema()["$defs"]["finding"])):
        assert list(place) == [key for key in schema["properties"] if key in place]
    assert "evidence" not in written(make_diagnosis(1))


@pytest.mark.parametrize("evidence", [{}, {"My test": {"lag": 1}}, {"my_test": {}}, {"my_test": 0.4}, []])
def test_evidence_of_another_form_is_refused(content, evidence):
    content["evidence"] = evidence
    with pytest.raises(DiagnosisFileError, match="evidence"):
        validate(content)


def test_components_of_another_number_than_the_values_are_refused():
    parameter = EffectParameter("gradient", (1.0, -2.0, 3.0), None, "µT/m", ("a", "b"))
    with pytest.raises(DiagnosisFileError, match=r"parameters\.0\.components` differs in length"):
        diagnosis_to_json(with_finding(make_diagnosis(1), parameters=(parameter,)))


def test_a_region_of_unknown_kind_is_refused(content):
    content["findings"][0]["region"] = dataclasses.asdict(Region("level", "cm", "near", 14.2, 0.91, 0.1))
    with pytest.raises(DiagnosisFileError, match=r"findings\.0\.region\.kind"):
        validate(content)


def test_numbers_round_trip_exactly():
    values = (0.1 + 0.2, 1e-300, -math.pi)
    errors = ((1 / 3, 2 / 3), (1e22, 5e-324))
    parameters = (EffectParameter("a", values, None, ""), EffectParameter("b", ((1.5, 2.5), (3.5, 4.5)), errors, "µT"))
    content = written(with_finding(make_diagnosis(1), parameters=parameters, onset=0.1 + 0.7))
    first, second = content["findings"][0]["parameters"]
    assert first["value"] == list(values)
    assert first["standard_error"] is None
    assert second["standard_error"] == [list(row) for row in errors]
    assert content["findings"][0]["onset"] == 0.1 + 0.7


def test_numpy_numbers_are_written_as_json_numbers():
    parameter = EffectParameter("a", np.float64(0.3), np.float64("nan"), "")
    (stored,) = written(with_finding(make_diagnosis(1), parameters=(parameter,)))["findings"][0]["parameters"]
    assert stored["value"] == 0.3
    assert stored["standard_error"] is None


def test_unknown_values_are_null_and_a_gaussian_bandwidth_is_inf(content):
    assert content["corrected"]["sigma"] == ["inf"]
    assert content["findings"][1]["held_out"] is None
    assert content["findings"][1]["held_out_note"].startswith("The event")
    diagnosis = make_diagnosis(1, ceiling=None)
    errors = EffectParameter("a", (1.0, 2.0), (math.nan, 0.1), "")
    held_out = HeldOut(0.1, (-math.inf, 0.2), 1.0, 0.9, "µT")
    (rival, *_) = diagnosis.findings[0].alternatives
    gap = dataclasses.replace(rival, log_likelihood_gap=math.inf)
    said = prediction.held_out_gain_result(held_out, "")
    stored = written(with_finding(diagnosis, said, parameters=(errors,), alternatives=(gap,)))
    (finding,) = stored["findings"]
    assert stored["ceiling"] is None
    assert finding["parameters"][0]["standard_error"] == [None, 0.1]
    assert finding["held_out"]["confidence_interval"] == [None, 0.2]
    assert finding["alternatives"][0]["log_likelihood_gap"] is None


def test_numbers_that_are_not_finite_are_refused_with_their_place():
    bad = EffectParameter("a", (1.0, math.nan), None, "")
    with pytest.raises(DiagnosisFileError, match=r"`findings\.0\.parameters\.0\.value\.1` is nan"):
        diagnosis_to_json(with_finding(make_diagnosis(1), parameters=(bad,)))
    with pytest.raises(DiagnosisFileError, match="`p_value` is nan"):
        diagnosis_to_json(make_diagnosis(1, p_value=math.nan))


def test_a_quick_look_has_no_p_value():
    stored = written(with_finding(make_diagnosis(1, p_value=None, quick=True), p_value=None))
    assert (stored["p_value"], stored["findings"][0]["p_value"], stored["search"]["quick"]) == (None, None, True)
    for bad in (stored | {"p_value": 0.01}, stored | {"search": stored["search"] | {"quick": False}}):
        with pytest.raises(DiagnosisFileError):
            validate(bad)


def test_a_stopped_search_has_its_reason_and_the_skipped_steps():
    stored = written(make_diagnosis(0, p_value=None, stop=Stop("time limit", 60.2, ("the search for effects",))))
    assert stored["search"]["stopped"] == {
        "reason": "time limit", "seconds": 60.2, "not_done": ["the search for effects"],
    }  # fmt: skip
    assert written(make_diagnosis(0))["search"]["stopped"] is None
    del stored["search"]["stopped"]["not_done"]
    with pytest.raises(DiagnosisFileError, match="not_done"):
        validate(stored)


def test_missing_held_out_evidence_without_a_reason_is_refused():
    with pytest.raises(DiagnosisFileError, match="held_out_note"):
        diagnosis_to_json(with_finding(make_diagnosis(1), prediction.held_out_gain_result(None, "")))


def test_a_verdict_that_contradicts_its_findings_is_refused():
    with pytest.raises(DiagnosisFileError, match="findings"):
        diagnosis_to_json(make_diagnosis(1, verdict="adequate"))
    with pytest.raises(DiagnosisFileError, match="findings"):
        diagnosis_to_json(make_diagnosis(0, verdict="explained"))
    assert written(make_diagnosis(0, verdict="unexplained"))["findings"] == []
    assert len(written(make_diagnosis(2, verdict="unexplained"))["findings"]) == 2


BAD = [
    (("schema",), "mkc-diagnosis/2"),
    (("goodness_of_fit",), {"angle": {"unit": "rad"}}),
    (("noise", "input_hold"), {"torque": "stepped"}),
    (("search", "starts"), 0),
    (("remaining", "white"), "yes"),
    (("findings", 0, "grade"), "splendid"),
    (("findings", 0, "shape"), {"free_curve_gain": 3.0}),
    (("findings", 0, "held_out", "outputs"), {"angle": [0.2, 0.1]}),
    (("verdict",), "perhaps"),
    (("p_value",), 1.5),
    (("p_value",), None),
    (("level",), 0.0),
    (("samples",), -1),
    (("samples",), 3.5),
    (("samples",), True),
    (("noise", "model"), "pink"),
    (("noise", "sigma"), [0.0]),
    (("noise", "sigma"), ["infinite"]),
    (("noise", "parameters"), {"phi": "0.3"}),
    (("search", "seed"), "0"),
    (("baseline", "rmse"), -1.0),
    (("ceiling",), [0.1, 0.2]),
    (("ceiling", "rmse"), -1.0),
    (("warnings",), "one sentence"),
    (("findings", 0, "effect"), "Hard iron"),
    (("findings", 0, "drivers"), "current"),
    (("findings", 0, "onset"), "41 s"),
    (("findings", 0, "intervals"), [[1.0]]),
    (("findings", 0, "intervals"), [[1.0, 2.0, 3.0]]),
    (("findings", 0, "intervals"), [[2.0, 1.0]]),
    (("findings", 0, "parameters", 0, "standard_error"), [0.1, 0.1]),
    (("findings", 0, "parameters", 0, "standard_error"), 0.1),
    (("findings", 0, "parameters", 0, "standard_error"), [0.1, 0.1, -0.1]),
    (("findings", 0, "held_out", "confidence_interval"), [0.1]),
    (("findings", 0, "alternatives", 0, "separable"), "yes"),
    (("findings", 0, "plausible"), 1),
]


@pytest.mark.parametrize(("path", "value"), BAD, ids=[f"{'.'.join(map(str, p))}={v!r}" for p, v in BAD])
def test_bad_content_is_refused(content, path, value):
    *above, key = path
    place = content
    for step in above:
        place = place[step]
    place[key] = value
    with pytest.raises(DiagnosisFileError, match="mkc-diagnosis/3"):
        validate(content)


@pytest.mark.parametrize("path", [(), ("noise",), ("search",), ("findings", 0), ("findings", 0, "parameters", 0)])
def test_missing_and_unknown_keys_are_refused(content, path):
    place = content
    for step in path:
        place = place[step]
    place["more"] = 1
    with pytest.raises(DiagnosisFileError, match="'more' was unexpected"):
        validate(content)
    del place["more"]
    del place[next(iter(place))]
    with pytest.raises(DiagnosisFileError, match="is a required property"):
        validate(content)


def test_effects_defined_by_the_user_are_allowed(content):
    content["findings"][0]["effect"] = "my_magnet2"
    validate(content)


def test_the_schema_is_a_valid_json_schema():
    from jsonschema import Draft202012Validator

    assert json_schema()["$schema"] == Draft202012Validator.META_SCHEMA["$id"]
    Draft202012Validator.check_schema(json_schema())


def test_unicode_and_short_lists_stay_readable():
    text = diagnosis_to_json(make_diagnosis(1))
    assert "µT" in text
    assert "[3.2137, -1.1042, 0.3251]" in text
    assert text.endswith("}\n")


def test_texts_with_special_characters_round_trip():
    name = 'a "b" [1,\n 2] \\ <c> {d}'
    assert written(make_diagnosis(0, recording=name, warnings=(name, "")))["recording"] == name
