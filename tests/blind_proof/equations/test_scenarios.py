"""Each scenario matches its name and gives the same case at the same address."""

import sys

import numpy as np
import pytest
import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.equations.best_fit import best_shares, right, wrong
from examples.blind_proof.equations.disturbances import KINDS, LASTING
from examples.blind_proof.equations.integrate import between, holding, simulate
from examples.blind_proof.equations.plant import Plant, RunSet
from examples.blind_proof.equations.scenarios import (
    LEAST_SLOW,
    MOST_EXPLAINED,
    SLOW_SIZE,
    SLOW_TIME,
    draw_useless,
    equations_scenarios,
)
from examples.blind_proof.equations.simulations import right_source, wrong_source
from examples.blind_proof.equations.systems import SYSTEMS
from examples.blind_proof.key import canonical
from mkc_torch.simulation.load import load_simulation

SCENARIOS = {scenario.name: scenario for scenario in equations_scenarios().scenarios}


def test_all_scenarios_are_listed():
    assert list(SCENARIOS) == [
        "white", "coloured", "pushed_white", "pushed_slowly", "gusts", "held", "far_starts", "runs", "slow_sensor",
        "lasting_push", "lasting_push_runs", "useless",
    ]  # fmt: skip
    assert [name for name, scenario in SCENARIOS.items() if not scenario.hides] == ["useless"]


@pytest.mark.e2e
@pytest.mark.parametrize("name", SCENARIOS)
def test_the_same_address_gives_the_same_case_under_another_number(name):
    item, other = (SCENARIOS[name].draw(3, 1, False, number) for number in (1, 7))
    assert (item.key.name[-5:], other.key.name[-5:]) == ("00001", "00007")
    assert item.simulation == other.simulation
    assert canonical([item.key]) == canonical([other.key]).replace("_00007", "_00001")
    for column, values in item.recording.columns.items():
        torch.testing.assert_close(other.recording[column], values, rtol=0, atol=0)
    elsewhere = SCENARIOS[name].draw(4, 1, False, 1).recording.columns
    assert not all(
        torch.equal(values, elsewhere.get(column, values[:0])) for column, values in item.recording.columns.items()
    )


@pytest.mark.e2e
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "useless")) for name in SCENARIOS]
)
def test_nothing_is_hidden_in_an_empty_case(name):
    for index in range(3):
        key = SCENARIOS[name].draw(3, index, False, index).key
        assert key.effects == ()
        assert key.kind == ("useless" if name == "useless" else "empty")
        assert (key.disturbance is not None) == (name in KINDS or name == "slow_sensor")
        assert bool(key.useless) == (name == "useless")
        assert (key.noise["correlation"] > 0.0) == (name == "coloured")
        if key.disturbance is not None:
            assert key.disturbance.kind == name
            assert key.disturbance.over_noise >= (1.0 if name == "slow_sensor" else 1.5)


@pytest.mark.e2e
@pytest.mark.parametrize("name", ["white", "gusts", "held"])
def test_a_disturbance_acts_in_every_second_case_with_hidden_physics(name):
    keys = [SCENARIOS[name].draw(3, index, True, index).key for index in range(2)]
    assert [key.disturbance is not None for key in keys] == [True, False]
    assert all(len(key.effects) == 1 for key in keys)
    assert all(key.kind in ("single", "outside") for key in keys)


@pytest.mark.e2e
def test_a_disturbance_makes_a_hidden_effect_harder_to_detect():
    """z includes the disturbance: for the same effect and size it falls when process noise is added."""
    from examples.blind_proof.equations.disturbances import DisturbedErrors, draw_disturbance
    from examples.blind_proof.equations.errors import draw_errors
    from examples.blind_proof.equations.integrate import SystemScene
    from examples.blind_proof.equations.oracle import power

    setting = SYSTEMS["thermal"].draw(generator(2))
    scene = SystemScene(setting.plant, setting.trial, simulate(setting.plant, setting.trial))
    errors = draw_errors(generator(3), scene.course.outputs)
    disturbances = (draw_disturbance(generator(seed), "pushed_slowly", scene, errors) for seed in range(20))
    disturbance = next(disturbance for disturbance in disturbances if disturbance.state == "temperature_1")
    effect = SYSTEMS["thermal"].inside[0](generator(5), scene)  # in the same body
    alone, nearby = (
        power(scene.plant, scene.trial, effect, effect.large, noise)
        for noise in (errors, DisturbedErrors(scene, errors, disturbance))
    )
    assert nearby.z < 0.8 * alone.z


