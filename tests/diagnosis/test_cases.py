"""Diagnoses of recordings with known answers, real and simulated.

Slow cases are left out by default; run them with ``pytest -m slow tests/diagnosis``.
"""

import functools
import math

import pytest
import torch

from mkc_torch import Recording, diagnose
from mkc_torch.simulation import load_simulation
from tests.shared_data import shared_case, shared_real

LEFT_OUT, CONFIRMED = "left_out", ("left_out", "small")
INPUT, DRAG = "torque", ("linear_drag", "quadratic_drag", "power_law")

slow = pytest.mark.slow


@functools.cache
def diagnosed(recording, simulation, between=None):
    """Diagnose a case, cached."""
    path, (file, name) = shared_case(recording), simulation.split(":")
    system = load_simulation(f"{shared_case(file)}:{name}")
    if between is not None:
        system.input_hold = between
    return diagnose(system, Recording.read(path))


def pendulum(name, between=None):
    return diagnosed(f"simulated/{name}/run.csv", "simulated/naive.py:Pendulum", between)


def first_finding(diagnosis, effect, channel):
    """Return the first finding, which has to be this effect."""
    found = diagnosis.findings[0]
    assert (found.effect, found.channels) == (effect, (channel,))
    return found


def value(finding, name):
    (match,) = [parameter for parameter in finding.parameters if parameter.name == name]
    return match.value


def confirmed(diagnosis):
    return [finding.effect for finding in diagnosis.findings if finding.grade in CONFIRMED]


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("name", "between"),
    [
        ("held_input", None),
        ("linear_input", None),
        pytest.param("held_input", "linear", marks=slow),
        pytest.param("linear_input", "held", marks=slow),
    ],
)
def test_the_input_hold_is_found_and_is_no_finding(name, between):
    diagnosis = pendulum(name, between)
    assert (diagnosis.verdict, diagnosis.findings, diagnosis.environment.process_noise) == ("adequate", (), ())
    assert diagnosis.environment.input_hold == {INPUT: name.removesuffix("_input")}
    (angle,) = diagnosis.environment.goodness_of_fit
    assert angle.residual == pytest.approx(0.005, rel=0.1)


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("name", "size", "white"),
    [
        ("pushed_white", 0.5, True),
        pytest.param("pushed_slowly", 0.2, False, marks=slow),
        pytest.param("gusts", 0.5, False, marks=slow),
    ],
)
def test_an_unrecorded_disturbance_is_process_noise_and_no_finding(name, size, white):
    diagnosis = pendulum(name)
    assert diagnosis.verdict == "unexplained"
    assert confirmed(diagnosis) == []
    disturbance = diagnosis.environment.process_noise[0]
    assert (disturbance.place, disturbance.at_rate) == ("rate", True)
    assert size / 2.0 < disturbance.size < 2.0 * size
    assert 0.0 < disturbance.standard_error < disturbance.size
    course = diagnosis.environment.disturbance[0]
    assert course.value.shape == course.band.shape == course.time.shape == (750,)
    assert ("is white" in course.sentences[0]) is white
    assert f"uncorrelated with {INPUT}" in course.sentences[1]


@slow
@pytest.mark.parametrize("name", ["held_input", "linear_input", "pushed_slowly", "pushed_white", "gusts"])
def test_gravity_of_the_wrong_sign_is_unfit_and_named_without_process_noise(name):
    diagnosis = diagnosed(f"simulated/{name}/run.csv", "simulated/naive.py:UpsideDown")
    assert diagnosis.verdict == "unfit"
    assert diagnosis.findings == ()
    assert diagnosis.environment.reasons
    if name in ("held_input", "linear_input"):
        assert "`stiffness`" in diagnosis.environment.reasons[0]


