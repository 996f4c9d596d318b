"""A simulation that steps follows its own steps, with exact derivatives of the whole rollout."""

import pickle

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mkc_torch.recording import Recording
from mkc_torch.recording.recording import MissingColumnError
from mkc_torch.simulation import SimulationError, Stepper
from mkc_torch.simulation.names import Names
from tests.simulation.stepped.models import Equations, Steps


def recording_of(rows=60, sample=0.02, **more):
    time = sample * torch.arange(rows, dtype=torch.float64)
    torque = torch.where((time / 0.3).floor() % 2 == 0, 1.0, -0.5).double()
    return Recording({"time": time, "torque": torque, "angle": 0.3 * torch.cos(2.8 * time), **more})


def stepped_by_hand(theta, inputs, friction, parts=2):
    """Angles and speeds at the samples, step by step in NumPy."""
    p = Names(inertia=theta[0], weight=theta[1], damping=theta[2])
    x, found = np.array([theta[3:]]), []
    for torque in inputs:
        found.append(x[0])
        for _ in range(parts):
            moment = np.array([[-friction * np.tanh(x[0, 1] / 0.05)]])
            x = Steps().step(x, np.array([[torque]]), moment, p, 0.01)
    return np.array(found)


@settings(deadline=None, max_examples=10)
@given(st.floats(0.3, 0.9), st.floats(2.0, 6.0), st.floats(-1.0, 1.0), st.floats(0.0, 0.3))
@example(0.5, 2.0, 0.0, 5e-324)  # a force whose differences round to 0
def test_the_trajectory_is_that_of_single_steps(inertia, weight, angle, friction):
    recording = recording_of()
    prepared = Steps().prepare(recording)
    theta = torch.tensor([inertia, weight, 0.1, angle, 0.2], dtype=torch.float64)
    changes = {"entry of moment": lambda signal: -friction * torch.tanh(signal[:, [1]] / 0.05)}
    found = prepared.trajectory(theta, changes)
    assert found.converged
    expected = stepped_by_hand(theta.tolist(), recording["torque"].tolist(), friction)
    np.testing.assert_allclose(found.states[prepared.rows].numpy(), expected, atol=1e-9)  # Newton stops there


def test_derivatives_are_those_of_the_whole_rollout():
    prepared = Steps().prepare(recording_of())
    theta = torch.tensor([0.5, 4.0, 0.1, 0.3, 0.2], dtype=torch.float64)

    def residual(values):
        changes = {"entry of moment": lambda signal: -values[5] * torch.tanh(signal[:, [1]] / 0.05)}
        return prepared.residual(values[:5], changes, prepared.trajectory(theta, {}))

    theta = torch.cat([theta, theta.new_tensor([0.1])])
    near = theta.clone()
    theta, start = near[:5], near
    found = torch.func.jacfwd(residual)(start)
    for k in range(6):
        step = torch.zeros_like(start)
        step[k] = 1e-5
        expected = (residual(start + step) - residual(start - step)) / 2e-5
        torch.testing.assert_close(found[..., k], expected, rtol=2e-5, atol=2e-5 * float(expected.abs().max()))


def test_a_fine_stepper_equals_the_differential_equation():
    recording = recording_of()
    values = torch.tensor([0.5, 4.0, 0.1, 0.3, 0.2], dtype=torch.float64)
    friction = {"rate of speed": lambda signal: -0.2 * torch.tanh(signal[:, [1]] / 0.5)}
    moment = {"entry of moment": lambda signal: -0.1 * torch.tanh(signal[:, [1]] / 0.5)}  # through the inertia of 0.5
    fine = type("Fine", (Steps,), {"time_step": 0.0025})
    expected = Equations().prepare(recording).residual(values, friction)
    found = fine().prepare(recording).residual(values, moment)
    # the force is held over a step
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
    coarse = Steps().prepare(recording).residual(values, moment)
    assert (coarse - expected).abs().max() > 2 * (found - expected).abs().max()