def integrator():
    return Plant("integrator", ("x",), ("u",), ("x",), {"x": "m"}, {}, {}, lambda x, u, p: u + 0.0 * x, 12)


@pytest.mark.parametrize("held", [True, False])
def test_a_held_input_is_held_in_the_integration(held):
    inputs = torch.randn(1, 9, 2, dtype=torch.float64, generator=generator(1)).numpy()
    course = simulate(integrator(), RunSet(0.5, inputs, np.zeros((1, 2)), held=held))
    steps = 0.5 * (inputs[:, :-1] if held else 0.5 * (inputs[:, :-1] + inputs[:, 1:]))
    np.testing.assert_allclose(np.diff(course.outputs, axis=1), steps, atol=1e-14)
    at = (holding if held else between)(inputs, 12)
    np.testing.assert_array_equal(course.inputs, at)


@pytest.mark.e2e
def test_held_inputs_differ_from_linear_inputs_by_more_than_the_noise():
    """The scenario is void if the noise hides the difference."""
    from dataclasses import replace

    more = []
    for index in range(8):
        system = list(SYSTEMS)[index % 4]
        setting = SYSTEMS[system].draw(generator(index, "held"))
        held = simulate(setting.plant, replace(setting.trial, held=True)).outputs
        linear = simulate(setting.plant, setting.trial).outputs
        more.append(np.sqrt(np.square(held - linear).mean()) / linear.std() / 0.02)
    assert np.median(more) > 0.3


def recorded_runs(recording):
    return len(recording["experiment"].unique()) if "experiment" in recording else 1


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("name", "runs"), [pytest.param("lasting_push", 1, marks=pytest.mark.slow), ("lasting_push_runs", 4)]
)
@pytest.mark.parametrize("hidden", [False, True])
def test_a_lasting_disturbance_acts_in_every_recording_for_about_a_run(name, runs, hidden):
    for index in range(3):
        case = SCENARIOS[name].draw(3, index, hidden, index)
        assert recorded_runs(case.recording) == runs
        time = case.recording["time"]
        share = case.key.disturbance.words["correlation time"] / float(time.max() - time.min())
        assert LASTING[0] <= share <= LASTING[1]
        assert bool(case.key.effects) == hidden
    assert SCENARIOS[name].share == 1.0
    assert SCENARIOS[name].apart == (runs == 1)


@pytest.mark.e2e
@pytest.mark.parametrize("hidden", [False, True])
def test_a_sensor_drifts_for_one_to_ten_per_cent_of_a_run_without_disturbance(hidden):
    for index in range(4):
        case = SCENARIOS["slow_sensor"].draw(3, index, hidden, index)
        key, time = case.key, case.recording["time"]
        step, length = float(time[1] - time[0]), float(time.max() - time.min())
        assert (key.disturbance.kind, key.disturbance.at) == ("slow_sensor", "sensor")
        assert SLOW_SIZE[0] <= key.disturbance.over_noise <= SLOW_SIZE[1]
        for constant in key.disturbance.words.values():
            assert SLOW_TIME[0] * length <= constant <= max(SLOW_TIME[1] * length, LEAST_SLOW * step) * (1 + 1e-9)
        assert bool(key.effects) == hidden
        slow = key.noise["slow"]
        assert max(item["over_noise"] for item in slow.values()) == key.disturbance.over_noise


def test_recordings_have_three_to_five_runs_and_throws_no_held_input():
    for index in range(6):
        recording = SCENARIOS["runs"].draw(3, index, False, index).recording
        assert 3 <= len(recording["experiment"].unique()) <= 5
        for name in ("held", "far_starts"):
            assert "projectile" not in SCENARIOS[name].draw(3, index, False, index).key.name


@pytest.mark.parametrize("index", range(4))
def test_far_starts_are_ten_times_off(index, tmp_path):
    case = SCENARIOS["far_starts"].draw(3, index, False, 0)
    system = case.key.mode
    name = "".join(word.capitalize() for word in system.split("_"))
    far, near = tmp_path / "far.py", tmp_path / "near.py"
    far.write_text(case.simulation, encoding="utf-8")
    near.write_text(right_source(name), encoding="utf-8")
    far, near = (load_simulation(f"{path}:{name}") for path in (far, near))
    starts = [
        [getattr(value, "value", value) for value in simulation.parameters.values()] for simulation in (far, near)
    ]
    ratios = np.array(starts[0]) / np.array(starts[1])
    assert set(np.round(np.log10(ratios), 6)) <= {-1.0, 1.0}


