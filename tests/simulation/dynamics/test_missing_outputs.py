"""Outputs that are missing at some samples: the inputs there still act, and no missing value is compared."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from mkc_torch import Recording, diagnose
from mkc_torch.effects.dynamics.constant_force import ConstantForce
from mkc_torch.effects.dynamics.coulomb_friction import CoulombFriction
from mkc_torch.effects.dynamics.input_delay import InputDelay
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from mkc_torch.recording.recording import RecordingError
from mkc_torch.simulation import Dynamics
from mkc_torch.simulation.dynamics.prepared import PreparedDynamics

TIME = np.arange(1500) / 100.0
INERTIA, DAMPING = 0.11, 0.02


class Disc(Dynamics):
    states, inputs, outputs = ("angle", "speed"), ("torque",), ("angle",)
    parameters = {"inertia": 0.1, "damping": 0.02}
    units = {"angle": "rad", "speed": "rad/s", "torque": "N m"}

    def derivative(self, time, x, u, p):
        return {"angle": x.speed, "speed": (u.torque - p.damping * x.speed) / p.inertia}


class Held(Disc):
    input_hold = "held"


class TwoSensors(Disc):
    outputs = ("angle", "speed")


def drive(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    frequency, phase, size = random.uniform(0.2, 2.5, 6), random.uniform(0.0, 6.28, 6), random.uniform(0.05, 0.15, 6)
    return (size * np.sin(2.0 * np.pi * frequency * TIME[:, None] + phase)).sum(1)


def integrated(torque: np.ndarray, friction: float, inertia: float, damping: float) -> np.ndarray:
    """The states at all times, by SciPy; dry friction as a steep hyperbolic tangent."""

    def rate(t: float, x: np.ndarray) -> tuple[float, float]:
        force = np.interp(t, TIME, torque) - damping * x[1] - friction * np.tanh(x[1] / 0.004)
        return x[1], force / inertia

    found = solve_ivp(rate, (0.0, TIME[-1]), (0.0, 0.0), "LSODA", TIME, rtol=1e-6, atol=1e-8, max_step=0.01)
    return found.y.T


@cache
def truth(seed: int, friction: float) -> tuple[np.ndarray, np.ndarray]:
    torque = drive(seed)
    return torque, integrated(torque, friction, INERTIA, DAMPING)


def at_every(values: np.ndarray, number: int) -> np.ndarray:
    found = np.full_like(values, np.nan)
    found[::number] = values[::number]
    return found


def table(rows: slice = slice(None), **columns: np.ndarray) -> Recording:
    units = {name: Disc.units[name] for name in columns if name != "time"}
    return Recording({name: torch.tensor(values[rows]) for name, values in columns.items()}, units=units)


class TestInputsBetweenSamples:
    def test_the_simulation_follows_an_input_of_a_higher_rate(self):
        """At 1 Hz the torque, of up to 2.5 Hz, is unrecognisable; the simulated angle is SciPy's."""
        torque, states = truth(1, 0.0)
        prepared = Disc().prepare(table(time=TIME, torque=torque, angle=at_every(states[:, 0], 100)))
        assert len(prepared.time) == 15
        angle = prepared.simulated(torch.tensor([INERTIA, DAMPING, 0.0, 0.0]).double(), {})[:, 0]
        np.testing.assert_allclose(angle.numpy(), states[::100, 0], atol=2e-4)

    def test_a_change_at_a_row_without_an_output_comes_in_time(self):
        torque = (TIME[49] < TIME).astype(float)
        full = integrated(torque, 0.0, INERTIA, DAMPING)[:, 0]
        angle = full.copy()
        angle[[20, 50, 51, 52]] = np.nan
        prepared = Held().prepare(table(time=TIME, torque=torque, angle=angle))
        kept = np.isfinite(angle)
        theta = torch.tensor([INERTIA, DAMPING, 0.0, 0.0]).double()
        found = prepared.simulated(theta, {})[:, 0].numpy()
        whole = Held().prepare(table(time=TIME, torque=torque, angle=full)).simulated(theta, {})
        np.testing.assert_allclose(found, whole[:, 0].numpy()[kept], atol=1e-9)

    def test_rows_before_the_first_sample_of_a_run_do_not_drive_it(self):
        torque, states = truth(1, 0.0)
        angle = states[:, 0].copy()
        angle[:100], angle[-100:] = np.nan, np.nan
        prepared = Disc().prepare(table(time=TIME, torque=torque, angle=angle))
        assert float(prepared.grid.time[0]) == 1.0
        assert float(prepared.grid.time[-1]) == float(prepared.time[-1])

    def test_a_note_counts_the_missing_outputs(self):
        torque, states = truth(1, 0.0)
        notes = Disc().prepare(table(time=TIME, torque=torque, angle=at_every(states[:, 0], 100))).recording.notes
        assert notes == ("`angle` is missing at 1485 of 1500 samples, whose inputs are kept.",)

    def test_an_output_without_any_value_raises(self):
        with pytest.raises(RecordingError, match="no sample has finite values in all of `speed`"):
            TwoSensors().prepare(table(time=TIME, torque=TIME, angle=TIME, speed=np.full_like(TIME, np.nan)))


