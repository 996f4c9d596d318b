"""The exported Python of each effect computes the same as the effect."""

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.io.python_source import SourceError
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import Term, find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.base import Effect
from mkc_torch.effects.dynamics.thermal_loss import ThermalLoss
from mkc_torch.simulation import Dynamics


class Vessel(Dynamics):
    states = ("level",)
    parameters = {"drain": 0.5}

    def derivative(self, time, x, u, p):
        return (-p.drain * x.level,)


def model(effect, source):
    theta, gamma = torch.tensor([0.25, 1.0]).double(), torch.tensor([0.125]).double()
    return DiagnosedModel("Vessel", {}, theta, [Term(effect, None, {}, "rate of level")], [gamma], source)


def test_the_exported_class_is_short_and_names_its_base_and_effects():
    text = model(ThermalLoss(), Vessel()).to_python("vessels")
    assert text.count("\n") < 30
    for line in (
        "from vessels import Vessel",
        '"drain": 0.25,',
        "# thermal_loss: δṪ",
        "class CorrectedVessel(Vessel):",
    ):
        assert line in text
    compile(text, "corrected.py", "exec")


def test_models_without_source_and_effects_without_code_are_refused():
    with pytest.raises(SourceError, match="give its simulation with `simulation=`"):
        model(ThermalLoss(), None).to_python()

    class Silent(ThermalLoss):
        id = "silent"
        code = Effect.code

    with pytest.raises(SourceError, match="silent cannot be exported as Python: it has no `code` method"):
        model(Silent(), Vessel()).to_python()


class Cart(Dynamics):
    """A system that every tested effect can act on: driven by a known force, and free to move across it."""

    states = ("height", "side", "speed", "drift")
    inputs = ("force",)
    parameters = {"damping": 0.3}
    units = {"height": "m", "side": "m", "speed": "m/s", "drift": "m/s", "force": "m/s²"}
    step = 0.05

    def derivative(self, time, x, u, p):
        return [x.speed, x.drift, u.force - 4.0 * x.height - p.damping * x.speed, -3.0 * x.side - 0.2 * x.drift]


PLACES = {
    "backlash": ("input force", {"half_gap": 0.3}),
    "bouc_wen_hysteresis": ("hysteretic rate of speed", {"yield_deflection": 0.2}),
    "hidden_lag": ("lagged rate of drift", {"time_constant": 0.3}),
    "hidden_mode": ("resonant rate of speed", {"period": 0.8, "damping": 0.05}),
    "added_mass": ("rate of speed", {}),
    "load_dependent_friction": ("loaded rate of speed", {"width": 0.05}),
    "buoyancy": ("rate of speed", {"surface": 0.1, "draught": 0.3}),
    "magnus_lift": ("exchange of speed and drift", {}),
    "input_square": ("input force", {"scale_of_input": 2.5}),
    "input_delay": ("input force", {"delay": 0.23}),
    "input_lag": ("input force", {"lag": 0.2}),
    "sensor_lag": ("output", {"lag": 0.17}),
    "sensor_clock_drift": ("output", {"tried_rate": 0.5}),
}


def carts():
    """Return a recording of two independent runs on a single continuous clock."""
    time = torch.arange(120, dtype=torch.float64) * 0.05
    half = torch.arange(2).repeat_interleave(60).double()
    force = torch.where(half == 0, 1.5 + torch.sin(3.0 * time), torch.cos(4.0 * time) - 1.0)
    columns = {"time": time, "force": force, "height": 0.3 * torch.sin(2.0 * time), "side": 0.2 * torch.cos(time)}
    return Recording({**columns, "experiment": half})


@pytest.mark.parametrize("names", [(name,) for name in PLACES] + [tuple(PLACES)], ids="+".join)
def test_the_exported_class_has_the_residual_of_the_model(names):
    effects = {effect.id: effect for effect in DYNAMICS}
    recording = carts()
    prepared = Cart().prepare(recording)
    terms = [Term(effects[name], None, PLACES[name][1], PLACES[name][0]) for name in names]
    joint = JointModel(prepared, terms)
    theta = torch.tensor([0.25, 0.3, 0.2, 0.1, 0.0, -0.1, 0.2, 0.0, 0.3], dtype=torch.float64)
    gammas = [torch.full((size,), 0.4, dtype=torch.float64) for size in joint.sizes]
    text = DiagnosedModel("Cart", prepared.state, theta, terms, gammas, Cart()).to_python("carts")
    compile(text, "corrected.py", "exec")
    known = {"Cart": Cart}
    exec(text.replace("from carts import Cart", ""), known)
    again = known["CorrectedCart"]().prepare(recording)
    starts = theta[1:].unflatten(0, (2, 4))
    like = {"lagged_drift": 3, "hidden_speed": 2}
    inner = again.system.states[4:]
    memory = [starts[:, like[name]] if name in like else starts.new_zeros(2) for name in inner]
    memory = torch.stack(memory, -1) if memory else starts.new_zeros(2, 0)
    for name in set(inner) & set(like):  # begun about where the runs of the recording begin
        assert again.system.initial[name] == pytest.approx(float(starts[:, like[name]].mean()))
    whole = torch.cat([theta[:1], torch.cat([starts, memory], -1).flatten()])
    with_it = joint.residual(torch.cat([theta, *gammas]))
    torch.testing.assert_close(again.residual(whole, {}), with_it, rtol=0.0, atol=1e-7)
    assert float((with_it - prepared.residual(theta, {})).abs().max()) > 1e-3


class Heater(Dynamics):
    states, inputs = ("temp",), ("power", "outside")
    parameters = {"loss": 0.1}
    units = {"temp": "°C"}
    step = 0.05

    def derivative(self, time, x, u, p):
        return {"temp": u.power - p.loss * (x.temp - u.outside)}


