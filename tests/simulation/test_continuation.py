"""Evaluations depend on their arguments only; in a fit each starts from the previous evaluation."""

from functools import cache

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.ports import Answer

TIME = torch.linspace(0.0, 6.0, 121, dtype=torch.float64)


class Pendulum(Dynamics):
    states = ("angle", "speed")
    parameters = {"stiffness": 4.0, "damping": 0.2}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": -p.stiffness * torch.sin(x.angle) - p.damping * x.speed}


@cache
def prepared():
    return Pendulum().prepare(Recording({"time": TIME, "angle": torch.exp(-0.1 * TIME) * torch.cos(2.0 * TIME)}))


def theta(stiffness, damping=0.2):
    return torch.tensor([stiffness, damping, 1.0, 0.0], dtype=torch.float64)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(0.5, 30.0), max_size=3), st.floats(0.5, 30.0))
def test_an_evaluation_does_not_depend_on_previous_evaluations(before, final):
    first = prepared().answer(theta(final), {}).residual
    for stiffness in before:
        prepared().answer(theta(stiffness), {})
        prepared().signals(theta(stiffness), {})
    assert torch.equal(prepared().answer(theta(final), {}).residual, first)


@settings(max_examples=15, deadline=None)
@given(st.floats(1.0, 10.0), st.floats(0.95, 1.05))
def test_the_start_of_an_evaluation_changes_it_by_rounding_only(stiffness, factor):
    near = prepared().answer(theta(factor * stiffness), {}).nearby
    alone = prepared().answer(theta(stiffness), {}).residual
    for beginning in (near, near.bare):
        torch.testing.assert_close(
            prepared().answer(theta(stiffness), {}, beginning).residual, alone, rtol=0, atol=1e-8
        )


def test_derivatives_do_not_depend_on_the_start():
    near = prepared().answer(theta(4.3), {}).nearby
    slopes = [
        torch.func.jacfwd(lambda p, at=at: prepared().answer(p, {}, at).residual)(theta(4.0)) for at in (None, near)
    ]
    torch.testing.assert_close(*slopes, rtol=1e-6, atol=1e-8)


class RecordedStarts:
    """A simulation whose residual is its parameter, and which records the starts of its evaluations."""

    def __init__(self):
        self.starts = []

    def answer(self, theta, changes, near=None):
        self.starts.append(near)
        return Answer(theta.unsqueeze(-1), SolutionStub(float(theta)))

    def compiled(self, meaning, size):
        return None


class SolutionStub:
    def __init__(self, value, whole=True):
        self.value, self.whole = value, whole

    @property
    def bare(self):
        return SolutionStub(self.value, whole=False)

    def __eq__(self, other):
        return (self.value, self.whole) == (other.value, other.whole)

    __hash__ = None


def test_each_evaluation_starts_from_the_previous_and_a_repeated_evaluation_from_itself():
    simulation = RecordedStarts()
    continuation = Continuation(simulation, lambda p: (p, {}), SolutionStub(0.0))
    for value in (1.0, 2.0, 2.0, 1.0):
        continuation(torch.tensor([value]))
    assert simulation.starts == [
        SolutionStub(0.0),
        SolutionStub(1.0),
        SolutionStub(2.0),
        SolutionStub(1.0, whole=False),
    ]
    assert continuation.near(torch.tensor([2.0])) == SolutionStub(2.0, whole=False)
    assert continuation.near(torch.tensor([3.0])) == SolutionStub(1.0, whole=False)


def test_evaluations_inside_of_a_transform_are_not_kept():
    simulation = RecordedStarts()
    continuation = Continuation(simulation, lambda p: (p, {}), SolutionStub(0.0))
    assert prepared().answer(theta(4.0), {}).nearby is not None
    seen = []
    torch.func.jvp(lambda p: seen.append(prepared().answer(p, {})) or seen[0].residual, (theta(4.0),), (theta(1.0),))
    assert seen[0].nearby is None
    assert continuation.near(torch.tensor([1.0])) == SolutionStub(0.0, whole=False)
