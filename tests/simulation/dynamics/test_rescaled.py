"""What other observers would leave, against those observers run by themselves."""

import numpy as np
import pytest
import torch

from mkc_torch.simulation.dynamics.disturbances import observer_of
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.observer import Disturbance
from mkc_torch.simulation.dynamics.rescaled import rescaled, unclipped
from tests.simulation.dynamics.oscillating import course, flow, oscillator, pushed, recorded, theta_of

NOISE = 0.01
DISTURBANCES = {
    "white push": (Disturbance("speed", True, 0.0, 1.0),),
    "slow push": (Disturbance("speed", True, 3.0, 1.0),),
    "slow sensor": (Disturbance("position", False, 3.0, 0.05),),
    "all of them": (
        Disturbance("position", False, 3.0, 0.05),
        Disturbance("speed", True, 0.0, 0.5),
        Disturbance("speed", True, 3.0, 1.0),
    ),
}


def world(disturbances, runs=1, **attributes):
    """An observed oscillator, whose innovations are too small for one to be held for an outlier, and its parameters."""
    along, random = flow(60, runs=runs), np.random.default_rng(0)
    states = pushed(along, course(random, along, 0.0, 1.0)) + NOISE * random.standard_normal((60 * runs, 2))
    columns = {"position": 1e-3 * states[:, 0], "speed": 1e-3 * states[:, 1]}
    prepared = oscillator(step=0.025, **attributes).prepare(recorded(along, runs, **columns))
    theta = theta_of(prepared)
    return prepared.observed(observer(prepared, theta, disturbances, 1.0)), theta


def observer(prepared, theta, disturbances, share):
    other = tuple(Disturbance(d.place, d.at_rate, d.lasting, share * d.size) for d in disturbances)
    sensor = theta.new_tensor([NOISE, 3.0 * NOISE][: len(prepared.channels)])
    return observer_of(flow_of(prepared, theta, {}, None), other, sensor, prepared.pushable, prepared.channels)


def one(watched, theta, share):
    (found,) = rescaled(watched, theta, {}, None, (share,))
    return found


@pytest.mark.parametrize("kind", DISTURBANCES)
def test_the_whole_share_is_the_same(kind):
    watched, theta = world(DISTURBANCES[kind])
    residual = watched.residual(theta, {})
    found = one(watched, theta, 1.0)
    torch.testing.assert_close(found(residual), residual, rtol=1e-9, atol=1e-15)
    torch.testing.assert_close(found.other.gain, watched.observer.gain)


@pytest.mark.parametrize("runs", [1, 2])
@pytest.mark.parametrize("share", [0.5, 0.1, 0.0])
@pytest.mark.parametrize("outputs", [("position",), ("position", "speed")], ids=["one output", "two outputs"])
@pytest.mark.parametrize("kind", DISTURBANCES)
def test_a_share_is_what_the_other_observer_leaves(kind, outputs, share, runs):
    """A slow push is held from sample to sample here and fades there, so it is less exact."""
    disturbances = DISTURBANCES[kind]
    watched, theta = world(disturbances, runs, outputs=outputs)
    found = one(watched, theta, share)(watched.residual(theta, {}))
    expected = watched.observed(observer(watched, theta, disturbances, share)).residual(theta, {})
    slow = any(d.at_rate and d.lasting > 0.0 for d in disturbances)
    within = (0.02 if slow else 1e-5) * float(expected.abs().max())
    torch.testing.assert_close(found, expected, rtol=0.0, atol=within)
    before = float((watched.residual(theta, {}) - expected).abs().max())
    assert before > 5.0 * within


def test_no_share_is_the_free_run_s_residual():
    watched, theta = world(DISTURBANCES["white push"])
    free = watched.observed(None).residual(theta, {})
    found = one(watched, theta, 0.0)(watched.residual(theta, {}))
    torch.testing.assert_close(found, free, rtol=0.0, atol=1e-5 * float(free.abs().max()))


