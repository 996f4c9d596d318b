import pytest
import torch

from examples.blind_proof.draws import generator, normal
from examples.blind_proof.magnetometer.process import Process, autoregressive, resonance, whitened
from tests.blind_proof.magnetometer.dense import dense_covariance

PROCESSES = [autoregressive((0.9,), 0.5), autoregressive(resonance(0.9, 0.1), 0.7), Process((1.0,), 0.1)]


def problem(channels, white):
    g = generator(0, channels)
    gains = normal(g, 40, channels, 3)
    return torch.full((40, channels), white).double(), gains, normal(g, 40, channels, 5)


@pytest.mark.parametrize("channels", [1, 3])
def test_whitened_inner_products_equal_those_of_the_dense_inverse_covariance(channels):
    variance, gains, values = problem(channels, 0.3)
    flat = values.reshape(-1, 5)
    expected = flat.mT @ torch.linalg.solve(dense_covariance(variance, gains, PROCESSES), flat)
    white = whitened(values, variance, gains, PROCESSES)
    torch.testing.assert_close(white.mT @ white, expected, rtol=1e-9, atol=1e-9)


def test_coloured_noise_without_a_white_part_is_whitened():
    variance, gains, values = problem(1, 0.0)
    flat = values.reshape(-1, 5)
    expected = flat.mT @ torch.linalg.solve(dense_covariance(variance, gains, PROCESSES), flat)
    white = whitened(values, variance, gains, PROCESSES)
    torch.testing.assert_close(white.mT @ white, expected, rtol=1e-7, atol=1e-7)


def test_masked_samples_have_no_influence():
    variance, gains, values = problem(1, 0.3)
    keep = torch.arange(40) % 3 != 0
    inside = dense_covariance(variance, gains, PROCESSES)[keep][:, keep]
    flat = values.reshape(-1, 5)[keep]
    white = whitened(values, variance, gains, PROCESSES, keep)
    torch.testing.assert_close(white.mT @ white, flat.mT @ torch.linalg.solve(inside, flat), rtol=1e-9, atol=1e-9)
    assert float(white[~keep].abs().max()) == 0.0
