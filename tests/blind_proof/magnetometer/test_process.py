import pytest
import torch

from examples.blind_proof.draws import generator
from examples.blind_proof.magnetometer.process import Process, autoregressive, resonance


@pytest.mark.parametrize("coefficients", [(0.3,), (0.9,), resonance(0.9, 0.1)])
def test_samples_have_the_stated_deviation_and_correlation(coefficients):
    process = autoregressive(coefficients, 0.5)
    x = process.sample(generator(0), 60_000)
    assert float(x.std()) == pytest.approx(0.5, rel=0.06)
    c = process.start()
    state = c @ process.transition().T
    assert float((x[1:] * x[:-1]).mean()) == pytest.approx(float(state[0, 0]), abs=0.02)


def test_the_variance_of_a_random_walk_grows_from_that_of_a_step():
    ends = torch.stack([Process((1.0,), 0.1).sample(generator(1, k), 100)[[0, -1]] for k in range(2000)])
    assert float(ends[:, 0].std()) == pytest.approx(0.1, rel=0.08)
    assert float(ends[:, 1].std()) == pytest.approx(1.0, rel=0.08)
