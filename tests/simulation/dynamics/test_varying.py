"""Parameters that effects make a function of time: the trajectory, its derivatives, and where it is possible."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from mkc_torch import Recording
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import DYNAMICS
from mkc_torch.nonlinear import load_forward_mode
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance
from mkc_torch.simulation.dynamics.varying import varying_parameters

N, STEP = 120, 0.1
TIME = STEP * np.arange(N)
COLUMN = 20.0 + 5.0 * np.sin(0.9 * TIME)
LOAD = 1.0 + np.sin(2.1 * TIME)
EFFECTS = {effect.id: effect for effect in DYNAMICS}


class Circuit(Dynamics):
    """Two resistances, in the rate and in the output; the drive acts by an actuator with a gain."""

    states, inputs, outputs = ("charge",), ("load",), ("voltage", "charge")
    parameters = {"decay": Parameter(0.5, lower=0.0, unit="1/s"), "resistance": 0.3, "gain": 1.2}

    def actuator(self, time, u, p, run):
        return {"load": p.gain * u.load}

    def derivative(self, time, x, u, p):
        return {"charge": u.load - p.decay * x.charge}

    def output(self, time, x, u, p):
        return {"voltage": x.charge + p.resistance * u.load, "charge": x.charge}


def recording(**columns):
    known = {"time": TIME, "load": LOAD, "voltage": np.cos(TIME), "charge": np.sin(TIME), "oven_temperature": COLUMN}
    return Recording({name: torch.as_tensor(values) for name, values in (known | columns).items()})


def terms_at(system, table, *ids):
    prepared = system.prepare(table)
    drivers = find_drivers(table, frozenset(system.columns), DriverSettings()).drivers
    return prepared, [term for term in candidate_terms(prepared, drivers, DYNAMICS) if term.effect.id in ids]


def exact(law):
    """Outputs by SciPy with parameters that depend on the column by a law."""

    def at(name, base, time):
        return base * law(np.interp(time, TIME, COLUMN)) if name == "varied" else base

    def simulated(varied):
        values = {"decay": 0.5, "resistance": 0.3, "gain": 1.2}

        def value(name, time):
            return at("varied" if name == varied else "", values[name], time)

        def rate(time, x):
            return value("gain", time) * np.interp(time, TIME, LOAD) - value("decay", time) * x

        charge = solve_ivp(rate, (0.0, TIME[-1]), [0.4], t_eval=TIME, rtol=1e-10, atol=1e-12, max_step=STEP).y[0]
        return np.stack([charge + value("resistance", TIME) * value("gain", TIME) * LOAD, charge], -1)

    return simulated


def linear(column):
    return 1.0 + 0.04 * (column - COLUMN.mean())


def parabola(column):
    away = column - COLUMN.mean()
    return 1.0 + 0.04 * away - 0.01 * away**2


def arrhenius(column):
    mean = COLUMN.mean() + 273.15
    return np.exp(-0.04 * mean**2 * (1.0 / (column + 273.15) - 1.0 / mean))


FORMS = {
    "driver_parameter": (linear, (0.04,)),
    "driver_parameter_quadratic": (parabola, (0.04, -0.01)),
    "driver_parameter_arrhenius": (arrhenius, (0.04,)),
}


@pytest.mark.parametrize("name", ["decay", "resistance", "gain"])
@pytest.mark.parametrize("form", list(FORMS))
def test_a_parameter_that_depends_on_a_column_equals_an_exact_integration(form, name):
    law, gamma = FORMS[form]
    prepared, terms = terms_at(Circuit(), recording(), form)
    (term,) = [term for term in terms if term.port == f"parameter {name}"]
    joint = JointModel(prepared, [term])
    theta = torch.tensor([0.5, 0.3, 1.2, 0.4, *gamma], dtype=torch.float64)
    simulated = prepared.simulated(theta[:4], joint.changes(theta))
    torch.testing.assert_close(simulated, torch.as_tensor(exact(law)(name)), rtol=0.0, atol=2e-4)
    compiled = joint._compiled
    assert compiled is not None
    answer = compiled.answer(theta)
    torch.testing.assert_close(answer.residual, prepared.measured - simulated, rtol=0.0, atol=1e-9)
    load_forward_mode()
    slopes = torch.func.jacfwd(lambda v: prepared.residual(v[:4], joint.changes(v), answer.nearby))(theta)
    torch.testing.assert_close(compiled.tangents(theta, answer.nearby)[0].movedim(0, -1), slopes, rtol=0.0, atol=1e-8)


EXPORTED = (*FORMS, "driver_output", "driver_output_quadratic", "driver_output_lagged", "input_transport_delay")


@pytest.mark.parametrize("form", EXPORTED)
def test_the_exported_class_has_the_residual_of_the_model(form):
    table = recording(flow=2.0 + np.cos(0.7 * TIME))
    prepared, terms = terms_at(Circuit(), table, form)
    by_port = {term.port: term for term in terms}  # the last shape of each
    joint = JointModel(prepared, list(by_port.values()))
    theta = torch.tensor([0.45, 0.3, 1.1, 0.2], dtype=torch.float64)
    gammas = [torch.linspace(0.02, 0.01, size, dtype=torch.float64) for size in joint.sizes]
    model = DiagnosedModel("Circuit", prepared.state, theta, list(by_port.values()), gammas, Circuit())
    text, known = model.to_python("known"), {"Circuit": Circuit}
    exec(text.replace("from known import Circuit", ""), known)
    again = known["CorrectedCircuit"]().prepare(table)
    with_it = joint.residual(torch.cat([theta, *gammas]))
    torch.testing.assert_close(again.residual(theta, {}), with_it, rtol=0.0, atol=1e-7)
    assert float((with_it - prepared.residual(theta, {})).abs().max()) > 1e-3


def test_an_observer_predicts_with_the_changed_parameters_and_outputs():
    """Innovations of a simulation that follows its recording are its residual, whatever the observer's gain."""
    prepared, terms = terms_at(Circuit(), recording(), "driver_parameter", "driver_output")
    joint = JointModel(prepared, terms)
    theta = torch.tensor([0.5, 0.3, 1.2, 0.4, *[0.02] * len(terms)], dtype=torch.float64)
    changes = joint.changes(theta)
    truth = prepared.simulated(theta[:4], changes)
    columns = dict(zip(("voltage", "charge"), truth.T.numpy(), strict=True))
    exactly = Circuit().prepare(recording(**columns))
    sensor = theta.new_tensor([0.1, 0.1])
    along, noise = flow_of(exactly, theta[:4], changes, None), (Disturbance("charge", True, 0.0, 0.3),)
    observed = exactly.observed(observer_of(along, noise, sensor, exactly.disturbable, exactly.channels))
    assert float(observed.residual(theta[:4], changes).abs().max()) < 1e-6
    assert float(observed.residual(theta[:4], {}).abs().max()) > 1e-2