@pytest.mark.parametrize("place", range(6))
def test_forms_with_and_without_surroundings_are_restored_from_files_and_exported(place):
    time = torch.arange(80, dtype=torch.float64) * 0.1
    columns = {"time": time, "power": 3.0 + torch.sin(time), "outside": 5.0 + time.cos(), "temp": 20.0 + time}
    prepared = Heater().prepare(Recording(columns))
    forms = [t for t in candidate_terms(prepared, (), DYNAMICS) if t.port == "rate of temp"]
    forms = {(t.effect.id, tuple(t.shape)): t for t in forms if t.effect.id != "constant_force"}
    assert len(forms) == 6  # a body radiates to its surroundings where they are known
    term = list(forms.values())[place]
    joint = JointModel(prepared, (term,))
    theta, gamma = torch.tensor([0.2, 20.0]).double(), torch.full((joint.sizes[0],), 0.02).double()
    model = DiagnosedModel("Heater", prepared.state, theta, [term], [gamma], Heater())
    (again,) = DiagnosedModel.from_json(model.to_json(), simulation=Heater()).terms
    assert again.effect is term.effect
    known = {"Heater": Heater}
    exec(model.to_python("heaters").replace("from heaters import Heater", ""), known)
    written = known["CorrectedHeater"]().prepare(Recording(columns)).residual(theta, {})
    with_it = joint.residual(torch.cat([theta, gamma]))
    torch.testing.assert_close(written, with_it, rtol=0.0, atol=1e-6)
    assert float((with_it - prepared.residual(theta, {})).abs().max()) > 1e-3


def driven_heater():
    """Return a heater's recording with a sun and a cellar's temperature that the heater does not use."""
    time = torch.arange(80, dtype=torch.float64) * 0.1
    columns = {"time": time, "power": 3.0 + torch.sin(time), "outside": 5.0 + time.cos(), "temp": 20.0 + time}
    columns |= {"sun": 4.0 + torch.cos(2.0 * time), "temperature_cellar": 281.0 + torch.sin(0.5 * time)}
    return Recording(columns, units={"temp": "°C", "temperature_cellar": "K"})


DRIVEN = ("driver_force", "driver_exchange", "driver_rate_constant", "driver_input_gain")


@pytest.mark.parametrize("effect_id", DRIVEN)
def test_effects_of_columns_are_restored_from_files_and_exported_with_the_column_as_an_input(effect_id):
    recording = driven_heater()
    prepared = Heater().prepare(recording)
    drivers = find_drivers(recording, frozenset(Heater().columns), DriverSettings()).drivers
    forms = [term for term in candidate_terms(prepared, drivers, DYNAMICS) if term.effect.id == effect_id]
    assert forms
    for term in forms:
        joint = JointModel(prepared, (term,))
        theta, gamma = torch.tensor([0.2, 20.0]).double(), torch.full((1,), 0.02).double()
        model = DiagnosedModel("Heater", prepared.state, theta, [term], [gamma], Heater())
        with_it = joint.residual(torch.cat([theta, gamma]))
        again = DiagnosedModel.from_json(model.to_json(), simulation=Heater())
        assert again.terms[0].effect is term.effect
        known = {"Heater": Heater}
        exec(model.to_python("heaters").replace("from heaters import Heater", ""), known)
        corrected = known["CorrectedHeater"]()
        assert corrected.inputs == ("power", "outside", *term.columns)
        torch.testing.assert_close(corrected.prepare(recording).residual(theta, {}), with_it, rtol=0.0, atol=1e-6)
        assert float((with_it - prepared.residual(theta, {})).abs().max()) > 1e-3


def test_a_column_whose_name_is_no_name_in_python_is_refused():
    recording = driven_heater()
    recording = Recording({**{name: recording[name] for name in recording.names}, "sun 2": recording["sun"].square()})
    prepared = Heater().prepare(recording)
    drivers = find_drivers(recording, frozenset(Heater().columns), DriverSettings()).drivers
    (term,) = (
        term
        for term in candidate_terms(prepared, drivers, DYNAMICS)
        if (term.effect.id, term.columns) == ("driver_force", ("sun 2",))
    )
    theta, gamma = torch.tensor([0.2, 20.0]).double(), torch.full((1,), 0.02).double()
    model = DiagnosedModel("Heater", prepared.state, theta, [term], [gamma], Heater())
    with pytest.raises(SourceError, match=r"'sun 2'.*rename"):
        model.to_python("heaters")


def test_what_inputs_do_between_samples_comes_back_from_files():
    time = torch.arange(80, dtype=torch.float64) * 0.1
    columns = {"time": time, "power": (2.0 * time).sin().sign(), "outside": 5.0 + time.cos(), "temp": 20.0 + time}
    theta = torch.tensor([0.2, 20.0]).double()
    held = Heater().prepare(Recording(columns)).with_input_hold({"power": "held", "outside": "held"})
    columns["temp"] = columns["temp"] - held.residual(theta, {})[:, 0]
    recording = Recording(columns)
    model = DiagnosedModel("Heater", held.state, theta, [], [], Heater())
    again = DiagnosedModel.from_json(model.to_json(), simulation=Heater())
    torch.testing.assert_close(again.correct(recording)[0]["temp"], columns["temp"], rtol=0.0, atol=1e-6)
    known = {"Heater": Heater}
    exec(model.to_python("heaters").replace("from heaters import Heater", ""), known)
    written = known["CorrectedHeater"]().prepare(recording).residual(theta, {})
    assert float(written.abs().max()) < 1e-6
    assert float(Heater().prepare(recording).residual(theta, {}).abs().max()) > 1e-2
