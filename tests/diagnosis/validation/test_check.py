"""A model holds on a recording that no fit has used if its findings make the residual clearly smaller there."""

import json
import math
from pathlib import Path

import pytest
import torch

import mkc_torch
from mkc_torch import Recording, check
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io.model import ModelFileError
from mkc_torch.diagnosis.io.training import BlockSquares, OutputTraining
from mkc_torch.diagnosis.validation.fingerprint import of_runs
from mkc_torch.diagnosis.validation.judge import judged, unless_lost
from mkc_torch.diagnosis.validation.result import SCHEMA
from mkc_torch.diagnosis.validation.training import with_training
from mkc_torch.simulation import Magnetometer, Paired, Static
from tests.diagnosis.validation.tank import Tank, tank_model, tank_recording, two_runs, usual_model

SCHEMA_FILE = Path(mkc_torch.__file__).parent / "diagnosis" / "io" / "schema" / "check_1.schema.json"


def test_findings_that_repeat_hold():
    found = check(usual_model(), tank_recording(1))
    (level,) = found.outputs
    assert found.holds
    assert found.verdict == "holds"
    assert level.claimed
    assert level.ratio.high < 1.0
    assert level.corrected == pytest.approx(0.005, rel=0.3)
    residual = found.traces.measured - found.traces.corrected
    assert level.corrected == pytest.approx(float(residual[found.traces.predicted].square().mean().sqrt()))
    residual = found.traces.measured - found.traces.baseline
    assert level.baseline == pytest.approx(float(residual[found.traces.predicted].square().mean().sqrt()))


def test_findings_of_a_system_that_lacks_nothing_do_not_hold():
    found = check(usual_model(), tank_recording(1, drag=0.0))
    assert not found.holds
    assert "level: the findings do not make the residual clearly smaller" in found.reasons[0]


@pytest.mark.e2e
def test_a_model_without_findings_holds_where_its_residual_is_as_before():
    model = usual_model(findings=False)
    assert check(model, tank_recording(1, drag=0.0)).verdict == "holds"
    drifted = check(model, tank_recording(1, drag=0.05))
    assert drifted.verdict == "does not hold"
    assert "clearly larger than in the diagnosed recording" in drifted.reasons[0]


@pytest.mark.e2e
@pytest.mark.parametrize("joined", [False, True])
def test_a_recording_of_the_fit_is_recognised_also_as_one_of_several_runs(joined):
    known = tank_recording(0)
    moved = Recording({**known.columns, "time": known["time"] + 5.0}, name="renamed")
    found = check(usual_model(), two_runs(tank_recording(1), known) if joined else moved)
    assert found.verdict == "used in the fit"
    assert found.used_in_fit
    assert not found.holds
    assert found.reasons == (
        "This recording was used in the fit, so it tests nothing; check a recording that no fit has used.",
    )


def test_fingerprints_differ_by_the_last_digit_of_a_sample():
    known = tank_recording(0)
    level = known["level"].clone()
    level[7] += 1e-12
    assert of_runs(known, ["level"]) != of_runs(Recording({**known.columns, "level": level}), ["level"])


@pytest.mark.e2e
def test_the_model_in_a_file_gives_the_same_check():
    model = usual_model()
    again = DiagnosedModel.from_json(model.to_json(), simulation=Tank())
    assert check(again, tank_recording(1)).to_dict() == check(model, tank_recording(1)).to_dict()


def test_a_model_of_an_earlier_version_is_refused():
    content = json.loads(usual_model().to_json())
    known = content.pop("training")
    old = DiagnosedModel.from_json(json.dumps(content), simulation=Tank())
    with pytest.raises(ValueError, match="diagnose the recording again with this version"):
        check(old, tank_recording(1))
    for damaged in ({**known, "parameters": [math.inf]}, {"parameters": [0.3]}):
        with pytest.raises(ModelFileError, match="damaged"):
            DiagnosedModel.from_json(json.dumps({**content, "training": damaged}, allow_nan=True), simulation=Tank())


def test_arguments_of_another_kind_are_refused():
    with pytest.raises(TypeError, match="Expected argument `model` to be a DiagnosedModel but got"):
        check("model.json", tank_recording(1))
    with pytest.raises(TypeError, match="Expected argument `recording` to be a Recording but got"):
        check(usual_model(), "new.csv")
    with pytest.raises(ValueError, match="`input_hold` to name inputs in the equations of this simulation but got"):
        check(usual_model(), tank_recording(1), input_hold={"level": "held"})


@pytest.mark.e2e
def test_the_hold_of_an_input_can_be_that_of_another_logger():
    held = check(usual_model(), tank_recording(1), input_hold={"inflow": "held"})
    assert held.outputs[0].corrected > 1.5 * check(usual_model(), tank_recording(1)).outputs[0].corrected


@pytest.mark.e2e
def test_a_diagnosis_adds_what_a_check_needs():
    time = torch.arange(200).double() / 10.0
    random = torch.Generator().manual_seed(0)
    columns = {"time": time, "heat": torch.sin(time), "load": torch.cos(2.3 * time)}

    def bench():
        noise = 0.01 * torch.randn(200, generator=random).double()
        return Recording({**columns, "voltage": 2.0 * columns["heat"] + 0.5 * columns["load"] + noise})

    line = Static(torch.nn.Linear(1, 1), inputs=("heat",), outputs=("voltage",))
    first, second = bench(), bench()
    result = mkc_torch.diagnose(line, first, surrogates=19)
    assert result.findings
    assert check(result.model, first).used_in_fit
    found = check(result.model, second)
    assert found.holds
    assert found.start_seconds is None
    assert found.predicted == 200
    with pytest.raises(ValueError, match=r"Linear has no initial states; all samples are predicted"):
        check(result.model, second, start_seconds=1.0)