def test_a_gap_between_samples_has_as_many_steps_as_it_lasts():
    recording = recording_of(rows=40).rows(torch.arange(40) != 20)
    prepared = Steps().prepare(recording)
    theta = torch.tensor([0.5, 4.0, 0.1, 0.3, 0.2], dtype=torch.float64)
    whole = Steps().prepare(recording_of(rows=40))
    assert len(prepared.grid.time) == len(whole.grid.time)
    torque = recording_of(rows=40)["torque"]
    assert torque[19] == torque[20]  # held over the gap
    torch.testing.assert_close(
        prepared.simulated(theta, {}), whole.simulated(theta, {})[torch.arange(40) != 20], atol=1e-12, rtol=0
    )


def test_samples_that_are_no_whole_steps_apart_are_stated():
    uneven = Steps().prepare(recording_of(sample=0.0203)).recording.notes
    assert uneven == (
        "Samples are 0.0203 s apart, and a step of Steps lasts 0.01 s: for each sample 2 steps are taken, as if they "
        "lasted 0.01015 s each.",
    )
    assert Steps().prepare(recording_of()).recording.notes == ()


def test_each_run_has_its_own_start_and_forces_are_no_columns():
    two = torch.arange(60) // 30
    recording = recording_of(experiment=two.double())
    prepared = Steps().prepare(recording)
    assert prepared.parameter_names[-1] == "speed at the start of 1"
    assert "entry of moment" in prepared.ports
    assert not {"input moment", "rate of speed"} & set(prepared.ports)
    assert prepared.ports["entry of moment"].unit == "N m"
    theta = torch.tensor([0.5, 4.0, 0.1, 0.3, 0.2, -0.4, 0.1], dtype=torch.float64)
    expected = stepped_by_hand([0.5, 4.0, 0.1, -0.4, 0.1], recording["torque"][30:].tolist(), 0.0)[:, 0]
    np.testing.assert_allclose(prepared.simulated(theta, {})[30:, 0].numpy(), expected, atol=1e-10)


def test_a_prepared_recording_is_prepared_again():
    prepared = Steps().prepare(recording_of())
    again = Steps().prepare(prepared.recording)
    torch.testing.assert_close(again.residual(prepared.given, {}), prepared.residual(prepared.given, {}))


def test_a_stepper_survives_pickling():
    prepared = Steps().prepare(recording_of())
    theta = prepared.given
    again = pickle.loads(pickle.dumps(prepared))
    torch.testing.assert_close(again.residual(theta, {}), prepared.residual(theta, {}), atol=0, rtol=0)


class Still(Steps):
    time_step = 0.0


class Narrow(Steps):
    def step(self, x, u, tau, p, dt):
        return x[:, :1]


class Diverging(Steps):
    def step(self, x, u, tau, p, dt):
        return x * np.nan


@pytest.mark.parametrize(
    ("kind", "columns", "error", "message"),
    [
        (Steps, {"moment": torch.ones(60)}, SimulationError, "column `moment`, the name of a force"),
        (
            type("Still", (Steps,), {"time_step": 0.0}),
            {},
            SimulationError,
            "`time_step` expected a length in s above 0",
        ),
        (Narrow, {}, SimulationError, r"Narrow.step: expected states of shape \(.*, 2\), like x, but got \(.*, 1\)"),
        (Diverging, {}, SimulationError, "the rate of `angle` is nan at time"),
        (type("Other", (Steps,), {"inputs": ("force",)}), {}, MissingColumnError, "force"),
        (type("Plain", (Stepper,), {"states": ("angle",), "time_step": 0.01}), {}, NotImplementedError, "has no `step"),
    ],
)
def test_errors_name_what_is_wrong(kind, columns, error, message):
    with pytest.raises(error, match=message):
        kind().prepare(recording_of(**columns))