class Delicate(Circuit):
    """Its functions need three of the parameters as numbers: a condition, an index, and the sensor."""

    parameters = {**Circuit.parameters, "switch": 1.0, "order": 2.0, "offset": 0.1}

    def derivative(self, time, x, u, p):
        drive = u.load if p.switch > 0 else 0.0 * u.load
        return {"charge": drive - p.decay * x.charge ** int(p.order)}

    def sensor(self, time, y, p, run):
        return {**y, "voltage": y["voltage"] + p.offset}


def test_parameters_that_are_needed_as_numbers_have_no_port():
    assert varying_parameters(Circuit()) == ("decay", "resistance", "gain")
    assert varying_parameters(Delicate()) == ("decay", "resistance", "gain")


def test_arrhenius_law_is_tried_for_temperatures_only():
    _, terms = terms_at(Circuit(), recording(humidity=np.cos(0.3 * TIME)), "driver_parameter_arrhenius")
    assert {term.columns for term in terms} == {("oven_temperature",)}


@pytest.mark.parametrize(("unit", "zero"), [("°C", 273.15), ("", 273.15), ("K", 0.0)])
def test_arrhenius_law_uses_the_absolute_temperature(unit, zero):
    prepared, (term, *_) = terms_at(Circuit(), recording(), "driver_parameter_arrhenius")
    signal = torch.full((len(prepared.clock.time), 1), 2.0, dtype=torch.float64)
    context = replace(term, driver=replace(term.driver, units=(unit,))).context(prepared, signal)
    change = term.effect.change(torch.tensor([0.03], dtype=torch.float64), {}, context)
    column, mean = np.interp(prepared.clock.time, TIME, COLUMN) + zero, COLUMN.mean() + zero
    expected = 2.0 * (np.exp(-0.03 * mean**2 * (1.0 / column - 1.0 / mean)) - 1.0)
    torch.testing.assert_close(change[:, 0], torch.as_tensor(expected), rtol=1e-9, atol=1e-9)


def test_the_explanation_has_the_size_the_parameter_and_the_column():
    prepared, terms = terms_at(Circuit(), recording(), "driver_parameter")
    text = terms[0].effect.explained([0.0123], {}, terms[0].context(prepared, None))
    assert text == "`decay` changes by 1.23 % per unit with `oven_temperature`."
