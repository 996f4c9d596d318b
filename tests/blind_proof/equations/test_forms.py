"""Hidden forms: the physics of the catalogue by other formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples.blind_proof.draws import generator
from examples.blind_proof.equations import flows, forces, transducers
from examples.blind_proof.equations.forces import bristles, rubber, teeth
from examples.blind_proof.equations.integrate import SystemScene, outputs_of_sizes, simulate
from examples.blind_proof.equations.oracle import can_be_named, names
from examples.blind_proof.equations.plant import RunSet
from examples.blind_proof.equations.systems import SYSTEMS
from mkc_torch.effects import DYNAMICS, PAIRED


@pytest.fixture(scope="module", params=SYSTEMS)
def case(request):
    setting = SYSTEMS[request.param].draw(generator(2, request.param))
    trial = RunSet(setting.trial.step, setting.trial.inputs[:, :80], setting.trial.begin)
    return SYSTEMS[request.param], SystemScene(setting.plant, trial, simulate(setting.plant, trial))


def added_rates(form, x, z=None, size=1.0):
    """Return what a form adds to the rates (n,) at states (n,)."""
    x = np.array(x, dtype=float)[:, None]
    z = np.zeros((1, 1)) if z is None else np.array(z, dtype=float)[:, None]
    return form(x, z, np.zeros((0, 1)), np.zeros_like(x), np.array([size]))[0][:, 0]


def share_outside_a_line(form, low, high, row=0, basis=()):
    """Return the share of a form's variation that a straight line and other columns do not explain."""
    x = np.linspace(low, high, 200)
    y = np.array([added_rates(form, [v])[row] for v in x])
    columns = np.stack([np.ones_like(x), *(item(x) for item in basis)], -1)
    left = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
    return np.square(left).sum() / np.square(y - y.mean()).sum()


def test_hidden_effects_have_names_of_the_catalogue(case):
    system, scene = case
    known = {effect.id for effect in (*DYNAMICS, *PAIRED)}
    for k, draw in enumerate(system.inside):
        assert draw(generator(k), scene).effect in known
    assert all(draw(generator(0), scene).effect not in known for draw in system.outside)


def test_hidden_effects_can_be_named_except_those_that_need_a_suitable_recording(case):
    system, scene = case
    hidden = [draw(generator(k), scene) for k, draw in enumerate(system.inside)]
    known = names(scene)
    unseen = {item.effect for item in hidden if not can_be_named(item, known)}
    assert unseen <= {"coulomb_friction", "stribeck_friction", "load_dependent_friction", "cubic_stiffness",
                      "bouc_wen_hysteresis"}  # fmt: skip
    assert not any(can_be_named(draw(generator(0), scene), known) for draw in system.outside)


NEVER_HIDDEN = {
    "added_mass": "every plant's own parameters scale all its forces, or there is none but gravity",
    "buoyancy": "no plant has a height of either sign",
    "gain": "the joint's scale is fitted",
    "input_rate_limit": "no plant has an actuator of its own speed; `tests.diagnosis.test_rate_limit` hides it",
    "constant_change": "no plant steps; `tests.simulation.stepped.test_constants` hides it",
    "clock_drift": "no plant has a clock of its own",
    "sensor_clock_drift": "as for clocks of paired data; `tests.diagnosis.test_clocks` hides it",
    "driver_linear": "no plant has a driver that is recorded and is no input",
    "driver_quadratic": "as for the linear one",
    "driver_gain": "as for the linear one",
    "driver_friction": "as for the linear one",
    "driver_bouc_wen": "as for the linear one",
    "driver_dahl": "as for the linear one",
    "driver_pair": "as for the linear one",
    "driver_force": "as for the linear one; hidden by `tests.gate.recorded_causes`",
    "driver_exchange": "as for the force",
    "driver_rate_constant": "as for the force",
    "driver_input_gain": "as for the force",
    "driver_output": "as for the linear one",
    "driver_output_lagged": "as for the linear one",
    "driver_output_quadratic": "as for the linear one",
    "periodic": "no plant has a period of its own but those of its inputs",
    "periodic_output": "as for the periodic disturbance of a paired output",
    "periodic_rate": "as for the periodic disturbance of a paired output",
    "driver_parameter": "as for the linear one",
    "driver_parameter_arrhenius": "as for the linear one",
    "driver_parameter_quadratic": "as for the linear one",
    "input_transport_delay": "no plant has a pipe",
    "gain_drift": "no plant's sensor ages",
}
"""Effects of the catalogue that no plant could show, and why."""


