"""Whole diagnoses: a hidden effect is named, sized and corrected."""

import json

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
from mkc_torch.diagnosis.io.model import ModelFileError
from mkc_torch.effects import GainEffect
from mkc_torch.effects.sensor.hard_iron_step import HardIronStep
from mkc_torch.recording.recording import MissingColumnError, Recording
from mkc_torch.simulation import Dynamics, Magnetometer, Static
from tests.shared_data import shared_data
from tests.simulation.tumbling import FIELD, changed, tumbling

N = 2000
TIME = np.arange(N) / 50.0
CURRENT = 2.0 + 1.5 * np.sign(np.sin(2 * np.pi * TIME / 13.0)) + 0.3 * np.sin(2 * np.pi * TIME / 3.1)
TEMPERATURE = 22.0 + 6.0 * (1.0 - np.exp(-TIME / 15.0)) + 0.8 * np.sin(2 * np.pi * TIME / 17.0)
DECOYS = {
    "aux_1": np.cumsum(np.random.default_rng(1).standard_normal(N)),
    "aux_2": np.sin(2 * np.pi * TIME / 9.0) + 0.05 * TIME,
}
COLUMNS = {"current": CURRENT, "temperature": TEMPERATURE, **DECOYS}
GAIN = np.array([0.4, -0.3, 0.5])


def outliers(seed=3, share=0.1, size=15.0):
    """Sparse, large outliers on every axis."""
    random = np.random.default_rng(seed)
    return size * random.standard_normal((N, 3)) * (random.random((N, 1)) < share)


def recording_of(effect, **options):
    return tumbling(N, noise=0.4, sensor=effect + outliers(), **{**COLUMNS, **options})


HIDDEN = {
    "hard_iron_step": (4.0 * GAIN * (TIME[:, None] >= 23.4), (), "offset_change", 4.0 * GAIN),
    "current_field": (GAIN * (CURRENT[:, None] - 2.0), ("current",), "field_per_ampere", GAIN),
    "temperature_offset": (GAIN * (TEMPERATURE[:, None] - 22.0), ("temperature",), "offset_per_kelvin", GAIN),
}


@pytest.fixture(scope="module", params=sorted(HIDDEN))
def named_diagnosis(request):
    effect, drivers, parameter, value = HIDDEN[request.param]
    return request.param, drivers, parameter, value, diagnose(Magnetometer(), recording_of(effect))


@pytest.mark.e2e
def test_a_hidden_effect_is_named_with_its_driver(named_diagnosis):
    effect, drivers, _, _, diagnosis = named_diagnosis
    assert diagnosis.verdict == "explained"
    assert (diagnosis.findings[0].effect, diagnosis.findings[0].drivers) == (effect, drivers)
    assert diagnosis.findings[0].p_value <= 0.05


@pytest.mark.e2e
def test_the_size_of_a_named_effect_is_within_its_errors(named_diagnosis):
    _, _, name, value, diagnosis = named_diagnosis
    (parameter,) = [p for p in diagnosis.findings[0].parameters if p.name == name]
    off = (np.array(parameter.value) - value) / np.array(parameter.standard_error)
    assert np.abs(off).max() < 4.0
    assert np.abs(np.array(parameter.value) - value).max() < 0.25 * np.abs(value).max()


@pytest.mark.e2e
def test_a_named_effect_improves_the_fit_on_held_out_blocks(named_diagnosis):
    held = named_diagnosis[-1].findings[0].held_out
    assert held.confidence_interval[0] > 0.0
    assert held.rmse_after < held.rmse_before


@pytest.mark.e2e
def test_diagnosis_json_is_valid_and_contains_the_finding(named_diagnosis):
    effect, *_, diagnosis = named_diagnosis
    content = json.loads(diagnosis_to_json(diagnosis))
    assert content["schema"] == "mkc-diagnosis/3"
    assert content["findings"][0]["effect"] == effect


@pytest.mark.e2e
def test_the_model_corrects_another_recording(named_diagnosis):
    effect, *_, diagnosis = named_diagnosis
    model = DiagnosedModel.from_json(diagnosis.model.to_json())
    lasting = {"hard_iron_step": 4.0 * GAIN * np.ones((N, 1))}.get(effect, HIDDEN[effect][0])
    later = tumbling(N, noise=0.0, sensor=lasting, size=(0.9, 1.1, 1.2), **COLUMNS)
    columns, notes = model.correct(later)
    length = torch.stack([columns[f"field_{axis}"] for axis in "xyz"], -1).norm(dim=-1)
    assert float((length / length.mean() - 1.0).abs().max()) * np.linalg.norm(FIELD) < 0.5
    assert bool(notes) == (effect == "hard_iron_step")


