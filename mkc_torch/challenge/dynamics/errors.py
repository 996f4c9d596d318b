"""What the sensors of a system add: white or mildly coloured errors, isolated outliers and short bursts of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Generator

from mkc_torch.challenge.draws import choose, happens, uniform, unit_variance, whole
from mkc_torch.challenge.dynamics.plant import Array
from mkc_torch.challenge.magnetometer.noise import FAMILIES
from mkc_torch.challenge.magnetometer.process import autoregressive

OUTLIERS = 0.05
"""Share of the samples of each output."""

NOISE = (0.005, 0.02)
"""Standard deviation of an output's errors, over that of the output."""


@dataclass(frozen=True)
class Slow:
    """A slow error of one output beside its others: autoregressive of first order and stationary.

    Attributes:
        size: standard deviation over that of the output's other errors; 0 where there is none.
        lasting: correlation time in samples.
    """

    size: float
    lasting: float

    def correlations(self, samples: int) -> Array:
        """Matrix (T, T) of a run."""
        return np.exp(-np.abs(np.subtract.outer(range(samples), range(samples))) / self.lasting)


class Whitening(Protocol):
    """What weighs traces of the outputs by the noise in them."""

    def whitened(self, traces: Array) -> Array:
        """Columns (M, q) of traces (m, T, R, q), or (M,) of (m, T, R), in standard deviations of independent errors."""


@dataclass(frozen=True)
class Errors:
    """Of each output the standard deviation, and of all the correlation from sample to sample and the family.

    Beside these errors each output may have a ``slow`` one; empty where none has.
    """

    deviations: tuple[float, ...]
    correlation: float
    family: str
    slow: tuple[Slow, ...] = ()

    def numbers(self, outputs: tuple[str, ...]) -> Mapping[str, Any]:
        """As JSON has it."""
        told = dict(zip(outputs, self.deviations, strict=True))
        slow = {
            name: {"over_noise": one.size, "samples": one.lasting}
            for name, one in zip(outputs, self.slow, strict=False)
        }
        return {"deviation": told, "correlation": self.correlation, "family": self.family} | (
            {"slow": slow} if slow else {}
        )

    def whitened(self, traces: Array) -> Array:
        """Columns (M, q) of traces (m, T, R, q), or (M,) of (m, T, R), in standard deviations of independent errors."""
        scaled = traces / np.reshape(self.deviations, (-1, *[1] * (traces.ndim - 1)))
        if self.slow:
            return np.stack([self._beside_slow(of, one) for of, one in zip(self.slow, scaled, strict=True)]).reshape(
                -1, *traces.shape[3:]
            )
        white = scaled.copy()
        white[:, 1:] = (scaled[:, 1:] - self.correlation * scaled[:, :-1]) / np.sqrt(1.0 - self.correlation**2)
        return white.reshape(-1, *traces.shape[3:])

    def _beside_slow(self, slow: Slow, values: Array) -> Array:
        """An output's (T, R, *), run by run alike."""
        samples = len(values)
        covariance = np.eye(samples)
        if self.correlation:
            covariance = Slow(1.0, -1.0 / float(np.log(self.correlation))).correlations(samples)
        covariance = covariance + slow.size**2 * slow.correlations(samples)
        white = np.linalg.solve(np.linalg.cholesky(covariance), values.reshape(samples, -1))
        return np.asarray(white, dtype=np.float64).reshape(values.shape)


def draw_errors(g: Generator, outputs: Array) -> Errors:
    """Of a size that suits the outputs (m, T, R)."""
    deviations = tuple(uniform(g, *NOISE) * float(one.std()) for one in outputs)
    correlation = uniform(g, 0.2, 0.6) if happens(g, 0.4) else 0.0
    return Errors(deviations, correlation, choose(g, FAMILIES))


def sample(g: Generator, errors: Errors, samples: int, runs: int) -> Array:
    """Errors (m, T, R) without outliers."""

    def one(deviation: float) -> Array:
        if errors.correlation:
            return autoregressive((errors.correlation,), deviation, errors.family).sample(g, samples).numpy()
        return deviation * unit_variance(g, errors.family, samples).numpy()

    values = np.stack([np.stack([one(d) for _ in range(runs)], -1) for d in errors.deviations])
    for own, deviation, slow in zip(values, errors.deviations, errors.slow, strict=False):  # none, or one for each
        if slow.size:
            process = autoregressive((float(np.exp(-1.0 / slow.lasting)),), slow.size * deviation)
            own += np.stack([process.sample(g, samples).numpy() for _ in range(runs)], -1)
    return values


def contaminate(g: Generator, errors: Errors, samples: int, runs: int) -> tuple[Array, np.ndarray]:
    """Outliers (m, T, R) and where they are: True in the mask, in each output by itself."""
    mask = np.zeros((len(errors.deviations), samples, runs), dtype=bool)
    bursts = happens(g, 0.5)
    for k, run in np.ndindex(len(mask), runs):
        wanted = round(OUTLIERS * samples)
        while mask[k, :, run].sum() < wanted:
            length = min(whole(g, 2, 6) if bursts else 1, wanted - int(mask[k, :, run].sum()))
            start = whole(g, 0, samples - length)
            mask[k, start : start + length, run] = True
    size = 5.0 * torch.exp(torch.rand(mask.shape, generator=g, dtype=torch.float64) * np.log(10.0)).numpy()
    sign = np.sign(torch.rand(mask.shape, generator=g, dtype=torch.float64).numpy() - 0.5)
    scale = np.reshape(errors.deviations, (-1, 1, 1))
    return np.where(mask, sign * size * scale, 0.0), mask