def test_every_effect_that_a_plant_can_have_is_hidden():
    hidden = set()
    for name, system in SYSTEMS.items():
        setting = system.draw(generator(2, name))
        trial = RunSet(setting.trial.step, setting.trial.inputs[:, :20], setting.trial.begin)
        scene = SystemScene(setting.plant, trial, simulate(setting.plant, trial))
        hidden |= {draw(generator(0), scene).effect for draw in system.inside}
    known = {effect.id for effect in (*DYNAMICS, *PAIRED) if not effect.is_curve}
    assert known - hidden == set(NEVER_HIDDEN)
    assert hidden <= known


def test_the_change_of_the_outputs_grows_with_the_size_of_an_effect(case):
    system, scene = case
    for k, draw in enumerate((*system.inside, *system.outside)):
        hidden = draw(generator(k), scene)
        small, large = (
            np.abs(outputs - scene.course.outputs).max()
            for outputs in outputs_of_sizes(scene.plant, scene.trial, hidden, hidden.large * np.array([0.2, 0.6]))
        )
        assert 0.0 < small < large < np.inf


def test_hidden_forms_differ_from_the_formulas_of_the_catalogue():
    assert share_outside_a_line(forces.sphere_drag(0, 1.0, 1e3), -3, 3, basis=[lambda x: x * np.abs(x)]) > 1e-4
    assert share_outside_a_line(flows.weir(0, 0.5, 1.5), 0, 1, basis=[lambda x: np.maximum(x - 0.5, 0)]) > 1e-3
    assert share_outside_a_line(flows.radiation(0, 20.0, 5e-4), 20, 150, basis=[lambda x: (x + 273.15) ** 4]) > 1e-5
    assert share_outside_a_line(flows.seepage(0, 1.0), 0, 2, basis=[lambda x: x]) > 1e-3

    def spring(x, z, u, known, size):
        return forces.hardening(0, 0, 1.0)(x, z, u, known, size)

    assert share_outside_a_line(spring, -1.2, 1.2, basis=[lambda x: x, lambda x: x**3]) > 1e-6


def test_bristle_friction_is_elastic_before_it_slides():
    form = bristles(0, 0.01, 1.0)
    assert added_rates(form, [1.0], z=[0.0])[0] == pytest.approx(-0.02)
    assert added_rates(form, [1.0], z=[0.01])[0] == pytest.approx(-1.0)
    known = np.zeros((1, 1))
    _, inner = form(np.array([[2.0]]), np.array([[0.01]]), np.zeros((0, 1)), known, np.ones(1))
    assert inner[0, 0] == pytest.approx(0.0)  # at rest where they slide


def test_bristle_friction_rises_towards_zero_speed():
    form = bristles(0, 0.01, 1.0, rise=2.0)
    _, slow = form(np.array([[1e-6]]), np.array([[0.01]]), np.zeros((0, 1)), np.zeros((1, 1)), np.ones(1))
    assert slow[0, 0] > 0.0  # they wind up further than without a rise


def test_gear_friction_grows_with_the_load():
    form = teeth(0, 0.01, 1, 1.0)
    light, heavy = (added_rates(form, [1.0, load], z=[0.01])[0] for load in (0.0, 2.0))
    assert light == pytest.approx(-0.3)
    assert heavy == pytest.approx(-2.3)


