"""A system without states: its outputs are functions of its inputs, and its effects act on inputs or outputs."""

import numpy as np
import pytest

from examples.blind_proof.draws import generator
from examples.blind_proof.equations.errors import Errors
from examples.blind_proof.equations.integrate import SystemScene, outputs_of_sizes, simulate
from examples.blind_proof.equations.oracle import names, oracle_rms, power, tangents
from examples.blind_proof.equations.plant import HiddenTerm
from examples.blind_proof.equations.rivals import readings
from examples.blind_proof.equations.systems.drives import SERVO, late, load


@pytest.fixture(scope="module")
def scene():
    setting = SERVO.draw(generator(4, "servo"))
    return SystemScene(setting.plant, setting.trial, simulate(setting.plant, setting.trial))


def errors_of(scene):
    return Errors((0.01 * float(scene.course.outputs.std()),), 0.0, "gaussian")


def test_the_angle_is_the_command_times_its_scale(scene):
    np.testing.assert_allclose(scene.course.outputs, scene.plant.parameters["scale"] * scene.trial.inputs, rtol=1e-12)
    tangent = tangents(scene, errors_of(scene), rivals=False).known
    expected = errors_of(scene).whitened(scene.trial.inputs)
    np.testing.assert_allclose(tangent[:, 0], expected, rtol=1e-6, atol=1e-9)


def test_a_shift_of_the_input_is_scaled_and_a_shift_of_the_output_is_not(scene):
    def shifted(values, step, size):
        return values + size

    at_input = HiddenTerm("offset", "", (), 1.0, inputs=shifted)
    at_output = HiddenTerm("offset", "", (), 1.0, outputs=shifted)
    scale = scene.plant.parameters["scale"]
    for hidden, factor in ((at_input, scale), (at_output, 1.0)):
        (found,) = outputs_of_sizes(scene.plant, scene.trial, hidden, np.array([0.5]))
        np.testing.assert_allclose(found - scene.course.outputs, 0.5 * factor, rtol=1e-9)


def test_forms_are_the_derivatives_of_the_effects_at_size_zero(scene):
    found = {(item.effect, item.at): item for item in readings(scene)}
    level = found["offset", ("angle",)].outputs
    np.testing.assert_array_equal(level, 1.0)
    sag = found["gravity_sag", ("angle",)].outputs
    hidden = load(generator(3), scene)
    (moved,) = outputs_of_sizes(scene.plant, scene.trial, hidden, np.array([1e-5]))
    change = ((moved - scene.course.outputs) / 1e-5).ravel()
    left = change - sag.reshape(-1, 2) @ np.linalg.lstsq(sag.reshape(-1, 2), change, rcond=None)[0]
    assert np.abs(left).max() < 1e-4


def test_names_of_effects_belong_to_the_angle_or_the_command(scene):
    known = names(scene)
    assert {"offset", "gravity_sag", "delay", "backlash", "output_saturation", "sensor_lag", "clock_drift"} <= {
        effect for effect, at in known if at == ("angle",)
    }
    assert {"input_delay", "input_lag", "backlash", "dead_zone", "input_square"} <= {
        effect for effect, at in known if at == ("input command",)
    }


def test_the_same_delay_of_the_command_is_inseparable_and_not_a_rival(scene):
    seen = power(scene.plant, scene.trial, late(generator(1), scene), 0.08, errors_of(scene))
    assert "input_delay" not in {rival.effect for rival in seen.rivals}
    assert "input_delay" in {rival.effect for rival in seen.larger}
    assert seen.z > 10.0


def test_the_oracle_residual_of_the_true_system_is_the_sensor_error(scene):
    errors = errors_of(scene)
    left = np.random.default_rng(1).standard_normal(scene.course.outputs.shape) * errors.deviations[0]
    hidden = load(generator(3), scene)
    good = np.ones(left.shape, dtype=bool)
    found = oracle_rms(scene.plant, scene.trial, hidden, 0.1, errors, left, good)
    assert found == pytest.approx(np.sqrt(np.square(left / errors.deviations[0]).mean()))