def test_tangents_are_mapped_as_residuals_are():
    watched, theta = world(DISTURBANCES["all of them"])
    found = one(watched, theta, 0.3)
    values = torch.randn(60, 1, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    together = found(values)
    assert together.shape == values.shape
    for k in range(4):
        torch.testing.assert_close(together[..., k], found(values[..., k]))
    torch.testing.assert_close(found(2.0 * values[..., 0] + values[..., 1]), 2.0 * together[..., 0] + together[..., 1])


def test_tangents_by_the_first_states_are_those_of_the_other_observer():
    """By the parameters they depend on where a trajectory goes, which is where the one observer has it."""
    disturbances = DISTURBANCES["white push"]
    watched, theta = world(disturbances)
    other = watched.observed(observer(watched, theta, disturbances, 0.2))
    theirs, expected = (torch.func.jacfwd(lambda t, w=w: w.residual(t, {}))(theta) for w in (watched, other))
    found = one(watched, theta, 0.2)(theirs)
    for k in (2, 3):
        torch.testing.assert_close(
            found[..., k], expected[..., k], rtol=0.0, atol=1e-4 * float(expected[..., k].abs().max())
        )


def test_there_is_none_of_a_free_run():
    watched, theta = world(DISTURBANCES["white push"])
    assert rescaled(watched.observed(None), theta, {}, None, (1.0, 0.5)) == []
    assert len(rescaled(watched, theta, {}, None, (1.0, 0.5))) == 2


class TestUnclipped:
    """Innovations of their usual size, which an observer takes a little less of than its gains say."""

    @staticmethod
    def loud():
        """An oscillator as noisy as its observer has it, with one outlier."""
        along, random = flow(200), np.random.default_rng(3)
        states = pushed(along, course(random, along, 0.0, 1.0)) + NOISE * random.standard_normal((200, 2))
        states[150, 0] += 30.0 * NOISE
        prepared = oscillator(step=0.025).prepare(recorded(along, 1, position=states[:, 0], speed=states[:, 1]))
        theta = theta_of(prepared)
        watched = prepared.observed(observer(prepared, theta, DISTURBANCES["white push"], 1.0))
        counts = torch.ones_like(watched.measured)
        counts[150] = 0.0
        return watched, theta, counts

    def test_no_share_is_the_free_run_s_residual(self):
        watched, theta, counts = self.loud()
        innovations, free = watched.residual(theta, {}), watched.observed(None).residual(theta, {})
        series, _ = unclipped(watched, theta, {}, None, counts)
        (none,) = rescaled(watched, theta, {}, None, (0.0,), counts)
        scale = float(free.abs().median())
        torch.testing.assert_close(none(series(innovations)), free, rtol=0.0, atol=1e-4 * scale)
        assert float((none(innovations) - free).abs().max()) > 0.1 * scale

    def test_tangents_by_the_first_states_are_those_of_the_free_run(self):
        watched, theta, counts = self.loud()
        free = watched.observed(None)
        theirs, expected = (torch.func.jacfwd(lambda t, w=w: w.residual(t, {}))(theta) for w in (watched, free))
        _, tangents = unclipped(watched, theta, {}, None, counts)
        (none,) = rescaled(watched, theta, {}, None, (0.0,), counts)
        for k in (2, 3):
            scale = float(expected[..., k].abs().max())
            torch.testing.assert_close(none(tangents(theirs))[..., k], expected[..., k], rtol=0.0, atol=1e-3 * scale)

    def test_what_does_not_count_corrects_nothing(self):
        watched, theta, counts = self.loud()
        counts[100] = 0.0
        (whole,) = rescaled(watched, theta, {}, None, (1.0,), counts)
        assert float(whole.other.gain[100].abs().max()) == 0.0
        assert float(watched.observer.gain[100].abs().max()) > 0.0

    def test_there_is_none_of_a_free_run(self):
        watched, theta, counts = self.loud()
        assert unclipped(watched.observed(None), theta, {}, None, counts) is None