class TestOutputsOfDifferentRates:
    def residual(self, missing: float) -> tuple[torch.Tensor, PreparedDynamics]:
        torque, states = truth(1, 0.0)
        angle, speed = at_every(states[:, 0] + 0.1, 4), at_every(states[:, 1], 10)
        speed[~np.isfinite(speed)] = missing
        prepared = TwoSensors().prepare(table(time=TIME, torque=torque, angle=angle, speed=speed))
        return prepared.residual(prepared.start(), {}), prepared

    def test_the_residual_of_a_missing_output_is_that_of_the_nearest_sample(self):
        left, prepared = self.residual(np.nan)
        recorded = prepared.recorded
        assert recorded is not None
        assert recorded.sum(0).tolist() == [375, 150]
        for column, used in zip(left.unbind(-1), recorded.unbind(-1), strict=True):
            gap = (prepared.time[:, None] - prepared.time[used]).abs()
            near = (column[:, None] == column[used]) & (gap <= gap.amin(1, keepdim=True) + 1e-9)
            assert near.any(1).all()

    def test_an_infinite_output_is_missing(self):
        assert torch.equal(self.residual(np.inf)[0], self.residual(np.nan)[0])

    def test_a_compiled_residual_and_its_tangents_are_those_of_torch(self):
        left, prepared = self.residual(np.nan)
        compiled = prepared.compiled(lambda theta: (theta, {}), 4)
        assert compiled is not None
        theta = prepared.start()
        found = compiled.answer(theta)
        torch.testing.assert_close(found.residual, left, rtol=0.0, atol=1e-8)
        tangents = compiled.tangents(theta, found.nearby)
        assert tangents is not None
        rows = torch.func.jacfwd(lambda values: prepared.residual(values, {}))(theta)
        torch.testing.assert_close(tangents.rows.movedim(0, -1), rows, rtol=1e-5, atol=1e-6)


def by_hand(torque: np.ndarray, outputs: dict[int, tuple[np.ndarray, float]]) -> float:
    """Friction over inertia by least squares with SciPy, on the recorded outputs alone."""

    def left(values: np.ndarray) -> np.ndarray:
        friction, inertia, damping = values
        states = integrated(torque, friction * inertia, inertia, damping)
        parts = [(values - states[:, k]) / noise for k, (values, noise) in outputs.items()]
        return np.concatenate([part[np.isfinite(part)] for part in parts])

    found = least_squares(left, (0.3, 0.1, 0.02), x_scale=(0.1, 0.02, 0.01), diff_step=1e-3)
    return float(found.x[0])


def recorded(kind: str, seed: int, friction: float) -> tuple[Dynamics, Recording, dict[int, tuple[np.ndarray, float]]]:
    """A simulation, a recording with missing outputs, and these outputs at all times with their noise."""
    random, (torque, states) = np.random.default_rng(seed + 50), truth(seed, friction)
    angle = states[:, 0] + random.normal(0.0, 0.003, 1500)
    speed = states[:, 1] + random.normal(0.0, 0.02, 1500)
    rows = slice(None)
    if kind == "slow":
        angle = at_every(angle, 25)
        return Disc(), table(time=TIME, torque=torque, angle=angle), {0: (angle, 0.003)}
    if kind == "rates":
        angle, speed = at_every(angle, 10), at_every(speed, 25)
    else:
        speed[500:1000] = np.nan
        angle, speed, rows = at_every(angle, 5), at_every(speed, 5), slice(None, None, 5)
    recording = table(rows, time=TIME, torque=torque, angle=angle, speed=speed)
    return TwoSensors(), recording, {0: (angle, 0.003), 1: (speed, 0.02)}


KINDS = {"a sensor slower than the input": "slow", "two rates": "rates", "a sensor that fails": "stretch"}
CANDIDATES = (CoulombFriction(), QuadraticDrag(), InputDelay(), ConstantForce())


@pytest.mark.e2e
@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, id=name, marks=[pytest.mark.slow] * (kind != "rates")) for name, kind in KINDS.items()],
)
class TestDiagnosesWithMissingOutputs:
    def test_hidden_friction_is_found_with_the_size_of_an_independent_fit(self, kind):
        system, recording, outputs = recorded(kind, 1, 0.05)
        found = diagnose(system, recording, effects=CANDIDATES, surrogates=19, max_findings=1)
        assert found.verdict == "explained"
        (finding,) = found.findings
        assert finding.effect == "coulomb_friction"
        (friction,) = finding.parameters
        size = by_hand(drive(1), outputs)
        assert friction.value == pytest.approx(0.05 / INERTIA, abs=3.0 * friction.standard_error)
        assert friction.value == pytest.approx(size, abs=2.0 * friction.standard_error)

    def test_without_friction_nothing_is_found(self, kind):
        system, recording, _ = recorded(kind, 1, 0.0)
        found = diagnose(system, recording, effects=CANDIDATES, surrogates=19, max_findings=1)
        assert (found.verdict, found.findings) == ("adequate", ())
        for fit in found.environment.goodness_of_fit:
            assert fit.residual == pytest.approx({"angle": 0.003, "speed": 0.02}[fit.output], rel=0.25)
            # unknown where the output changes too fast for its own samples
            known = pytest.approx({"angle": 0.003, "speed": 0.02}[fit.output], rel=0.25)
            assert math.isnan(fit.noise_floor) or fit.noise_floor == known


@pytest.mark.e2e
def test_a_sensor_that_records_in_a_short_stretch_only_is_compared_there():
    """No fold of held-out blocks but one has its values; the first run has none of them."""
    random, (torque, states) = np.random.default_rng(4), truth(1, 0.0)
    rows = slice(None, None, 5)
    angle = states[:, 0] + random.normal(0.0, 0.003, 1500)
    speed = np.full(1500, np.nan)
    speed[1000:1060] = states[1000:1060, 1] + random.normal(0.0, 0.02, 60)
    recording = table(rows, time=TIME, torque=torque, angle=angle, speed=speed)
    found = diagnose(TwoSensors(), recording, effects=(CoulombFriction(),), surrogates=19, max_findings=1)
    assert found.findings == ()
    angle_fit, _ = found.environment.goodness_of_fit
    assert angle_fit.residual == pytest.approx(0.003, rel=0.15)
