"""The interface of a prepared system for observers, and its modified copies."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance, ObserverJump
from tests.simulation.dynamics.oscillating import course, disturbed_states, flow, oscillator, recorded, theta_of
from tests.simulation.dynamics.runge_kutta import runge_kutta

N = 60
TIME = 0.05 * np.arange(N)
FORCE = np.sin(8.0 * TIME) + 0.3
DISTURBANCES = (
    Disturbance("position", False, 2.0, 0.1),
    Disturbance("speed", True, 0.0, 1.0),
    Disturbance("speed", True, 2.0, 1.0),
)


def driven(self, time, x, u, p):
    return {"position": x.speed, "speed": u.force - p.stiffness * x.position - p.damping * x.speed}


def forced_oscillator(random=1.0, **attributes):
    """Return a prepared oscillator with a recorded force, and its parameters."""
    along, draws = flow(N), np.random.default_rng(0)
    force = FORCE + course(draws, along, 0.0, random)
    position = disturbed_states(along, force)[:, 0] + 0.01 * random * draws.standard_normal(N)
    system = oscillator(**{"inputs": ("force",), "derivative": driven, "step": 0.01, **attributes})
    prepared = system.prepare(recorded(along, position=position, force=FORCE))
    return prepared, theta_of(prepared)


def observer_for(prepared, theta, *disturbances):
    along = flow_of(prepared, theta, {}, None)
    return observer_of(along, disturbances, theta.new_tensor([0.01]), prepared.disturbable, prepared.channels)


class TestInputHold:
    """Copies with another input hold."""

    @pytest.mark.parametrize("how", ["held", "linear"])
    def test_the_input_hold_matches_stepwise_integration(self, how):
        prepared, theta = forced_oscillator()

        def rate(t, y):
            place = np.floor(t / 0.05 + 1e-9)
            force = FORCE[min(int(place), N - 1)] if how == "held" else np.interp(t, TIME, FORCE)
            return np.array([y[1], force - theta[0].item() * y[0] - theta[1].item() * y[1]])

        states = [np.zeros(2)]
        for early, late in pairwise(TIME):

            def inside(t, y, late=late):
                # the held value has not changed yet
                return rate(min(t, late - 1e-7), y)

            states.append(runge_kutta(inside, states[-1], (early, late))[-1])
        found = prepared.with_input_hold({"force": how}).simulated(theta, {})[:, 0]
        np.testing.assert_allclose(found.numpy(), np.stack(states)[:, 0], atol=1e-6)

    def test_the_original_is_unchanged_and_caches_are_dropped(self):
        prepared, theta = forced_oscillator(random=0.0, parameters={"stiffness": 2.0, "damping": 5.0})
        before, start = prepared.simulated(theta, {}), prepared.start()
        other = prepared.with_input_hold({"force": "held"})
        assert (prepared.input_hold, other.input_hold) == ({"force": "linear"}, {"force": "held"})
        assert float((other.simulated(theta, {}) - before).abs().max()) > 1e-3
        assert torch.equal(prepared.simulated(theta, {}), before)
        assert torch.equal(prepared.start(), start)
        assert not torch.equal(other.start(), start)
        back = other.with_input_hold({"force": "linear"})
        torch.testing.assert_close(back.simulated(theta, {}), before)

    def test_the_input_hold_of_a_copy_equals_a_declared_input_hold(self):
        prepared, theta = forced_oscillator()
        declared, _ = forced_oscillator(input_hold="smooth")
        torch.testing.assert_close(
            prepared.with_input_hold({"force": "smooth"}).simulated(theta, {}), declared.simulated(theta, {})
        )


class TestObserved:
    """Copies with an observer."""

    def test_a_copy_has_the_observer_and_the_original_stays_open_loop(self):
        prepared, theta = forced_oscillator()
        observer = observer_for(prepared, theta, *DISTURBANCES)
        corrected = prepared.observed(observer)
        assert (prepared.observer, prepared.lasting, prepared.jump(theta, {})) == (None, (), None)
        assert corrected.observer is observer
        assert corrected.lasting == (DISTURBANCES[0], DISTURBANCES[2])
        assert isinstance(corrected.jump(theta, {}), ObserverJump)
        assert corrected.observed(observer) is corrected
        assert prepared.observed(None) is prepared
        free = corrected.observed(None)
        assert torch.equal(free.residual(theta, {}), prepared.residual(theta, {}))
        assert torch.equal(corrected.start(), prepared.start())

    def test_residuals_with_an_observer_are_smaller_and_whitened(self):
        prepared, theta = forced_oscillator()
        corrected = prepared.observed(observer_for(prepared, theta, *DISTURBANCES))
        left = corrected.measured - corrected.simulated(theta, {})
        assert float(left.std()) < 0.5 * float(prepared.residual(theta, {}).std())
        torch.testing.assert_close(corrected.residual(theta, {}), corrected.observer.whitened(left))

    def test_residuals_do_not_depend_on_the_initial_trajectory(self):
        prepared, theta = forced_oscillator()
        corrected = prepared.observed(observer_for(prepared, theta, *DISTURBANCES))
        near = corrected.answer(1.01 * theta, {}).nearby
        assert near.states.shape[1] == 4
        alone = corrected.answer(theta, {}).residual
        for beginning in (near, near.bare, prepared.answer(theta, {}).nearby):
            torch.testing.assert_close(corrected.answer(theta, {}, beginning).residual, alone, rtol=0.0, atol=1e-8)
        free = prepared.answer(theta, {}).residual
        torch.testing.assert_close(prepared.answer(theta, {}, near).residual, free, rtol=0.0, atol=1e-8)

    def test_effects_act_with_an_observer(self):
        """A force that an effect adds has the same residual as the same force in the equations."""

        def without(self, time, x, u, p):
            return {"position": x.speed, "speed": 0.0 * u.force - p.stiffness * x.position - p.damping * x.speed}

        prepared, theta = forced_oscillator()
        lacking, _ = forced_oscillator(derivative=without)
        observer = observer_for(prepared, theta, *DISTURBANCES)
        force = lacking.inputs
        changes = {"rate of speed": lambda _: force}
        found = lacking.observed(observer).residual(theta, changes)
        torch.testing.assert_close(found, prepared.observed(observer).residual(theta, {}), rtol=0.0, atol=1e-8)


class TestGuess:
    """Copies with a trajectory's states as the guess."""

    def test_unmeasured_states_have_a_size(self):
        prepared, theta = forced_oscillator()
        near = prepared.answer(theta, {}).nearby
        other = prepared.guessed(near)
        assert torch.equal(other.guess, near.states)
        assert not torch.equal(prepared.guess, near.states)
        sizes = other.ports["rate of speed"].sizes
        assert sizes["own"].largest == pytest.approx(float(near.states[prepared.rows, 1].abs().max()))
        assert sizes["own"].largest != prepared.ports["rate of speed"].sizes["own"].largest

    def test_states_of_the_observer_are_not_part_of_the_guess(self):
        prepared, theta = forced_oscillator()
        corrected = prepared.observed(observer_for(prepared, theta, *DISTURBANCES))
        assert corrected.guessed(corrected.answer(theta, {}).nearby).guess.shape[1] == 2

    def test_the_simulation_is_unchanged_without_a_trajectory(self):
        prepared, _ = forced_oscillator()
        assert prepared.guessed(None) is prepared


