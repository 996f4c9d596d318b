"""The compiled residual of a simulation that steps agrees with that of torch, step after step and all at once."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mkc_torch._support.forward_mode import forward_tangents
from mkc_torch.simulation import load_mjcf
from mkc_torch.simulation.dynamics.compiled import residual as compiled_residual
from mkc_torch.simulation.dynamics.compiled.expressions import Expressions
from mkc_torch.simulation.foreign.evaluation import EvaluationPoints
from tests.simulation.stepped.models import TWO_LINKS, Steps
from tests.simulation.stepped.test_constants import Pendulum, swinging
from tests.simulation.stepped.test_mujoco import recorded
from tests.simulation.stepped.test_stepper import recording_of


def friction(port, place, width=0.1):
    """A change by dry friction whose size is the last parameter."""
    return lambda values: {port: lambda signal: -values[-1] * torch.tanh(signal[:, [place]] / width)}


class Rubbing(Steps):
    """The pendulum with dry friction in its derivative, as a corrected class has it."""

    def derivative(self, time, x, u, p):
        acting = SimpleNamespace(**{**vars(u), "moment": u.moment - 0.2 * torch.tanh(x.speed / 0.1)})
        return super().derivative(time, x, acting, p)


def cases(tmp_path):
    arm = tmp_path / "arm.xml"
    arm.write_text(TWO_LINKS)
    links = recorded(arm)
    return {
        "force": (Steps().prepare(recording_of()), friction("entry of moment", 1)),
        "rate": (Steps().prepare(recording_of()), friction("rate of speed", 1)),
        "derivative": (Rubbing().prepare(recording_of()), lambda values: {}),
        "input": (
            Steps().prepare(recording_of()),
            lambda values: {"input torque": lambda signal: values[-1] * signal**2},
        ),
        "constant": (
            Pendulum().prepare(swinging(1.0)),
            lambda values: {"constant load": lambda signal: values[-1].expand_as(signal)},
        ),
        "joint": (load_mjcf(arm).prepare(links), friction("entry of elbow_force", 3)),
        "followed": (load_mjcf(arm, joints=["elbow"]).prepare(links), friction("entry of elbow_force", 1)),
    }


@pytest.mark.parametrize("name", ["force", "rate", "derivative", "input", "constant", "joint", "followed"])
def test_the_compiled_residual_and_its_tangents_equal_those_of_torch(name, tmp_path):
    prepared, changes = cases(tmp_path)[name]
    count = len(prepared.given)
    parameters = torch.cat([prepared.start(), prepared.given.new_tensor([0.02])])

    def meaning(values):
        return values[:count], changes(values)

    compiled = prepared.compiled(meaning, count + 1)
    assert compiled is not None
    expected = prepared.answer(*meaning(parameters))
    found = compiled.answer(parameters)
    size = float(prepared.measured.abs().max())
    torch.testing.assert_close(found.residual, expected.residual, rtol=0, atol=1e-7 * size)
    again = compiled.answer(parameters, found.nearby)
    torch.testing.assert_close(again.residual, found.residual, rtol=0, atol=1e-8 * size)
    rows = forward_tangents(lambda values: prepared.answer(*meaning(values), expected.nearby).residual)(parameters)
    own = compiled.tangents(parameters, found.nearby).rows
    for ours, theirs in zip(own, rows, strict=True):
        assert float((ours - theirs).abs().max()) <= 1e-4 * float(theirs.abs().max()) + 1e-9


def test_steps_in_sequence_are_the_solution_of_all_steps_at_once(tmp_path, monkeypatch):
    prepared, changes = cases(tmp_path)["joint"]
    count = len(prepared.given)
    parameters = torch.cat([prepared.given, prepared.given.new_tensor([0.03])])
    one_by_one = prepared.compiled(lambda values: (values[:count], changes(values)), count + 1).answer(parameters)
    monkeypatch.setattr(compiled_residual, "in_sequence", lambda *_: None)
    at_once = prepared.compiled(lambda values: (values[:count], changes(values)), count + 1).answer(parameters)
    torch.testing.assert_close(one_by_one.residual, at_once.residual, rtol=0, atol=1e-7)
    assert one_by_one.residual.abs().max() > 1e-3


def test_derivatives_along_a_long_course_are_interpolated():
    prepared = Steps().prepare(recording_of(rows=1500))
    evaluation = prepared.system._evaluation
    time = 0.01 * np.arange(2990)
    states = np.stack([np.sin(time), np.cos(time)], 1)
    jump = np.where(time[:, None] > 12.0, 1.0, -1.0)
    at = EvaluationPoints(time, states, np.concatenate([jump, np.zeros_like(jump)], 1), np.array([0.5, 4.0, 0.1]))
    steps = []
    fresh, evaluation.fresh = evaluation.fresh, lambda *given: (steps.append(len(given[1][0])), fresh(*given))[1]
    found = evaluation.slope(False, at, "states", 0)
    base = fresh(False, at.rows(slice(None)), at.parts[3])
    expected = evaluation.columns(False, at.rows(slice(None)), at.parts[3], "states", [0], base)[..., 0]
    assert np.abs(found - expected).max() < 0.003 * np.abs(expected).max()
    assert steps[1] < 0.3 * len(time)  # after the values at all points


def test_derivatives_of_the_courses_used_last_are_kept():
    evaluation = Steps().prepare(recording_of()).system._evaluation
    time = 0.01 * np.arange(200)

    def course(size):
        states = size * np.stack([np.sin(time), np.cos(time)], 1)
        return EvaluationPoints(time, states, np.zeros((200, 2)), np.array([0.5, 4.0, 0.1]))

    steps = []
    fresh, evaluation.fresh = evaluation.fresh, lambda *given: (steps.append(1), fresh(*given))[1]
    first = evaluation.slope(False, course(1.0), "states", 0)
    for size in (2.0, 3.0, 4.0):
        assert not np.array_equal(evaluation.slope(False, course(size), "states", 0), first)
    counted = len(steps)
    assert evaluation.slope(False, course(1.0), "states", 0) is first
    assert len(steps) == counted
    evaluation.slope(False, course(1.0), "states", 1)  # by another variable
    assert len(steps) > counted


class Squares:
    """A call of two values of its three arguments: the time, a state, an input."""

    count = 2

    def points(self, time, state, given):
        return time, state, given

    def values(self, points):
        time, state, given = points
        return np.stack([state**2 * given, time * state])

    def slope_by(self, argument):
        def slope(points):
            time, state, given = points
            return np.stack([(0 * time, 2 * state * given, state**2)[argument], (state, time, 0 * time)[argument]])

        return slope


def test_a_call_is_differentiated_by_the_chain_rule():
    from mkc_torch.simulation.dynamics.compiled.tape import Tape

    e = Expressions()
    x, p, time = e.leaf("state", 0), e.leaf("parameter", 0), e.column(np.array([1.0, 2.0, 3.0]))
    first, second = e.call(Squares(), [time, e.apply("mul", p, x), e.apply("sin", x)])
    whole = e.apply("add", first, second)
    states = np.array([[0.3, 0.5, 0.7]])
    by_state, by_parameter = (Tape(e, [e.derivative(whole, leaf)], lambda column: column) for leaf in (x, p))
    values, t, own = states[0], np.array([1.0, 2.0, 3.0]), 2.0
    inner = own * values
    expected = own * (2 * inner * np.sin(values) + t) + inner**2 * np.cos(values)
    np.testing.assert_allclose(by_state.at([own])(states)[0], expected)
    np.testing.assert_allclose(by_parameter.at([own])(states)[0], values * (2 * inner * np.sin(values) + t))
    with pytest.raises(KeyError, match="second derivative"):
        e.derivative(e.derivative(first, x), x)
