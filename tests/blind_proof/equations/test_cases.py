import dataclasses
import json

import numpy as np
import pytest
import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.equations.cases import draw
from examples.blind_proof.equations.errors import OUTLIERS, Errors, Slow, contaminate, sample
from examples.blind_proof.equations.oracle import ratio_to_oracle
from examples.blind_proof.equations.simulations import MODELS, class_of
from examples.blind_proof.equations.systems import SYSTEMS
from examples.blind_proof.key import canonical
from mkc_torch.simulation import Dynamics, Static
from mkc_torch.simulation.load import load_simulation

FIRST_INDEX = {"pendulum": 0, "servo": 1, "tanks": 2, "projectile": 4}


@pytest.fixture(scope="module")
def cases():
    return {name: draw(1, index) for name, index in FIRST_INDEX.items()}


@pytest.mark.e2e
def test_the_same_address_gives_the_same_case(cases):
    again = draw(1, FIRST_INDEX["tanks"])
    assert canonical([again.key]) == canonical([cases["tanks"].key])
    for name, values in cases["tanks"].recording.columns.items():
        torch.testing.assert_close(again.recording[name], values, rtol=0, atol=0)


def test_recording_names_reveal_the_system_only(cases):
    for name, case in cases.items():
        assert case.recording.name == f"{name}_{FIRST_INDEX[name]:05d}"


def test_keys_round_trip_through_json_with_their_detectability(cases):
    for case in cases.values():
        assert json.loads(canonical([case.key])) == [case.key.numbers()]
        (effect,) = case.key.effects
        assert effect.z > 2.0
        assert effect.z_sep <= effect.z
        assert effect.at
        assert 0.7 < case.key.oracle_rms < 1.3


def test_recordings_have_runs_outliers_and_an_unrelated_column(cases):
    for case in cases.values():
        recording = case.recording
        assert 300 <= len(recording) <= 600
        assert "temperature" in recording.names
        outputs = len(case.key.noise["deviation"])
        assert len(case.key.outliers) == pytest.approx(OUTLIERS * outputs * len(recording), abs=outputs * 3)
        assert all(bool(values.isfinite().all()) for values in recording.columns.values())
    assert "experiment" in cases["projectile"].recording


def test_an_empty_case_hides_nothing():
    case = draw(1, FIRST_INDEX["tanks"], hidden=False)
    assert case.key.effects == ()
    assert case.second is None
    assert case.key.kind == "empty"


@pytest.mark.parametrize("system", SYSTEMS)
def test_the_simulation_has_the_equations_of_the_plant_without_the_effect(system):
    """It is loaded from a file as `mkc diagnose --simulation FILE.py:CLASS` does."""
    setting = SYSTEMS[system].draw(generator(3, system))
    plant = setting.plant
    simulation = load_simulation(f"{MODELS}:{class_of(system)}")
    assert isinstance(simulation, Static if system == "servo" else Dynamics)
    assert simulation.inputs == plant.inputs
    assert simulation.outputs in ((), plant.outputs)
    assert {state: simulation.units[state] for state in plant.units} == dict(plant.units)
    x = 0.5 + torch.rand(len(plant.states), 7, generator=generator(1), dtype=torch.float64)
    u = torch.rand(len(plant.inputs), 7, generator=generator(2), dtype=torch.float64)

    class Names:
        def __init__(self, names, values):
            self.__dict__.update(zip(names, values, strict=True))

    values = Names(simulation.parameters, [torch.tensor(v, dtype=torch.float64) for v in plant.values])
    inputs = Names(plant.inputs, u)
    if system == "servo":
        expected = plant.read(x.numpy(), u.numpy())
        computed, rows = simulation.output(torch.zeros(7), inputs, values), plant.outputs
    else:
        assert simulation.states == plant.states
        expected = plant.rate(x.numpy(), u.numpy(), plant.values)
        computed, rows = simulation.derivative(torch.zeros(7), Names(plant.states, x), inputs, values), plant.states
    found = np.stack([(computed[name] + torch.zeros(7)).numpy() for name in rows])
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_residual_of_the_true_system_is_that_of_the_sensor_errors(cases):
    """The true system leaves the sensor errors only."""
    case = cases["tanks"]
    key, second = case.key, case.second
    good = np.ones(2 * len(second), dtype=bool)
    good[list(key.second_outliers)] = False
    measured = torch.cat([second[name] for name in key.noise["deviation"]])
    scale = torch.cat([torch.full((len(second),), d) for d in key.noise["deviation"].values()]).double()
    # a run that is off by half a standard deviation everywhere, and by anything at the outliers
    off = measured + 0.5 * scale
    off[torch.from_numpy(~good)] = 1e6
    run = dict(zip(key.noise["deviation"], off.split(len(second)), strict=True))
    assert ratio_to_oracle(run, second, key) == pytest.approx(0.5 / key.oracle_rms, rel=1e-6)
    broken = {name: values * torch.nan for name, values in run.items()}
    assert ratio_to_oracle(broken, second, key) == torch.inf


def test_errors_have_their_declared_size_and_correlation():
    errors = Errors((0.5, 2.0), 0.4, "laplace")
    noise = sample(generator(5), errors, 20000, 1)[..., 0]
    np.testing.assert_allclose(noise.std(1), errors.deviations, rtol=0.05)
    assert np.corrcoef(noise[0, 1:], noise[0, :-1])[0, 1] == pytest.approx(0.4, abs=0.03)


def test_outliers_are_large_and_of_the_declared_share():
    errors = Errors((0.5,), 0.0, "gaussian")
    bad, mask = contaminate(generator(6), errors, 400, 2)
    assert mask.sum() == 2 * round(OUTLIERS * 400)
    assert (np.abs(bad[mask]) >= 2.5).all()
    assert not bad[~mask].any()


SLOW_ERRORS = Errors((0.5, 2.0), 0.0, "gaussian", (Slow(3.0, 20.0), Slow(0.0, 20.0)))


def test_drift_is_autoregressive_and_added_to_white_noise():
    values = sample(generator(3), SLOW_ERRORS, 200, 1500)
    slow, other = values[0] / 0.5, values[1] / 2.0
    assert slow.var() == pytest.approx(1.0 + 9.0, rel=0.03)
    assert other.var() == pytest.approx(1.0, rel=0.03)
    for lag in (1, 10, 40):
        assert (slow[lag:] * slow[:-lag]).mean() == pytest.approx(9.0 * np.exp(-lag / 20.0), abs=0.3)
        assert (other[lag:] * other[:-lag]).mean() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_white_and_slow_errors_together_are_whitened(correlation):
    errors = dataclasses.replace(SLOW_ERRORS, correlation=correlation)
    white = errors.whitened(sample(generator(4), errors, 60, 800)).reshape(2, 60, 800)
    for item in white:
        found = item @ item.T / item.shape[1]
        np.testing.assert_allclose(found, np.eye(60), atol=0.2)


def test_whitening_several_traces_equals_whitening_each():
    traces = np.random.default_rng(1).standard_normal((2, 30, 3, 4))
    together = SLOW_ERRORS.whitened(traces)
    alone = np.stack([SLOW_ERRORS.whitened(traces[..., k]) for k in range(4)], -1)
    np.testing.assert_allclose(together, alone, atol=1e-12)
