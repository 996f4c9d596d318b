import dataclasses
import math

import pytest
import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.magnetometer.cases import draw_scene
from examples.blind_proof.magnetometer.families import (
    column_family,
    cubic_family,
    drift_families,
    families,
    step_family,
)
from examples.blind_proof.magnetometer.hidden import CATALOGUE
from examples.blind_proof.magnetometer.noise import KINDS, draw_noise
from examples.blind_proof.magnetometer.power import Metric, Question, attitude_gains, powers, range_of
from examples.blind_proof.magnetometer.rotation import from_vector, product
from tests.blind_proof.magnetometer.dense import dense_covariance

SHARE = 0.1


@pytest.fixture(scope="module")
def scene():
    return draw_scene(generator(0), 6.0)


def noise_of(kind):
    return next(n for k in range(200) if (n := draw_noise(generator(1, k), 300, 50.0)).kind == kind)


def dense_z(metric, trace, family):
    """Return z and z_sep by the dense covariance."""
    gains, processes = metric.coloured()
    root = torch.linalg.cholesky(dense_covariance(metric.white_variance(), gains, processes))

    def white(columns):
        return torch.linalg.solve_triangular(root, columns.reshape(-1, columns.shape[-1]), upper=False)

    target, found = white(metric.residual(trace[..., None])), []
    for out in (metric.nuisance(), torch.cat([metric.nuisance(), metric.residual(family.traces)], -1)):
        basis = range_of(white(out / out.norm(dim=(0, 1))))
        found.append(math.sqrt(1 - SHARE) * float((target - basis @ (basis.mT @ target)).norm()))
    return found


@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_z_agrees_with_the_dense_covariance(kind, vector, scene):
    metric = Metric(scene, noise_of(kind), vector)
    trace = CATALOGUE["hard_iron_step"](generator(2), scene).trace(scene)
    rival = column_family("temperature", scene.temperature)
    power = powers(metric, [Question(trace, [rival])], SHARE)[0]
    assert [power.z, power.rivals[0].z_sep] == pytest.approx(dense_z(metric, trace, rival), rel=1e-6)


def test_z_is_proportional_to_the_size(scene):
    metric = Metric(scene, noise_of("white"), False)
    trace = CATALOGUE["current_field"](generator(3), scene).trace(scene)
    known = families(scene, {"time": scene.time, "temperature": scene.temperature}, vector=False)
    item, three = (powers(metric, [Question(size * trace, known)], 0.0)[0] for size in (1.0, 3.0))
    assert three.z == pytest.approx(3.0 * item.z)
    assert item.scaled(3.0).z_sep == pytest.approx(three.z_sep)
    assert item.z_sep <= item.z
    assert item.rivals[0].z_sep == min(rival.z_sep for rival in item.rivals)


def test_coefficients_are_exact_for_a_linear_effect(scene):
    metric = Metric(scene, noise_of("ar1"), False)
    own = column_family("current", scene.current)
    k = torch.tensor([0.1, -0.2, 0.3]).double()
    power = powers(metric, [Question(own.traces @ k, [], own)], 0.0)[0]
    assert power.coefficients == pytest.approx(k.tolist(), rel=1e-6)
    assert power.missed < 1e-4 * power.z


def test_an_effect_that_the_calibration_absorbs_has_zero_z(scene):
    offset = torch.tensor([1.0, 2.0, 3.0]).double().expand(len(scene.time), 3)
    coupling = scene.field @ torch.randn(3, 3, generator=generator(4)).double()
    for vector in (False, True):
        metric = Metric(scene, noise_of("white"), vector)
        assert powers(metric, [Question(offset + coupling, [])], 0.0)[0].z < 1e-4


def test_a_second_effect_reduces_the_z_of_the_first(scene):
    metric = Metric(scene, noise_of("white"), False)
    step = step_family(scene.time, 3.0).traces[..., 0]
    drift = next(iter(drift_families(scene.time))).traces[..., 0]
    alone = powers(metric, [Question(step, [])], 0.0)[0].z
    together = powers(metric, [Question(step, []), Question(drift, [])], 0.0)[0].z
    assert together < 0.95 * alone


def test_z_in_white_noise_without_calibration_equals_the_explicit_sum(scene):
    """The norm's residual of isotropic white noise has variance sigma² uᵀu."""
    noise = dataclasses.replace(noise_of("white"), white=(0.5, 0.5, 0.5))
    metric = Metric(scene, noise, False)
    trace = cubic_family(scene).traces[..., 0]
    white = metric.whitened(metric.residual(trace[..., None]))
    u = scene.sensitivity
    expected = ((u * trace).sum(-1).square() / (0.25 * u.square().sum(-1))).sum().sqrt()
    torch.testing.assert_close(white.norm(), expected)


def test_sensitivity_is_the_gradient_of_the_calibrated_length(scene):
    clean = scene.field @ scene.sensor.soft.mT
    inverse = torch.linalg.inv(scene.sensor.soft)
    gradient = torch.func.vmap(torch.func.grad(lambda m: (inverse @ m).norm()))(clean)
    torch.testing.assert_close(scene.sensitivity, gradient)


def test_attitude_gains_are_derivatives_of_the_predicted_field(scene):
    turn = torch.tensor([1e-6, -2e-6, 0.5e-6]).double()
    attitude = product(from_vector(turn.expand(len(scene.time), 3)), scene.motion.attitude)
    turned = dataclasses.replace(scene, motion=dataclasses.replace(scene.motion, attitude=attitude))
    change = (scene.field - turned.field) @ scene.sensor.soft.mT
    torch.testing.assert_close(attitude_gains(scene) @ turn, change, rtol=1e-4, atol=1e-9)