@pytest.mark.e2e
@pytest.mark.parametrize("index", [0, 1, 2, *(pytest.param(index, marks=pytest.mark.slow) for index in (3, 4, 5))])
def test_a_useless_simulation_fits_no_output_of_the_recording(index):
    """A fit to the recorded outputs from other starts does not explain a quarter of any output either."""
    case = SCENARIOS["useless"].draw(5, index, False, index)
    assert case.key.useless == ("wrong sign", "another system", "unrelated output")[index % 3]
    assert case.key.explained <= MOST_EXPLAINED
    plant = SYSTEMS[case.key.mode].draw(generator(1)).plant
    table = case.recording
    runs = len(table["experiment"].unique()) if "experiment" in table else 1

    def signals(names):
        return np.stack([table[name].numpy().reshape(runs, -1).T for name in names] or [np.zeros((0, 0))])

    outputs = signals(plant.outputs)
    inputs = signals(plant.inputs) if plant.inputs else np.zeros((0, *outputs.shape[1:]))
    trial = RunSet(float(table["time"][1] - table["time"][0]), inputs, np.zeros((len(plant.states), runs)))
    guess = right(plant) if case.key.useless == "unrelated output" else wrong(plant, case.key.useless)
    assert max(best_shares(generator(77), guess, trial, outputs)) <= MOST_EXPLAINED + 0.02


def test_a_useless_draw_that_a_fit_can_explain_is_drawn_again(monkeypatch):
    reported = iter([[0.1, 0.9], [0.1, 0.2], [0.26, -3.0], *[[0.2, -5.0]] * 4])
    monkeypatch.setattr(sys.modules[draw_useless.__module__], "best_shares", lambda *_: next(reported))
    assert draw_useless(3, 0, False, 0).key.explained == 0.2


@pytest.mark.e2e
@pytest.mark.parametrize("system", sorted({*SYSTEMS} - {"servo"}))
def test_the_true_simulation_explains_all_outputs(system):
    """A small share then means a useless simulation, not a poor fit."""
    setting = SYSTEMS[system].draw(generator(5, system))
    outputs = simulate(setting.plant, setting.trial).outputs
    assert min(best_shares(generator(6), right(setting.plant), setting.trial, outputs)) > 0.995


class Attributes:
    def __init__(self, names, values):
        self.__dict__.update(zip(names, values, strict=True))


@pytest.mark.parametrize("kind", ["wrong sign", "another system"])
@pytest.mark.parametrize("system", sorted({*SYSTEMS} - {"servo"}))
def test_the_simulation_file_has_the_equations_that_the_generator_fitted(system, kind, tmp_path):
    setting = SYSTEMS[system].draw(generator(3, system))
    guess = wrong(setting.plant, kind)
    plant, name = guess.plant, "".join(word.capitalize() for word in system.split("_"))
    path = tmp_path / "simulation.py"
    path.write_text(wrong_source(name, kind), encoding="utf-8")
    simulation = load_simulation(f"{path}:{name}")
    assert (simulation.states, simulation.inputs) == (plant.states, plant.inputs)
    assert (simulation.outputs or simulation.states) == plant.outputs
    given = [
        (value, -np.inf, np.inf) if isinstance(value, float) else (value.value, value.lower, value.upper)
        for value in simulation.parameters.values()
    ]
    assert given == [(start, *bounds) for start, bounds in zip(guess.starts, guess.bounds, strict=True)]
    x = 0.5 + torch.rand(len(plant.states), 7, generator=generator(1), dtype=torch.float64)
    u = torch.rand(len(plant.inputs), 7, generator=generator(2), dtype=torch.float64)
    values = 0.5 + torch.rand(len(guess.starts), generator=generator(3), dtype=torch.float64)
    rates = simulation.derivative(
        torch.zeros(7),
        Attributes(plant.states, x),
        Attributes(plant.inputs, u),
        Attributes(simulation.parameters, values),
    )
    expected = plant.rate(x.numpy(), u.numpy(), values.numpy())
    found = np.stack([(rates[state] + torch.zeros(7)).numpy() for state in plant.states])
    np.testing.assert_allclose(found, expected, rtol=1e-12)