def test_a_simulators_output_is_checked_at_all_samples():
    time = torch.arange(200).double() / 10.0
    random = torch.Generator().manual_seed(0)
    simulated = Recording({"time": time, "angle": torch.sin(time)})
    model = DiagnosedModel("simulated", {"channels": ["angle"]}, torch.zeros(2).double(), (), (), Paired(simulated))

    def measured(size):
        noise = size * torch.randn(200, generator=random).double()
        return Recording({"time": time, "angle": torch.sin(time) + noise})

    model = with_training(model, torch.zeros(2), model.state, measured(0.1), ("angle",))
    assert check(model, measured(0.1)).holds
    assert not check(model, measured(0.3)).holds


def test_a_magnetometer_is_checked_by_the_spread_of_the_field():
    random = torch.Generator().manual_seed(0)

    def tumbling(offset, strength=48.0):
        field = torch.nn.functional.normalize(torch.randn(400, 3, generator=random).double(), dim=-1)
        mag = strength * field + torch.tensor(offset).double() + 0.1 * torch.randn(400, 3, generator=random).double()
        return Recording(
            {"time": torch.arange(400) / 50.0, **dict(zip(("mag_x", "mag_y", "mag_z"), mag.T, strict=True))}
        )

    theta = torch.tensor([12.0, -8.0, 21.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]).double()
    model = DiagnosedModel(
        "magnetometer", {"view": "norm", "unit": "µT", "strength": 48.0}, theta, (), (), Magnetometer()
    )
    columns = ("mag_x", "mag_y", "mag_z")
    model = with_training(model, theta, model.state, tumbling((12.0, -8.0, 21.0)), columns)
    # a stronger field, at another place, has the same relative spread
    found = check(model, tumbling((12.0, -8.0, 21.0), strength=60.0))
    assert found.holds
    assert found.outputs[0].output == "length of the field"
    assert found.outputs[0].corrected == pytest.approx(0.1 / 60.0, rel=0.2)
    assert not check(model, tumbling((14.0, -8.0, 21.0))).holds


def outputs(*sizes):
    return BlockSquares(tuple(size**2 for size in sizes), (30,) * len(sizes))


BEFORE, AFTER = outputs(1.0, 1.1, 0.9, 1.0), outputs(0.5, 0.55, 0.45, 0.5)


@pytest.mark.parametrize(
    ("new", "training", "failure"),
    [
        (OutputTraining(BEFORE, AFTER), OutputTraining(BEFORE, AFTER), ""),
        (OutputTraining(BEFORE, BEFORE), OutputTraining(BEFORE, AFTER), "do not make the residual clearly smaller"),
        (OutputTraining(BEFORE, outputs(0.98, 1.08, 0.88, 0.98)), OutputTraining(BEFORE, AFTER), "clearly smaller"),
        (OutputTraining(AFTER, BEFORE), OutputTraining(BEFORE, BEFORE), "make the residual clearly larger"),
        (OutputTraining(BEFORE, outputs(1.01, 1.11, 0.91, 1.01)), OutputTraining(BEFORE, BEFORE), ""),
        (OutputTraining(BEFORE, outputs(0.5, 1.6, 0.4, 1.5)), OutputTraining(BEFORE, BEFORE), ""),
    ],
)
def test_an_output_fails_for_a_clear_reason_only(new, training, failure):
    found = judged("angle", "rad", new, training, 0.9, findings=True, any_claim=True)
    assert failure in found.failure
    assert bool(found.failure) == bool(failure)


def test_a_simulation_that_loses_the_recording_does_not_hold():
    good = judged(
        "a", "", OutputTraining(BEFORE, AFTER), OutputTraining(BEFORE, AFTER), 0.9, findings=True, any_claim=True
    )
    lost = judged(
        "b", "", OutputTraining(BEFORE, AFTER), OutputTraining(BEFORE, AFTER), -3.0, findings=True, any_claim=True
    )
    assert not any(each.failure for each in unless_lost((good, good)))
    first, second = unless_lost((good, lost))
    assert not first.failure
    assert "b: the simulation with the findings does not follow the recording: it explains nothing" in second.failure


@pytest.mark.e2e
def test_the_json_has_every_number():
    """All keys are required by the schema, and no other is allowed."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(SCHEMA_FILE.read_text(encoding="utf-8"))
    content = json.loads(check(usual_model(), tank_recording(1)).to_json())
    jsonschema.validate(content, schema, jsonschema.Draft202012Validator)
    assert schema["properties"]["schema"] == {"const": SCHEMA}
    short = check(usual_model(), tank_recording(1).rows(torch.arange(9)))
    assert short.to_dict()["outputs"]["level"]["growth_interval"]
    jsonschema.validate(json.loads(short.to_json()), schema, jsonschema.Draft202012Validator)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**content, "more": 1}, schema)


@pytest.mark.e2e
def test_a_recording_too_short_for_a_prediction_leaves_only_the_fingerprints():
    short = tank_recording(0).rows(torch.arange(5))
    model = usual_model()
    found = with_training(model, model.theta, model.state, short, ("level",))
    assert found.reference.outputs == {}
    assert found.reference.fingerprints == of_runs(short, ["level"])
    assert tank_model(tank_recording(0)).reference.outputs["level"].corrected.rmse == pytest.approx(0.005, rel=0.3)
