"""Effects on an output or an input act in series; effects on several outputs have an amplitude for each."""

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import DYNAMICS, PAIRED, lagged, played, shifted
from mkc_torch.effects.paired.output_backlash import OutputBacklash, SeveralBacklash
from mkc_torch.simulation import Dynamics, Paired
from tests.effects.contexts import paired_context

TIME = torch.arange(400, dtype=torch.float64) / 20.0
JOINTS = {"pan": torch.sin(TIME), "tilt": 0.5 * torch.cos(1.7 * TIME)}


def arm(**units):
    table = Recording({"time": TIME, **JOINTS}, units=units)
    return Paired(table), Recording({"time": TIME, **{name: y + 0.1 for name, y in JOINTS.items()}}, units=units)


def terms(prepared, *names, port=None):
    """Return the first candidate of each name, at a port."""
    every = candidate_terms(prepared, (), PAIRED)
    return [next(t for t in every if t.effect.id == name and t.port in (port, "all outputs")) for name in names]


def test_play_stands_still_after_a_reversal():
    context = paired_context(OutputBacklash())
    y = context.part("own")
    shown = y + OutputBacklash().change(torch.tensor([0.3]).double(), {}, context)[:, 0]
    torch.testing.assert_close(shown, played(y, context.time, 0.3))
    assert float((shown - y).abs().max()) == pytest.approx(0.3)


def test_derivative_at_no_gap_is_the_direction_of_motion():
    context = paired_context(SeveralBacklash())
    at = torch.zeros(2, dtype=torch.float64)
    slope = torch.func.jacfwd(lambda g: SeveralBacklash().change(g, {}, context))(at)
    for k in range(2):
        going = -context.signal[:, k].diff().sign()
        inside = going[1:] == going[:-1]  # a reversal between two samples has no direction
        assert torch.equal(slope[2:, k, k][inside], going[1:][inside])
        assert not bool(slope[:, k, 1 - k].any())


def test_play_and_a_delay_have_the_residual_of_both_in_series():
    simulator, recording = arm()
    prepared = simulator.prepare(recording)
    model = JointModel(prepared, terms(prepared, "backlash", "delay"))
    expected = torch.stack([shifted(played(joint, TIME, 0.05), TIME, -0.13) for joint in JOINTS.values()], -1)
    parameters = torch.tensor([0.0, 0.0, 0.05, 0.05, 0.13, 0.13]).double()
    torch.testing.assert_close(prepared.measured - model.residual(parameters), expected, atol=1e-7, rtol=0)


def test_the_signal_of_an_effect_includes_the_previous_effects():
    simulator, recording = arm()
    prepared = simulator.prepare(recording)
    found, other = terms(prepared, "delay", "backlash")
    model = JointModel(prepared, [found])
    parameters = torch.tensor([0.0, 0.0, 0.5, 0.5]).double()
    plain = model.signals(parameters)["all outputs"]
    behind = model.signals_before(parameters, {other.key})["all outputs"]
    torch.testing.assert_close(behind, torch.stack([shifted(joint, TIME, -0.5) for joint in JOINTS.values()], -1))
    assert torch.equal(model.signals_before(parameters, {found.key})["all outputs"], plain)


def test_sag_is_tried_on_angles_only():
    def tried(units):
        simulator, recording = arm(**units)
        every = candidate_terms(simulator.prepare(recording), (), PAIRED)
        return {(t.effect.id, t.port) for t in every}

    sags = {("gravity_sag", place) for place in ("output pan", "output tilt", "all outputs")}
    assert sags <= tried({"pan": "rad", "tilt": "rad"})
    assert sags <= tried({})  # by their names
    assert tried({"pan": "rad", "tilt": "V"}) & sags == {("gravity_sag", "output pan")}
    assert not tried({"pan": "V", "tilt": "V"}) & sags
    assert ("backlash", "all outputs") not in tried({"pan": "rad", "tilt": "V"})  # the gaps would have no common unit


@pytest.mark.parametrize("port", ["output pan", "all outputs"])
def test_models_are_restored_from_json(port):
    simulator, recording = arm()
    prepared = simulator.prepare(recording)
    found = terms(prepared, "backlash", "offset", "delay", "gravity_sag", port=port)
    sizes = JointModel(prepared, found).sizes
    gammas = [torch.linspace(0.05, 0.1, size).double() for size in sizes]
    model = DiagnosedModel(prepared.name, prepared.state, torch.zeros(2).double(), found, gammas, simulator)
    again = DiagnosedModel.from_json(model.to_json(), simulation=simulator)
    for name, values in model.correct(recording)[0].items():
        assert torch.equal(again.correct(recording)[0][name], values)
        assert name == "time" or port != "all outputs" or not torch.equal(values, JOINTS[name])


class Drive(Dynamics):
    states, inputs = ("speed",), ("volt",)
    parameters = {"gain": 1.0}

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.volt - x.speed}


@pytest.mark.parametrize("order", [("input_lag", "input_square"), ("input_square", "input_lag")])
def test_a_lag_acts_before_the_square_in_any_order(order):
    volt = torch.where(TIME.remainder(4.0) < 2.0, 1.0, 0.25).double()
    prepared = Drive().prepare(Recording({"time": TIME, "volt": volt, "speed": torch.cos(TIME)}))
    shapes = {"input_lag": {"lag": 0.4}, "input_square": {"scale_of_input": 1.0}}
    effects = {effect.id: effect for effect in DYNAMICS}
    model = JointModel(prepared, [Term(effects[name], None, shapes[name], "input volt") for name in order])
    changes = model.changes(torch.tensor([1.0, 0.0, 1.0, 1.0]).double())
    clock = prepared.ports["input volt"].clock.time
    own = torch.where(clock.remainder(4.0) < 2.0, 1.0, 0.25).double().unsqueeze(-1)
    acting = own + changes["input volt"](own)
    torch.testing.assert_close(acting[:, 0], lagged(own[:, 0], clock, 0.4).square(), atol=1e-9, rtol=1e-9)
