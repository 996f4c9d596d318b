"""White noise of a recording rounded to a few decimals: never below the rounding noise."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch._support.quantum import quanta_of
from mkc_torch.simulation import Dynamics
from mkc_torch.simulation.dynamics.flow import flow_of
from mkc_torch.simulation.dynamics.kalman import filtered, robust_likelihood
from mkc_torch.simulation.dynamics.noise import most_likely_noise
from mkc_torch.simulation.dynamics.noise_grid import NoiseGrid
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from mkc_torch.simulation.dynamics.noise_selection import filter_models

STEP = 0.01
LEAST = STEP / 12.0**0.5


class House(Dynamics):
    states, parameters = ("indoor",), {"rate": 0.02}

    def derivative(self, time, x, u, p):
        return {"indoor": -p.rate * x.indoor}


def house(decimals=2):
    """Return a room that cools under unrecorded random heating, rounded to a few decimals."""
    g = torch.Generator().manual_seed(0)
    time = torch.arange(300, dtype=torch.float64)
    heating, indoor, now = 0.0, [], 20.0
    for _ in range(300):
        heating = 0.95 * heating + 0.05 * float(torch.randn(1, generator=g))
        now += heating - 0.02 * now
        indoor.append(now)
    indoor = torch.tensor(indoor, dtype=torch.float64)
    return House().prepare(Recording({"time": time, "indoor": indoor.round(decimals=decimals)}))


def noise(prepared, known=None, **declared):
    theta = prepared.start()
    found = most_likely_noise(prepared, theta, {}, None, declared=declared, least=6.0, most=2, known=known)
    return found.selected


def test_selection_and_rescaling_respect_the_rounding_floor():
    prepared = house()
    found = noise(prepared)
    assert found.disturbances
    assert float(found.sensor) >= LEAST
    smaller = replace(found, sensor=1e-9 * found.sensor)
    assert float(noise(prepared, smaller).sensor) >= LEAST


def test_noise_without_rounding_is_far_smaller():
    assert float(noise(house(decimals=9)).sensor) < 0.1 * LEAST


def test_declared_noise_is_not_raised_to_the_floor():
    assert float(noise(house(), indoor=1e-4).sensor) == pytest.approx(1e-4)


def test_a_profiled_scale_ends_at_the_floor():
    prepared = house()
    flow = flow_of(prepared, prepared.start(), {}, None)
    model = NoiseModel((2.0 * LEAST,), ((0, 5.0, 0.0),), (False,), (LEAST,))
    found = filtered(flow.whole, filter_models(flow, [model]))
    _, (free,) = robust_likelihood(found, flow.whole.mine, flow.reach)
    _, (held,) = robust_likelihood(found, flow.whole.mine, flow.reach, least=model.least_scale)
    assert free < 0.5
    assert held == model.least_scale == 0.5


def test_neighbours_in_the_grid_respect_the_floor():
    prepared = house()
    flow = flow_of(prepared, prepared.start(), {}, None)
    two = replace(flow, new=np.tile(flow.new, 2), seen=np.tile(flow.seen, (1, 2, 1)), counts=np.tile(flow.counts, 2))
    model = NoiseModel((LEAST, 1.0), (), (False, False), (LEAST, 0.0))
    sensors = [neighbour.sensor for neighbour in NoiseGrid(two, model).neighbours(model, 0.5)]
    assert min(first for first, _ in sensors) == LEAST
    assert min(second for _, second in sensors) < 1.0


def test_the_quantum_of_a_column_is_its_smallest_step():
    values = torch.tensor([0.25, 0.75, 1.25], dtype=torch.float64).repeat(20)
    fine = torch.linspace(0.0, 1.0, 60, dtype=torch.float64) * torch.pi
    assert quanta_of(torch.stack([values, fine], -1)).tolist() == [0.5, 0.0]


def test_a_quantum_is_found_where_most_values_are_distinct():
    generator = torch.Generator().manual_seed(0)
    values = 8.0 * torch.rand(500, 1, generator=generator, dtype=torch.float64)
    assert values.mul(50).round().div(50).unique().numel() > 250
    torch.testing.assert_close(quanta_of(values.mul(50).round().div(50)), values.new_tensor([0.02]))
    assert quanta_of(values).tolist() == [0.0]
