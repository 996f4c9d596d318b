"""The response of a turned sensor: its derivatives, and the windows of integrated rates."""

import math
import sys

import pytest
import torch

from mkc_torch._support.forward_mode import forward_tangents
from mkc_torch.calibration.aided.response import ERRORS, Model
from mkc_torch.calibration.aided.rotation import gaps
from mkc_torch.calibration.aided.turns import HALF_A_TURN, WINDOW, Turns, turns_of_gyroscope

N = 60


def normal_draws(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def response_problem(name, biased):
    """A model, parameters away from its start, and its residual."""
    frames = torch.linalg.qr(normal_draws(N, 3, 3))[0]
    turns = Turns(frames, torch.arange(N) // 15, 0.1 * normal_draws(N, 3, ERRORS, seed=1) if biased else None, None)
    model = Model(name, 50.0, biased)
    theta = model.start(normal_draws(3, seed=2), 50.0 * torch.eye(3, dtype=torch.float64))
    measured, weight = 50.0 * normal_draws(N, 3, seed=3), normal_draws(N, seed=4).abs()
    theta = theta + 0.01 * normal_draws(len(theta), seed=5)
    return theta, lambda parameters: model.residual(parameters, measured, turns, weight)


@pytest.mark.parametrize("name", ["offset", "offset and scale", "full matrix"])
@pytest.mark.parametrize("biased", [False, True])
def test_tangents_equal_differences_without_python_fallbacks_of_torch(name, biased):
    theta, residual = response_problem(name, biased)
    tangents = forward_tangents(residual)
    found = tangents(theta)  # the first use loads rules, which are Python's own
    used = []

    def called(frame, event, _):
        if event == "call" and "_refs" in frame.f_code.co_filename:
            used.append(frame.f_code.co_name)

    before = sys.getprofile()
    sys.setprofile(called)
    try:
        tangents(theta)
    finally:
        sys.setprofile(before)
    assert used == []
    step = 1e-6
    moved = torch.stack(
        [residual(theta + step * e) - residual(theta - step * e) for e in torch.eye(len(theta)).double()]
    )
    torch.testing.assert_close(found, moved / (2.0 * step), rtol=1e-6, atol=1e-6)


def first_samples_by_loop(time, rate):
    """The first sample of each sample's window."""
    turn = torch.linalg.vector_norm(0.5 * (rate[1:] + rate[:-1]), dim=-1) * time.diff()
    angle, broken = [0.0, *turn.cumsum(0).tolist()], [False, *gaps(time).tolist()]
    first, begin = [], 0
    for k, t in enumerate(time.tolist()):
        far = t - float(time[begin]) > WINDOW or angle[k] - angle[begin] > HALF_A_TURN
        begin = k if broken[k] or (far and k - begin >= 5) else begin
        first.append(begin)
    return first


@pytest.mark.parametrize("speed", [0.0, 0.3, 3.0, 40.0])
@pytest.mark.parametrize("count", [2, 6, 700])
def test_a_window_ends_after_its_time_or_half_a_turn_or_at_a_gap(count, speed):
    time = (0.2 * normal_draws(count, seed=6).abs()).cumsum(0)
    time[count // 2 :] += 30.0
    rate = speed * normal_draws(count, 3, seed=7)
    found = turns_of_gyroscope(time, rate, (slice(0, count),), torch.zeros(ERRORS, dtype=torch.float64))
    first = first_samples_by_loop(time, rate)
    numbers = {begin: number for number, begin in enumerate(sorted(set(first)))}
    assert found.window.tolist() == [numbers[begin] for begin in first]
    # the rotation is counted from there
    identity = torch.eye(3, dtype=torch.float64).expand(len(numbers), 3, 3)
    torch.testing.assert_close(found.to_frame[sorted(numbers)], identity, rtol=0.0, atol=1e-12)
    assert math.isfinite(float(found.to_frame.sum()))