@pytest.mark.e2e
def test_the_onset_of_a_step_is_accurate():
    effect = 4.0 * GAIN * (TIME[:, None] >= 23.4)
    assert diagnose(Magnetometer(), recording_of(effect)).findings[0].onset == pytest.approx(23.4, abs=0.3)


@pytest.mark.e2e
def test_noise_alone_has_no_findings():
    found = [diagnose(Magnetometer(), tumbling(N, noise=0.4, sensor=outliers(s), seed=s, **COLUMNS)) for s in range(4)]
    assert sum(d.verdict != "adequate" for d in found) <= 1
    assert all(d.model is not None for d in found)


@pytest.mark.e2e
def test_the_same_seed_gives_the_same_diagnosis():
    recording = recording_of(np.zeros((N, 3)))
    first, second = (diagnosis_to_json(diagnose(Magnetometer(), recording, seed=5)) for _ in range(2))
    assert first == second


@pytest.mark.e2e
def test_findings_do_not_depend_on_a_time_offset_or_the_recording_name():
    recording = recording_of(HIDDEN["current_field"][0])
    moved = Recording({**recording.columns, "time": recording["time"] + 1000.0}, name="other", units=recording.units)
    a, b = diagnose(Magnetometer(), recording), diagnose(Magnetometer(), moved)
    assert [f.effect for f in a.findings] == [f.effect for f in b.findings]
    assert np.allclose(a.findings[0].parameters[0].value, b.findings[0].parameters[0].value, rtol=1e-3)


@pytest.mark.e2e
def test_a_copy_of_the_driver_is_an_inseparable_rival():
    recording = recording_of(HIDDEN["current_field"][0], spare=3.0 * CURRENT + 1.0)
    (finding, *_) = diagnose(Magnetometer(), recording).findings
    assert finding.drivers == ("current",)
    assert ("spare",) in [a.drivers for a in finding.alternatives if not a.separable]


@pytest.mark.e2e
def test_the_level_holds_with_three_hundred_columns():
    random = np.random.default_rng(4)
    many = {f"column_{k}": np.cumsum(random.standard_normal(N)) for k in range(300)}
    assert diagnose(Magnetometer(), tumbling(N, noise=0.4, sensor=outliers(), **many)).verdict == "adequate"


@pytest.mark.e2e
def test_a_model_without_its_driver_raises():
    model = diagnose(Magnetometer(), recording_of(HIDDEN["current_field"][0])).model
    with pytest.raises(MissingColumnError, match=r"current_field by the column `current`.*--columns current=NAME"):
        model.correct(changed(recording_of(np.zeros((N, 3))), current=None))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ('{"schema": "mkc-calibration/1"}', 'its schema is "mkc-calibration/1"'),
        ('{"schema": "mkc-model/1"}', "damaged"),
        (
            '{"schema": "mkc-model/1", "simulation": "magnetometer", "state": {}, "parameters": [], '
            '"effects": [{"effect": "magic", "drivers": [], "shape": {}, "parameters": []}]}',
            '"magic" is unknown.*effects=',
        ),
        (
            '{"schema": "mkc-model/1", "simulation": "a", "state": {}, "parameters": [], "effects": '
            '[{"effect": "dead_zone", "drivers": [], "shape": {"width": 1.0}, "parameters": [1.0]}]}',
            'shape of its effect "dead_zone" lacks softness.*diagnose the recording again',
        ),
    ],
)
def test_invalid_model_text_raises(text, message):
    with pytest.raises(ModelFileError, match=message):
        DiagnosedModel.from_json(text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"level": 0.0}, "`level`"),
        ({"surrogates": 5}, "`surrogates` to be at least 19"),
        ({"max_findings": -1}, "`max_findings` to be a whole number of at least 0 but got -1; 3 is usual"),
        ({"max_findings": 1.5}, "`max_findings` to be a whole number of at least 0 but got 1.5"),
        ({"surrogates": 19.5}, "`surrogates` to be a whole number"),
        ({"seed": "a"}, "`seed` to be a whole number but got 'a'"),
    ],
)
def test_arguments_out_of_range_raise(options, message):
    with pytest.raises(ValueError, match=message):
        diagnose(Magnetometer(), recording_of(np.zeros((N, 3))), **options)


class EffectOfAnotherClass:
    id = "lacking"


class EffectWithoutId(GainEffect):
    """An effect without an id."""