@slow
def test_an_output_unrelated_to_the_input_is_unfit():
    diagnosis = pendulum("unrelated")
    assert diagnosis.verdict == "unfit"
    assert diagnosis.findings == ()
    assert diagnosis.environment.reasons
    (angle,) = diagnosis.environment.goodness_of_fit
    assert angle.explained < 0.5
    assert angle.residual > angle.rmse_of_last_value


@slow
def test_a_coasting_car_has_drag():
    diagnosis = diagnosed("coastdown/runs.csv", "coastdown/naive.py:Coast")
    assert diagnosis.verdict in ("explained", "unexplained")
    found = first_finding(diagnosis, diagnosis.findings[0].effect, "rate of speed")
    named = {found.effect, *(rival.effect for rival in found.alternatives if not rival.separable)}
    assert "quadratic_drag" in named
    assert found.effect in DRAG
    if found.effect == "quadratic_drag":
        assert 0.0003 < value(found, "drag") < 0.0007
    elif found.effect == "linear_drag":
        # at the mean speed, 5 m/s, it has the slope of the quadratic drag; rolling resistance explains the rest
        assert 0.0003 < value(found, "drag") / 10.0 < 0.0007


@slow
def test_natural_convection_is_a_power_law_and_not_radiation():
    diagnosis = diagnosed("heater/runs.csv", "heater/naive.py:Heater")
    assert diagnosis.verdict == "explained"
    found = first_finding(diagnosis, "power_law", "rate of temp")
    assert 1.4 < value(found, "exponent") < 1.6
    assert "thermal_loss" not in [finding.effect for finding in diagnosis.findings]
    assert "thermal_loss" not in [rival.effect for rival in found.alternatives if not rival.separable]
    after = found.held_out.outputs["temp"]
    assert (after.unit, after.after) == ("°C", pytest.approx(0.2, abs=0.1))
    assert after.before > 2.0


@slow
def test_ground_effect_is_a_curve_of_the_height():
    diagnosis = diagnosed("altitude/runs.csv", "altitude/naive.py:Altitude")
    found = first_finding(diagnosis, "unknown", "rate of climb")
    assert found.curve is not None
    assert found.curve.driver == "height"
    height = found.held_out.outputs["height"]
    assert (height.unit, height.after < 0.02 < 0.1 < height.before) == ("m", True)
    # strong near the ground, and little above it
    low, high = found.curve.x < 0.3, found.curve.x > 0.6
    size = found.curve.value[:, 0] - found.curve.value[high, 0].mean()
    assert float(size[low].max()) > 3.0 * float(size[high].abs().max())


@slow
def test_dry_friction_of_a_geared_motor_has_sizes_in_each_outputs_unit():
    diagnosis = diagnosed("gear_motor/runs.csv", "gear_motor/naive.py:GearMotor")
    found = first_finding(diagnosis, "stribeck_friction", "rate of speed")
    assert found.grade == LEFT_OUT
    sizes = found.held_out.outputs
    assert {name: size.unit for name, size in sizes.items()} == {"angle": "rad", "speed": "rad/s"}
    for size in sizes.values():
        assert 0.0 < size.after < size.before < math.inf
    assert sizes["angle"].before < 1.0
    assert sizes["speed"].before < 20.0
    assert [(fit.output, fit.unit) for fit in diagnosis.environment.goodness_of_fit] == [
        ("angle", "rad"),
        ("speed", "rad/s"),
    ]
    assert all(math.isfinite(parameter.value) for parameter in found.parameters)


@slow
def test_a_free_double_integrator_is_unfit_for_a_ball_on_a_beam():
    diagnosis = diagnosed("ball_beam/run.csv", "ball_beam/naive.py:Ball")
    assert diagnosis.verdict == "unfit"
    assert confirmed(diagnosis) == []
    assert diagnosis.environment.reasons
    (position,) = diagnosis.environment.goodness_of_fit
    assert position.unit == "m"
    assert 0.055 < position.residual < position.variation


