"""The side of a prepared system that an observer sees, and copies of it that know something else."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance, ObserverJump
from tests.simulation.dynamics.oscillating import course, flow, oscillator, pushed, recorded, theta_of
from tests.simulation.dynamics.runge_kutta import runge_kutta

N = 60
TIME = 0.05 * np.arange(N)
FORCE = np.sin(8.0 * TIME) + 0.3
PUSHES = (
    Disturbance("position", False, 2.0, 0.1),
    Disturbance("speed", True, 0.0, 1.0),
    Disturbance("speed", True, 2.0, 1.0),
)


def driven(self, time, x, u, p):  # noqa: ARG001
    return {"position": x.speed, "speed": u.force - p.stiffness * x.position - p.damping * x.speed}


def world(random=1.0, **attributes):
    """A prepared oscillator with a force of which it knows, and its parameters."""
    along, draws = flow(N), np.random.default_rng(0)
    push = FORCE + course(draws, along, 0.0, random)
    position = pushed(along, push)[:, 0] + 0.01 * random * draws.standard_normal(N)
    system = oscillator(**{"inputs": ("force",), "derivative": driven, "step": 0.01, **attributes})
    prepared = system.prepare(recorded(along, position=position, force=FORCE))
    return prepared, theta_of(prepared)


def observer_for(prepared, theta, *pushes):
    along = flow_of(prepared, theta, {}, None)
    return observer_of(along, pushes, theta.new_tensor([0.01]), prepared.pushable, prepared.channels)


class TestHolding:
    """Inputs that do something else between samples."""

    @pytest.mark.parametrize("how", ["held", "linear"])
    def test_it_is_simulated_with_the_input_held_so(self, how):
        prepared, theta = world()

        def rate(t, y):
            place = np.floor(t / 0.05 + 1e-9)
            force = FORCE[min(int(place), N - 1)] if how == "held" else np.interp(t, TIME, FORCE)
            return np.array([y[1], force - theta[0].item() * y[0] - theta[1].item() * y[1]])

        states = [np.zeros(2)]
        for early, late in pairwise(TIME):

            def inside(t, y, late=late):
                # the value that is held has not changed yet
                return rate(min(t, late - 1e-7), y)

            states.append(runge_kutta(inside, states[-1], (early, late))[-1])
        found = prepared.holding({"force": how}).simulated(theta, {})[:, 0]
        np.testing.assert_allclose(found.numpy(), np.stack(states)[:, 0], atol=1e-6)

    def test_the_original_stays_and_nothing_found_is_kept(self):
        prepared, theta = world(random=0.0, parameters={"stiffness": 2.0, "damping": 5.0})
        before, start = prepared.simulated(theta, {}), prepared.start()
        other = prepared.holding({"force": "held"})
        assert (prepared.input_hold, other.input_hold) == ({"force": "linear"}, {"force": "held"})
        assert float((other.simulated(theta, {}) - before).abs().max()) > 1e-3
        assert torch.equal(prepared.simulated(theta, {}), before)
        assert torch.equal(prepared.start(), start)
        assert not torch.equal(other.start(), start)
        back = other.holding({"force": "linear"})
        torch.testing.assert_close(back.simulated(theta, {}), before)

    def test_it_is_the_same_as_declared(self):
        prepared, theta = world()
        declared, _ = world(between="smooth")
        torch.testing.assert_close(
            prepared.holding({"force": "smooth"}).simulated(theta, {}), declared.simulated(theta, {})
        )


class TestObserved:
    """Predicted from sample to sample."""

    def test_a_copy_is_watched_and_the_original_is_free(self):
        prepared, theta = world()
        observer = observer_for(prepared, theta, *PUSHES)
        watched = prepared.observed(observer)
        assert (prepared.observer, prepared.lasting, prepared.jump(theta, {})) == (None, (), None)
        assert watched.observer is observer
        assert watched.lasting == (PUSHES[0], PUSHES[2])
        assert isinstance(watched.jump(theta, {}), ObserverJump)
        assert watched.observed(observer) is watched
        assert prepared.observed(None) is prepared
        free = watched.observed(None)
        assert torch.equal(free.residual(theta, {}), prepared.residual(theta, {}))
        assert torch.equal(watched.start(), prepared.start())

    def test_what_is_left_is_smaller_and_whitened(self):
        prepared, theta = world()
        watched = prepared.observed(observer_for(prepared, theta, *PUSHES))
        left = watched.measured - watched.simulated(theta, {})
        assert float(left.std()) < 0.5 * float(prepared.residual(theta, {}).std())
        torch.testing.assert_close(watched.residual(theta, {}), watched.observer.whitened(left))

    def test_an_answer_begins_where_another_ended(self):
        prepared, theta = world()
        watched = prepared.observed(observer_for(prepared, theta, *PUSHES))
        near = watched.answer(1.01 * theta, {}).nearby
        assert near.states.shape[1] == 4
        alone = watched.answer(theta, {}).residual
        for beginning in (near, near.bare, prepared.answer(theta, {}).nearby):
            torch.testing.assert_close(watched.answer(theta, {}, beginning).residual, alone, rtol=0.0, atol=1e-8)
        free = prepared.answer(theta, {}).residual
        torch.testing.assert_close(prepared.answer(theta, {}, near).residual, free, rtol=0.0, atol=1e-8)

    def test_an_effect_acts_in_a_watched_run_too(self):
        """A force that is missing in the equations and added by an effect leaves what the whole equations leave."""

        def without(self, time, x, u, p):  # noqa: ARG001
            return {"position": x.speed, "speed": 0.0 * u.force - p.stiffness * x.position - p.damping * x.speed}

        prepared, theta = world()
        lacking, _ = world(derivative=without)
        observer = observer_for(prepared, theta, *PUSHES)
        force = lacking.inputs
        changes = {"rate of speed": lambda _: force}
        found = lacking.observed(observer).residual(theta, changes)
        torch.testing.assert_close(found, prepared.observed(observer).residual(theta, {}), rtol=0.0, atol=1e-8)


class TestGuessed:
    """States of a trajectory as the guess."""

    def test_states_that_no_output_shows_have_a_size_then(self):
        prepared, theta = world()
        near = prepared.answer(theta, {}).nearby
        other = prepared.guessed(near)
        assert torch.equal(other.guess, near.states)
        assert not torch.equal(prepared.guess, near.states)
        sizes = other.ports["rate of speed"].sizes
        assert sizes["own"].largest == pytest.approx(float(near.states[prepared.rows, 1].abs().max()))
        assert sizes["own"].largest != prepared.ports["rate of speed"].sizes["own"].largest

    def test_states_of_an_observer_are_none_of_the_system(self):
        prepared, theta = world()
        watched = prepared.observed(observer_for(prepared, theta, *PUSHES))
        assert watched.guessed(watched.answer(theta, {}).nearby).guess.shape[1] == 2

    def test_without_a_trajectory_it_is_the_same(self):
        prepared, _ = world()
        assert prepared.guessed(None) is prepared


class TestWatched:
    """What an observer is given to see."""

    def test_what_can_be_pushed_is_what_is_no_position(self):
        prepared, _ = world()
        assert prepared.pushable == ("speed",)

        def derivative(self, time, x, u, p):  # noqa: ARG001
            return {"position": x.speed - p.damping * x.position, "speed": u.force - p.stiffness * x.position}

        assert world(derivative=derivative)[0].pushable == ("position", "speed")

    def test_a_lasting_push_of_an_output_is_added_to_it_alone(self):
        prepared, theta = world()
        watched = prepared.observed(observer_for(prepared, theta, *PUSHES))
        states = torch.arange(5.0).double()[:, None] + torch.tensor([100.0, 200.0, 10.0, 20.0]).double()
        assert torch.equal(watched.pushed_outputs(states), states[:, [2]])
        assert torch.equal(prepared.pushed_outputs(states), torch.zeros(5, 1).double())

    def test_what_a_sensor_makes_of_an_output_is_taken_off_the_recording(self):
        def sensor(self, time, y, p, run):  # noqa: ARG001
            return {"position": y["position"] + 0.2 * time + 0.1 * y["position"] ** 2}

        prepared, theta = world(sensor=sensor)
        at = prepared.trajectory(theta, {}).states[prepared.rows]
        torch.testing.assert_close(prepared.predicted(theta)(at), at[:, :1])
        clean = prepared.clean
        made = 0.2 * prepared.time[:, None] + 0.1 * clean**2
        torch.testing.assert_close(prepared.seen(theta, {}), prepared.measured - made)
        effect = {"output": lambda signal: 0.5 * signal}
        more = made + 0.5 * (clean + made)
        torch.testing.assert_close(prepared.seen(theta, effect), prepared.measured - more)

    def test_a_gain_of_the_sensor_is_no_error_of_the_states(self):
        """States are corrected by what the sensor would have seen of them."""

        def sensor(self, time, y, p, run):  # noqa: ARG001
            return {"position": y["position"] + 3.0 * torch.sin(time)}

        prepared, theta = world()
        along = recorded(flow(N), position=prepared.measured[:, 0] + 3.0 * prepared.time.sin(), force=FORCE)
        shifted = oscillator(inputs=("force",), derivative=driven, step=0.01, sensor=sensor).prepare(along)
        observer = observer_for(prepared, theta, *PUSHES)
        torch.testing.assert_close(
            shifted.observed(observer).residual(theta, {}), prepared.observed(observer).residual(theta, {})
        )

    def test_corrections_stand_beside_internal_states_of_effects(self):
        prepared, theta = world()
        watched = prepared.observed(observer_for(prepared, theta, *PUSHES))
        name = next(name for name, port in prepared.ports.items() if len(port.memory) == 1)
        width = len(prepared.ports[name].channels)

        def change(signal):
            # remembers the first of what it is given, and adds nothing
            return torch.cat([torch.zeros(len(signal), width).double(), signal[:, :1] - signal[:, -1:]], -1)

        assert watched.jump(theta, {}).places == (0, 1, 2, 3)
        assert watched.jump(theta, {name: change}).places == (0, 1, 3, 4)
        found = watched.trajectory(theta, {name: change})
        assert found.states.shape[1] == 5
        torch.testing.assert_close(watched.residual(theta, {name: change}), watched.residual(theta, {}))