@given(st.floats(-5, 5), st.floats(-5, 5))
def test_drag_in_flight_is_along_the_velocity(item, other):
    pull = added_rates(forces.flight_drag((0, 1), 2.0, 1e4), [item, other])
    assert pull[0] * other == pytest.approx(pull[1] * item, abs=1e-9)
    assert pull @ [item, other] <= 0.0


@given(st.floats(0.01, 3.0), st.floats(-3, 3))
def test_contact_dissipates_energy_and_only_repels(depth, speed):
    form = forces.contact(1, 0, 1.0, (1.0, -1.0))
    force = added_rates(form, [1.0 + depth, speed])[1]
    assert force <= 0.0
    assert added_rates(form, [-1.0 - depth, -speed])[1] == pytest.approx(-force)
    assert added_rates(form, [0.5, speed])[1] == 0.0
    assert added_rates(form, [1.0 + depth, abs(speed)])[1] <= added_rates(form, [1.0 + depth, -abs(speed)])[1]


@given(st.floats(0, 50), st.floats(0, 5))
def test_forchheimer_solves_its_equation(head, bend):
    flow = flows.forchheimer(np.array(head), bend)
    assert flow + bend * flow**2 == pytest.approx(head, abs=1e-9)


def test_exchange_flows_from_the_higher_to_the_lower_state():
    form = flows.exchange(0, 1, lambda head: head, 0.5)
    assert added_rates(form, [1.0, 3.0]).tolist() == [2.0, -1.0]


def test_a_lagged_ramp_equals_the_exact_solution():
    time = np.arange(400) * 0.01
    ramp = time[None, :, None]
    behind = transducers.lagged(ramp, 0.01, 0.2)[0, :, 0]
    np.testing.assert_allclose(behind, time - 0.2 * (1.0 - np.exp(-time / 0.2)), atol=1e-12)
    total = transducers.lags(4)(ramp, 0.01, 0.2)[0, -1, 0]
    assert total == pytest.approx(time[-1] - 0.2, abs=1e-6)


def test_transport_delays_a_signal():
    values = np.sin(np.arange(100) * 0.1)[None, :, None]
    np.testing.assert_allclose(transducers.transport(values, 0.1, 0.5)[0, 5:, 0], values[0, :-5, 0])
    np.testing.assert_allclose(transducers.transport(values, 0.1, 0.0), values)


@given(st.floats(-10, 10))
def test_soft_actuators_are_odd_and_reduce_the_command(u):
    values = np.array([[[u]]])
    for change in (transducers.soft_limit(10.0, 6.0), transducers.soft_gap(10.0)):
        found = change(values, 0.1, 0.3).item()
        assert abs(found) <= abs(u) + 1e-12
        assert change(-values, 0.1, 0.3).item() == pytest.approx(-found)
    assert abs(transducers.soft_limit(10.0, 6.0)(values, 0.1, 2.0).item()) <= 5.0


def test_a_worn_linkage_depends_on_the_direction_of_motion():
    up_and_down = np.concatenate([np.linspace(0, 10, 50), np.linspace(10, 0, 50)])[None, :, None]
    found = transducers.worn_linkage(10.0)(up_and_down, 0.1, 0.1)[0, :, 0]
    assert found[25] < up_and_down[0, 25, 0]
    assert found[75] > up_and_down[0, 75, 0]


def test_rubber_is_elastic_at_first_and_then_yields():
    form = rubber(0, (0.5, 1.0))
    v, none = np.array([[1.0]]), np.zeros((0, 1))
    _, fresh = form(v, np.zeros((2, 1)), none, np.zeros((1, 1)), np.ones(1))
    _, yielded = form(v, np.array([[0.5], [1.0]]), none, np.zeros((1, 1)), np.ones(1))
    assert fresh[:, 0].tolist() == [1.0, 1.0]
    assert yielded[:, 0].tolist() == [0.0, 0.0]


