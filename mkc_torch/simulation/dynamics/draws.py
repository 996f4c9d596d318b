"""Recordings drawn from a linearised trajectory with a noise model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mkc_torch.simulation.dynamics.kalman import Flow
from mkc_torch.simulation.dynamics.noise_model import NoiseModel, filter_models

if TYPE_CHECKING:
    from jaxtyping import Float


def drawn(flow: Flow, noise: NoiseModel, count: int, generator: np.random.Generator) -> Float[np.ndarray, "B N m"]:
    """Draw recordings minus the outputs of the trajectory.

    Args:
        flow: the linearised trajectory.
        noise: disturbances and white noise.
        count: number of draws B.
        generator: of the draws.

    Example:
        >>> one, two = np.ones((1, 1, 1)), np.ones((2, 1))
        >>> flow = Flow(one, one, np.ones((2, 1, 1)), two, one[0], np.ones(1), two, np.ones(1))
        >>> drawn(flow, NoiseModel((0.1,)), 3, np.random.default_rng(0)).shape
        (3, 2, 1)
    """
    models = filter_models(flow, [noise])
    place, size, lasting = models.place[0], models.size[0], models.lasting[0]
    N, m = flow.new.shape
    into = np.eye(flow.rates + m)[place]
    phi = np.exp(-flow.step[:, None] / lasting)
    new = size * np.sqrt(1.0 - phi**2)
    states, lag = np.zeros((count, flow.transition.shape[1])), np.zeros((count, len(place)))
    result = models.sensor[0] * generator.standard_normal((count, N, m))
    for k in range(N):
        if k == 0 or flow.step[k - 1] <= 0.0:
            states = np.zeros_like(states)
            lag = size * generator.standard_normal(lag.shape)
        else:
            kick = models.white[0] * generator.standard_normal((count, flow.rates)) + lag @ into[:, : flow.rates]
            states = states @ flow.transition[k - 1].T + kick @ flow.noise_input[k - 1].T
            lag = phi[k - 1] * lag + new[k - 1] * generator.standard_normal(lag.shape)
        result[:, k] += states @ flow.seen[k].T + lag @ into[:, flow.rates :]
    return result