@slow
def test_two_tanks_have_a_good_fit():
    diagnosis = diagnosed("tanks/fit.csv", "tanks/naive.py:Tanks")
    (level,) = diagnosis.environment.goodness_of_fit
    assert (level.unit, level.residual < 0.65) == ("V", True)
    assert level.explained > 0.9
    assert diagnosis.verdict in ("explained", "unexplained")


@slow
@pytest.mark.parametrize("name", ["stiff_240", "resonant_600"])
def test_a_load_on_a_flexible_shaft_is_a_hidden_mode(name):
    diagnosis = diagnosed(f"two_mass/{name}.csv", "two_mass/naive.py:Drive")
    assert diagnosis.verdict == "explained"
    found = first_finding(diagnosis, "hidden_mode", "rate of speed")
    assert found.grade == LEFT_OUT
    assert value(found, "share") == pytest.approx(0.849, abs=0.02)
    assert value(found, "period") == pytest.approx(0.2231, abs=0.001)


@functools.cache
def diagnosed_real(recording, simulation, begin=0, end=None, step=1):
    """Diagnose some rows of a real recording whose missing physics is known, cached."""
    path, (file, name) = shared_real(recording), simulation.split(":")
    whole = Recording.read(path)
    part = whole.rows(torch.arange(len(whole))[begin:end:step])
    return diagnose(load_simulation(f"{shared_real(file)}:{name}"), part)


@pytest.mark.slow
@pytest.mark.e2e
def test_a_coasting_rocket_has_quadratic_drag():
    diagnosis = diagnosed_real("rocket/juno.csv", "rocket/naive.py:Rocket")
    assert diagnosis.verdict == "explained"
    found = first_finding(diagnosis, "quadratic_drag", "rate of speed")
    assert found.grade == LEFT_OUT
    # by hand 9.2e-5 1/m
    assert value(found, "drag") == pytest.approx(9.2e-5, rel=0.15)


@pytest.mark.slow
@pytest.mark.e2e
def test_the_size_of_drag_belongs_to_a_gravity_within_its_bounds():
    # the air thins with height, so gravity ends at its lower bound; without it the drag would be 1.2e-4 1/m
    diagnosis = diagnosed_real("rocket/juno.csv", "rocket/naive.py:Rocket", begin=1, step=2)
    assert value(first_finding(diagnosis, "quadratic_drag", "rate of speed"), "drag") == pytest.approx(9.2e-5, rel=0.15)


@slow
def test_dry_friction_replaces_a_power_law_at_its_bound():
    diagnosis = diagnosed_real("pendulum_encoder/run.csv", "pendulum_encoder/naive.py:Pendulum", end=700)
    found = first_finding(diagnosis, "coulomb_friction", "rate of speed")
    assert value(found, "friction") == pytest.approx(0.206, rel=0.1)


@pytest.mark.slow
@pytest.mark.e2e
def test_a_mug_loses_heat_by_a_high_power():
    diagnosis = diagnosed_real("mug/run.csv", "mug/naive.py:Cooling")
    assert diagnosis.verdict == "explained"
    assert first_finding(diagnosis, "power_law", "rate of temp").grade == LEFT_OUT


@slow
def test_a_house_has_a_second_thermal_mass():
    diagnosis = diagnosed_real("house/house_2.csv", "house/naive.py:House")
    assert first_finding(diagnosis, "hidden_lag", "rate of indoor").grade == LEFT_OUT


@slow
def test_a_pendulum_on_a_shaft_has_dry_friction():
    diagnosis = diagnosed_real("pendulum_encoder/run.csv", "pendulum_encoder/naive.py:Pendulum")
    found = first_finding(diagnosis, "coulomb_friction", "rate of speed")
    assert found.grade == LEFT_OUT
    # by hand 0.206 rad/s²
    assert value(found, "friction") == pytest.approx(0.206, rel=0.1)
    assert "quadratic_drag" in confirmed(diagnosis)
