"""The baselines of the concealed dynamics: their free runs, their choices, and both of them on a made-up drop."""

import importlib
import math
import sys
from pathlib import Path

import pytest
import torch

from mkc_torch import Recording

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "concealed_physics" / "dynamics"
DRAG = 0.02


@pytest.fixture
def load_module(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    for name in ("baselines", "free_run", "held_out", "library", "neural", "problem", "sparse_regression", "systems"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module


def drop(seconds, speed):
    """Return terminal speed and height, in closed form, of a ball with quadratic drag thrown upwards."""
    terminal = math.sqrt(9.81 / DRAG)
    time = torch.arange(0.0, seconds, 1.0 / 15.0, dtype=torch.float64)
    since_top = 9.81 * (time - time.new_tensor(speed / 9.81)) / terminal
    falling = -(terminal**2) / 9.81 * torch.log(torch.cosh(since_top.clamp(min=0.0)))
    rising = terminal**2 / 9.81 * torch.log(torch.cos(since_top.clamp(max=0.0)))
    return Recording({"time": time, "height": 50.0 + torch.where(since_top > 0, falling, rising)})


@pytest.fixture
def problem(load_module):
    systems = load_module("systems")
    case = systems.Case("ball", systems.Ball(), drop(3.5, 0.0), {"other drop": drop(3.2, 0.3)}, scored_from=1.0)
    return load_module("problem").problem_of(case, torch.zeros(0, dtype=torch.float64))


def oscillation(load_module, lengths):
    """Return runs cos(t + run) of an oscillator without inputs."""
    longest = max(lengths)
    index = torch.arange(longest).unsqueeze(-1).minimum(torch.tensor(lengths) - 1)
    time = 0.1 * index.double()
    present = torch.arange(longest).unsqueeze(-1) < torch.tensor(lengths)
    measured = torch.cos(time + torch.arange(len(lengths))).unsqueeze(-1)
    inputs = torch.zeros(longest - 1, 3, len(lengths), 0, dtype=torch.float64)
    return load_module("free_run").Runs(time, measured, inputs, present)


def oscillator_rate(x, _u):
    return torch.stack([x[..., 1], -x[..., 0]], -1)


def test_a_free_run_equals_the_solution_and_is_constant_after_its_end(load_module):
    runs = oscillation(load_module, [40, 25])
    phase = torch.arange(2.0, dtype=torch.float64)
    begin = torch.stack([torch.cos(phase), -torch.sin(phase)], -1)
    states = load_module("free_run").free_run(oscillator_rate, begin, runs)
    assert states.shape == (40, 2, 2)
    torch.testing.assert_close(states[..., :1], runs.measured, atol=1e-5, rtol=0.0)
    assert bool((states[24:, 1] == states[24, 1]).all())


def test_a_diverging_model_does_not_affect_the_others(load_module):
    module, runs = load_module("free_run"), oscillation(load_module, [40, 25])
    grows = torch.tensor([0.0, 1e6], dtype=torch.float64).view(2, 1, 1)

    def rate(x, u):
        return oscillator_rate(x, u) + grows * x**3

    guess = torch.tensor([1.0, 0.0], dtype=torch.float64).expand(2, 2, 2)
    begin = module.first_states(rate, guess, runs, [0], 1.0)
    errors = module.error(module.free_run(rate, begin, runs)[..., :1], runs, runs.present, absolute=False)
    assert float(errors[0]) < 1e-4
    assert not math.isfinite(float(errors[1]))


def test_first_states_are_recovered_from_the_measured_outputs(load_module):
    runs = oscillation(load_module, [40, 25])
    guess = torch.zeros(2, 2, dtype=torch.float64) + 0.5
    found = load_module("free_run").first_states(oscillator_rate, guess, runs, [0], 1.0)
    phase = torch.arange(2.0, dtype=torch.float64)
    torch.testing.assert_close(found, torch.stack([torch.cos(phase), -torch.sin(phase)], -1), atol=1e-4, rtol=0.0)


def test_windows_share_their_edges_and_end_with_their_run(load_module):
    cut = load_module("free_run").windows(oscillation(load_module, [40, 25]), 10)
    assert cut.time.shape == (11, 8)
    torch.testing.assert_close(cut.measured[-1, :4], cut.measured[0, 2:6])
    assert cut.present[:, 5].tolist() == [True] * 5 + [False] * 6  # second run, samples 20 to 24
    assert not cut.present[:, 7].any()


@pytest.mark.parametrize("between", ["held", "linear", "smooth"])
def test_inputs_between_samples_follow_the_input_hold(load_module, between):
    system = load_module("systems").Silverbox()
    system.input_hold = between
    time = torch.arange(0.0, 4.0, 0.2, dtype=torch.float64)
    found = load_module("free_run").stations(system, Recording({"time": time, "input": time**2}), 2)
    assert found.shape == (19, 5, 1)
    start, middle = time[:-1], time[:-1] + 0.1
    expected = {"held": start**2, "linear": (start**2 + time[1:] ** 2) / 2, "smooth": middle**2}[between]
    torch.testing.assert_close(found[:, 2, 0], expected)
    torch.testing.assert_close(found[:, 0, 0], start**2)


def test_selection_averages_and_formats_of_results(load_module):
    baselines = load_module("baselines")
    assert load_module("sparse_regression").simplest([2.0, 1.0, 1.04, 1.02], [1, 5, 3, 3]) == 3
    assert baselines.mean_of([1.0, math.inf, 3.0]) == (2.0, 1)
    assert baselines.counted(["drag", "nothing", "drag"]) == "drag (2), nothing (1)"
    physics = baselines.PHYSICS["Silverbox"]
    assert baselines.in_unit([0.001, 0.003], physics) == "2.000 mV"
    assert baselines.in_unit([math.inf, 0.003], physics) == "3.000 mV (1 of 2 diverged)"
    assert baselines.in_unit([math.inf], physics) == "diverged"


def test_library_terms_can_be_evaluated_and_include_all_used_terms(load_module):
    library, systems = load_module("library"), load_module("systems")
    for system in (systems.Ball(), systems.Heaters(), systems.Silverbox(), systems.Servo()):
        physics = library.PHYSICS[system.name]
        x, u, p = (
            load_module("free_run").named(tuple(names), torch.full((5, len(names)), 0.5, dtype=torch.float64))
            for names in (system.states, system.inputs, system.parameters)
        )
        terms = physics.terms(x, u, p, library.Shape())
        used = {term for state in physics.own for term in physics.own[state] + physics.more[state]}
        assert used <= set(terms)
        assert all(term().shape == (5,) for term in terms.values())


def test_shortened_training_runs_exclude_the_held_out_part(load_module, problem):
    short = load_module("problem").shortened(problem.case)
    assert float(short.train["time"][-1]) <= 0.7 * float(problem.case.train["time"][-1])
    assert short.tests == {}


def test_the_neural_ode_learns_the_drag_of_a_drop(load_module, problem, monkeypatch):
    neural = load_module("neural")
    monkeypatch.setattr(neural, "EPOCHS", 40)
    (before,) = problem.unseen(load_module("free_run").rate_of(problem.case.system, problem.fitted))
    rate = neural.trained(problem, problem.train, 17, 40, lambda *_: None, 0)
    with torch.no_grad():
        (after,) = problem.unseen(rate)
    assert before > 1.0
    assert after < 0.5 * before


def test_pysindy_finds_the_drag_of_a_drop(load_module, problem, monkeypatch):
    pytest.importorskip("pysindy", reason="PySINDy is not installed", exc_type=ImportError)
    sparse = load_module("sparse_regression")
    monkeypatch.setattr(sparse, "THRESHOLDS", (0.03, 0.2))
    outcome = sparse.sindy(problem, problem)
    assert outcome.name == "speed' = simulation + *v|v|*"
    assert outcome.errors[0] < 0.1


def test_an_absent_file_is_named(load_module, tmp_path, monkeypatch):
    baselines = load_module("baselines")
    monkeypatch.setattr(
        sys, "argv", ["baselines", "--data", str(tmp_path), "--systems", "servo", "--methods", "neural ODE"]
    )
    with pytest.raises(SystemExit, match=r"_kp100\.csv: there is no such file"):
        baselines.main()