class TestObserverInterface:
    """The properties that an observer uses."""

    def test_disturbable_states_are_those_that_are_not_positions(self):
        prepared, _ = forced_oscillator()
        assert prepared.disturbable == ("speed",)

        def derivative(self, time, x, u, p):
            return {"position": x.speed - p.damping * x.position, "speed": u.force - p.stiffness * x.position}

        assert forced_oscillator(derivative=derivative)[0].disturbable == ("position", "speed")

    def test_drift_of_an_output_is_added_to_this_output_only(self):
        prepared, theta = forced_oscillator()
        corrected = prepared.observed(observer_for(prepared, theta, *DISTURBANCES))
        states = torch.arange(5.0).double()[:, None] + torch.tensor([100.0, 200.0, 10.0, 20.0]).double()
        assert torch.equal(corrected.output_disturbance(states), states[:, [2]])
        assert torch.equal(prepared.output_disturbance(states), torch.zeros(5, 1).double())

    def test_the_contribution_of_the_sensor_is_subtracted_from_the_recording(self):
        def sensor(self, time, y, p, run):
            return {"position": y["position"] + 0.2 * time + 0.1 * y["position"] ** 2}

        prepared, theta = forced_oscillator(sensor=sensor)
        at = prepared.trajectory(theta, {}).states[prepared.rows]
        torch.testing.assert_close(prepared.predicted(prepared.acting_at_samples(theta, {}), {})(at), at[:, :1])
        clean = prepared.clean
        made = 0.2 * prepared.time[:, None] + 0.1 * clean**2
        torch.testing.assert_close(prepared.seen(theta, {}), prepared.measured - made)
        effect = {"output": lambda signal: 0.5 * signal}
        more = made + 0.5 * (clean + made)
        torch.testing.assert_close(prepared.seen(theta, effect), prepared.measured - more)

    def test_sensor_errors_do_not_correct_the_states(self):
        """Corrections compare the recording with the states as the sensor would measure them."""

        def sensor(self, time, y, p, run):
            return {"position": y["position"] + 3.0 * torch.sin(time)}

        prepared, theta = forced_oscillator()
        along = recorded(flow(N), position=prepared.measured[:, 0] + 3.0 * prepared.time.sin(), force=FORCE)
        shifted = oscillator(inputs=("force",), derivative=driven, step=0.01, sensor=sensor).prepare(along)
        observer = observer_for(prepared, theta, *DISTURBANCES)
        torch.testing.assert_close(
            shifted.observed(observer).residual(theta, {}), prepared.observed(observer).residual(theta, {})
        )

    def test_corrections_skip_internal_states_of_effects(self):
        prepared, theta = forced_oscillator()
        corrected = prepared.observed(observer_for(prepared, theta, *DISTURBANCES))
        name = next(name for name, port in prepared.ports.items() if len(port.memory) == 1)
        width = len(prepared.ports[name].channels)

        def change(signal):
            # an internal state that follows the first signal, and no addition
            return torch.cat([torch.zeros(len(signal), width).double(), signal[:, :1] - signal[:, -1:]], -1)

        assert corrected.jump(theta, {}).places == (0, 1, 2, 3)
        assert corrected.jump(theta, {name: change}).places == (0, 1, 3, 4)
        found = corrected.trajectory(theta, {name: change})
        assert found.states.shape[1] == 5
        torch.testing.assert_close(corrected.residual(theta, {name: change}), corrected.residual(theta, {}))
