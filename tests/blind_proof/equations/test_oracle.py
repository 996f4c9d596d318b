import math

import numpy as np
import pytest

from examples.blind_proof.draws import generator
from examples.blind_proof.equations.errors import OUTLIERS, Errors
from examples.blind_proof.equations.flows import weir
from examples.blind_proof.equations.forces import added
from examples.blind_proof.equations.hidden import rate_of
from examples.blind_proof.equations.integrate import SystemScene, simulate
from examples.blind_proof.equations.oracle import Cone, Judge, moved, power, tangents
from examples.blind_proof.equations.plant import HiddenTerm, RunSet
from examples.blind_proof.equations.systems.mechanics import PENDULUM
from examples.blind_proof.equations.systems.vessels import TANKS


def short_scene(system, seed):
    setting = system.draw(generator(seed))
    trial = RunSet(setting.trial.step, setting.trial.inputs[:, :70], setting.trial.begin)
    return SystemScene(setting.plant, trial, simulate(setting.plant, trial))


@pytest.fixture(scope="module", params=[PENDULUM, TANKS])
def scene(request):
    return short_scene(request.param, 4)


def errors_of(scene, correlation=0.3):
    return Errors(tuple(0.01 * item.std() for item in scene.course.outputs), correlation, "gaussian")


def dense_whitening(errors, shape):
    """Return the inverse Cholesky factor of the dense covariance of (m, T, R) outputs."""
    m, samples, runs = shape
    lag = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples)))
    root = np.linalg.inv(np.linalg.cholesky(errors.correlation**lag))
    blocks = [np.kron(root, np.eye(runs)) / d for d in errors.deviations]
    total = np.zeros((m * samples * runs,) * 2)
    for k, block in enumerate(blocks):
        part = slice(k * samples * runs, (k + 1) * samples * runs)
        total[part, part] = block
    return total


def finite_difference(change):
    """Return the central difference of ``change(step)``, simulated outputs, by the step."""
    return (change(1e-5) - change(-1e-5)) / 2e-5


def test_whitening_equals_that_of_the_dense_covariance(scene):
    errors = errors_of(scene)
    trace = np.random.default_rng(0).standard_normal((*scene.course.outputs.shape, 2))
    expected = dense_whitening(errors, trace.shape[:3]) @ trace.reshape(-1, 2)
    np.testing.assert_allclose(errors.whitened(trace), expected, rtol=1e-9, atol=1e-9)


def test_tangents_equal_finite_differences_of_the_simulation(scene):
    errors = errors_of(scene, 0.0)
    known = tangents(scene, errors, rivals=False).known
    for k in range(known.shape[1]):

        def change(step, k=k):
            away = np.zeros(known.shape[1])
            away[k] = step
            return simulate(*moved(scene.plant, scene.trial, away)).outputs

        expected = errors.whitened(finite_difference(change))
        assert np.abs(known[:, k] - expected).max() < 1e-3 * np.abs(expected).max()


def test_rival_forms_equal_finite_differences_of_the_simulation():
    scene = short_scene(PENDULUM, 5)
    errors = errors_of(scene, 0.0)
    found = {(a.effect, a.at): c for a, c in tangents(scene, errors, rivals=True).forms}
    forms = {"constant_force": lambda x, _: np.ones_like(x[1]), "quadratic_drag": lambda x, _: -x[1] * np.abs(x[1]),
             "cubic_stiffness": lambda x, _: -x[0] ** 3}  # fmt: skip
    for effect, form in forms.items():
        hidden = HiddenTerm(effect, "", (rate_of("speed"),), 1.0, added(1, form))
        expected = errors.whitened(
            finite_difference(lambda s, h=hidden: simulate(scene.plant, scene.trial, h, s).outputs)
        )
        np.testing.assert_allclose(
            found[effect, (rate_of("speed"),)][:, 0], expected, atol=2e-3 * np.abs(expected).max()
        )


def test_z_equals_that_of_a_dense_projection(scene):
    """A small effect, compared with the explicit sum."""
    errors = errors_of(scene)
    row = scene.plant.states.index("speed") if "speed" in scene.plant.states else 0
    place = rate_of(scene.plant.states[row])
    hidden = HiddenTerm("constant_force", "", (place,), 1.0, added(row, lambda x, _: np.ones_like(x[row])))
    size = 0.02 * scene.pace(scene.plant.states[row])
    root = dense_whitening(errors, scene.course.outputs.shape)
    delta = root @ (simulate(scene.plant, scene.trial, hidden, size).outputs - scene.course.outputs).ravel()
    known = tangents(scene, errors, rivals=False).known
    rest = delta - known @ np.linalg.lstsq(known, delta, rcond=None)[0]
    found = power(scene.plant, scene.trial, hidden, size, errors)
    assert found.z == pytest.approx(math.sqrt(1.0 - OUTLIERS) * np.linalg.norm(rest), rel=0.1)
    assert found.missed < 0.02 * found.z
    assert found.z_sep <= found.z
    assert found.z_sep == min(rival.z_sep for rival in found.rivals)
    assert all(rival.effect != "constant_force" or rival.at != (place,) for rival in found.rivals)


def test_an_effect_that_a_refit_absorbs_has_zero_z():
    scene = short_scene(PENDULUM, 6)
    hidden = HiddenTerm("linear_drag", "", (rate_of("speed"),), 1.0, added(1, lambda x, _: -x[1]))
    found = power(scene.plant, scene.trial, hidden, 0.05, errors_of(scene))
    assert found.z < 1e-2


def test_a_form_that_contains_the_hidden_form_is_not_a_rival():
    scene = short_scene(PENDULUM, 7)
    width = 0.1 * scene.typical("speed")
    hidden = HiddenTerm("coulomb_friction", "", (rate_of("speed"),), 1.0, added(1, lambda x, _: -np.tanh(x[1] / width)))
    found = power(scene.plant, scene.trial, hidden, 0.2, errors_of(scene))
    assert {r.effect for r in found.rivals}.isdisjoint({"stribeck_friction", "load_dependent_friction"})
    assert found.z_sep > 1.0


def test_z_is_linear_in_a_small_size():
    scene = short_scene(TANKS, 8)
    errors = errors_of(scene)
    hidden = HiddenTerm("overflow", "", (rate_of("level_1"),), 1.0, weir(0, 0.7 * scene.largest("level_1"), 1.5))
    judge = Judge(tangents(scene, errors, rivals=True))
    item, two = (
        judge.power(
            errors.whitened(simulate(scene.plant, scene.trial, hidden, s).outputs - scene.course.outputs), hidden
        )
        for s in (1e-4, 2e-4)
    )
    assert two.z == pytest.approx(2.0 * item.z, rel=0.02)
    assert two.z_sep == pytest.approx(2.0 * item.z_sep, rel=0.05)


def test_a_cone_explains_no_more_than_its_span():
    rng = np.random.default_rng(1)
    columns, left = rng.standard_normal((30, 3)), rng.standard_normal(30)
    amplitudes = np.linalg.lstsq(columns, left, rcond=None)[0]
    span = float(np.square(columns @ amplitudes).sum())
    assert Cone(columns, positive=False).explained(left) == pytest.approx(span)
    assert Cone(columns, positive=True).explained(left) <= span
    inside = columns @ np.array([1.0, 2.0, 0.5])
    assert Cone(columns, positive=True).explained(inside) == pytest.approx(float(inside @ inside))
    assert Cone(np.zeros((30, 2)), positive=True).explained(left) == 0.0