class EffectWithTextRoles(HardIronStep):
    roles = "temperature"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"simulation": "magnetometer"}, r"got 'magnetometer'; pass a simulation, such as Magnetometer\(\), or use"),
        ({"simulation": Magnetometer}, r"got the class Magnetometer; .*, Magnetometer\(\)"),
        ({"simulation": None}, r"`simulation` to be a Simulation but got None; pass a"),
        ({"recording": "NEW.csv"}, r"`recording` to be a Recording but got 'NEW\.csv'; read it, Recording\.read\('NEW"),
        ({"recording": {"time": torch.ones(3)}}, r"`recording` to be a Recording but got .*; make one, Recording\("),
        (
            {"effects": ("hard_iron_step",)},
            r"`effects` to hold Effects but got 'hard_iron_step'; .*CATALOGUE",
        ),
        (
            {"effects": "hard_iron_step"},
            r"`effects` to be a sequence of Effects but got 'hard_iron_step'; pass a tuple",
        ),
        ({"effects": HardIronStep()}, "`effects` to be a sequence of Effects but got a HardIronStep; pass a tuple"),
        ({"effects": None}, r"`effects` to be a sequence of Effects but got None; .*\(\) for no effects"),
        ({"effects": (HardIronStep,)}, r"got the class HardIronStep; .*, HardIronStep\(\)"),
        (
            {"effects": (EffectOfAnotherClass(),)},
            "got an EffectOfAnotherClass; derive it from mkc_torch.effects.Effect",
        ),
        ({"effects": (EffectWithoutId(),)}, "got an EffectWithoutId; give it an `id`"),
        ({"effects": (EffectWithTextRoles(),)}, r"its roles are names, \('temperature',\)"),
        ({"level": "a"}, r"`level` to be a number in \(0, 1\) but got 'a'"),
    ],
)
def test_arguments_of_another_type_raise_with_a_remedy(changed, message):
    given = {"simulation": Magnetometer(), "recording": recording_of(np.zeros((N, 3)))} | changed
    with pytest.raises(TypeError, match=message):
        diagnose(**given)


def test_swapped_arguments_raise_with_their_order():
    with pytest.raises(TypeError, match=r"`simulation` .* got Recording.*; .*diagnose\(simulation, recording\)"):
        diagnose(recording_of(np.zeros((N, 3))), Magnetometer())


def test_effects_may_come_from_an_iterator():
    table = tumbling(600, noise=0.4)
    options = {"surrogates": 19, "max_findings": 0}
    once = diagnose(Magnetometer(), table, effects=iter((HardIronStep(),)), **options)
    assert (
        once.candidates_tried == diagnose(Magnetometer(), table, effects=(HardIronStep(),), **options).candidates_tried
    )
    assert once.candidates_tried > 0


def test_two_samples_raise():
    with pytest.raises(ValueError, match="2 samples are too few"):
        diagnose(Magnetometer(), tumbling(2))


@pytest.mark.e2e
@pytest.mark.parametrize(("name", "onset", "step"), [
    ("broad_34_attached_magnet_3cm", 51.5, (1.3, -0.5, -13.4)),
    ("broad_36_attached_magnet_5cm", 54.8, (-0.7, -0.1, 5.7)),
])  # fmt: skip
def test_a_magnet_removed_from_a_real_sensor_is_found(name, onset, step):
    whole = Recording.read(shared_data(f"magnetometer/{name}.csv"))
    # every fourth sample and the length only, for speed
    columns = {key: whole[key][::4] for key in ("time", "mag_x", "mag_y", "mag_z")}
    finding = diagnose(Magnetometer(use="norm"), Recording(columns, name=name)).findings[0]
    assert finding.effect == "hard_iron_step"
    assert finding.onset == pytest.approx(onset, abs=1.0)
    assert np.abs(np.array(finding.parameters[0].value) - step).max() < 1.0


class Swing(Dynamics):
    states = ("angle", "speed")
    outputs = ("angle",)
    parameters = {"stiffness": 2.0}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * x.angle}


class Divider(Static):
    inputs, outputs, parameters = ("supply",), ("voltage",), {"share": 1.0}

    def output(self, time, u, p):
        return {"voltage": p.share * u.supply}


@pytest.mark.parametrize(
    ("simulation", "words"),
    [(Swing(), "still: .*`angle` is 0 in all samples"), (Divider(), "still: `voltage` differs .* no noise")],
)
def test_an_output_without_noise_raises(simulation, words):
    time = torch.arange(0.0, 6.0, 0.05, dtype=torch.float64)
    recording = Recording({"time": time, "supply": torch.sin(time), simulation.outputs[0]: 0.0 * time}, name="still")
    with pytest.raises(ValueError, match=words):
        diagnose(simulation, recording)