def test_only_changes_a_single_channel():
    values = np.ones((2, 5, 1))
    found = transducers.only(1, transducers.soft_gap(1.0))(values, 0.1, 0.5)
    np.testing.assert_array_equal(found[0], values[0])
    assert (found[1] < 1.0).all()


def test_a_follower_is_behind_a_ramp_by_its_lag():
    ramp = (np.arange(1000) * 0.01)[None, :, None]
    behind = ramp - transducers.follower(ramp, 0.01, 0.12)
    assert behind[0, -1, 0] == pytest.approx(0.13, abs=1e-6)


@given(st.floats(-5, 5))
def test_a_squared_actuator_is_odd_and_exact_at_the_largest_command(u):
    change = transducers.squared(5.0, 2.0)
    values = np.array([[[u], [5.0]]])
    found = change(values, 0.1, 1.0)
    assert found[0, 0, 0] == pytest.approx(u * abs(u) / 5.0)
    assert found[0, 1, 0] == pytest.approx(5.0)
    np.testing.assert_allclose(change(-values, 0.1, 1.0), -found)
    np.testing.assert_allclose(change(values, 0.1, 0.0), values)


def test_a_worn_gear_is_constant_after_a_reversal_and_then_lags_by_its_gap():
    there = np.concatenate([np.linspace(0, 10, 101), np.linspace(10, 0, 101)])[None, :, None]
    found = transducers.worn_gear(there, 0.1, 1.0)[0, :, 0]
    assert found[80] == pytest.approx(there[0, 80, 0] - 1.0)
    assert found[105] == pytest.approx(found[100])
    assert found[180] == pytest.approx(there[0, 180, 0] + 1.0)


@given(st.floats(-2, 2), st.floats(0, 0.3), st.floats(-0.5, 0.5))
def test_the_sag_of_a_joint_is_that_at_its_resulting_angle(command, size, level):
    angle = transducers.sagging(level)(np.array([[[command]]]), 0.1, size).item()
    assert angle == pytest.approx(command + size * np.cos(angle - level), abs=1e-9)


def test_a_wrong_zero_is_an_offset_up_to_a_small_share():
    angles = np.linspace(-2.0, 2.0, 300)[None, :, None]
    off = transducers.wrong_zero(0.1, 0.5)(angles, 0.01, 0.2) - angles
    assert 0.179 < off.min() < 0.185
    assert 0.215 < off.max() < 0.221


def test_evaporation_and_convection_vanish_at_the_ambient_temperature():
    for form in (flows.evaporation(0, 20.0, 90.0), flows.natural_convection(0, 20.0, 90.0, 1.3)):
        assert added_rates(form, [20.0])[0] == pytest.approx(0.0)
        assert added_rates(form, [90.0])[0] == pytest.approx(-1.0)
        assert added_rates(form, [10.0])[0] > 0.0
    warm, hot = (added_rates(flows.evaporation(0, 20.0, 90.0), [t])[0] for t in (40.0, 80.0))
    assert hot < 4.0 * warm  # faster than by the excess


def test_outflow_through_a_slot_is_a_power_of_the_level():
    form = flows.slot(0, 2.0, 2.5, 0.0)
    assert added_rates(form, [2.0])[0] == pytest.approx(-1.0)
    assert added_rates(form, [1.0])[0] == pytest.approx(-(0.5**2.5))
    assert added_rates(form, [-1.0])[0] == 0.0


@given(st.floats(-3, 3))
def test_a_felt_spring_is_odd_and_restoring(x):
    form = forces.felt(1, 0, 1.0, 2.0)
    pull = added_rates(form, [x, 0.0])[1]
    assert pull * x <= 0.0
    assert added_rates(form, [-x, 0.0])[1] == pytest.approx(-pull)
    assert abs(pull) <= x * x + 0.1 * abs(x) + 1e-12
