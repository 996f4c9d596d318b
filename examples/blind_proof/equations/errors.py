"""Sensor errors of a system: white or coloured noise, isolated outliers and short bursts of outliers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Generator

from examples.blind_proof.draws import choose, happens, uniform, unit_variance, whole
from examples.blind_proof.equations.plant import Array
from examples.blind_proof.magnetometer.noise import FAMILIES
from examples.blind_proof.magnetometer.process import autoregressive

OUTLIERS = 0.05
"""Share of outliers in the samples of each output."""

NOISE = (0.005, 0.02)
"""Standard deviation of an output's noise, over that of the output."""


@dataclass(frozen=True)
class Slow:
    """Drift of an output in addition to its other errors: a stationary first-order autoregressive process.

    Attributes:
        size: standard deviation over that of the output's other errors; 0 for no drift.
        lasting: correlation time in samples.
    """

    size: float
    lasting: float

    def correlations(self, samples: int) -> Array:
        """Return the covariance (T, T) of a run."""
        return np.exp(-np.abs(np.subtract.outer(range(samples), range(samples))) / self.lasting)


class Whitening(Protocol):
    """Whitens traces of the outputs by their noise."""

    def whitened(self, traces: Array) -> Array:
        """Whiten traces (m, T, R, q) to columns (M, q), or (m, T, R) to (M,), in standard deviations."""


@dataclass(frozen=True)
class Errors:
    """Noise of the outputs: a standard deviation for each, and a common sample-to-sample correlation and family.

    Each output may have a drift in ``slow``; empty without drifts.
    """

    deviations: tuple[float, ...]
    correlation: float
    family: str
    slow: tuple[Slow, ...] = ()

    def numbers(self, outputs: tuple[str, ...]) -> Mapping[str, Any]:
        """As JSON has it."""
        deviations = dict(zip(outputs, self.deviations, strict=True))
        slow = {
            name: {"over_noise": drift.size, "samples": drift.lasting}
            for name, drift in zip(outputs, self.slow, strict=False)
        }
        return {"deviation": deviations, "correlation": self.correlation, "family": self.family} | (
            {"slow": slow} if slow else {}
        )

    def whitened(self, traces: Array) -> Array:
        """Whiten traces (m, T, R, q) to columns (M, q), or (m, T, R) to (M,), in standard deviations."""
        scaled = traces / np.reshape(self.deviations, (-1, *[1] * (traces.ndim - 1)))
        if self.slow:
            return np.stack([self._with_drift(of, item) for of, item in zip(self.slow, scaled, strict=True)]).reshape(
                -1, *traces.shape[3:]
            )
        white = scaled.copy()
        white[:, 1:] = (scaled[:, 1:] - self.correlation * scaled[:, :-1]) / np.sqrt(1.0 - self.correlation**2)
        return white.reshape(-1, *traces.shape[3:])

    def _with_drift(self, slow: Slow, values: Array) -> Array:
        """Whiten an output (T, R, *), each run in the same way."""
        samples = len(values)
        covariance = np.eye(samples)
        if self.correlation:
            covariance = Slow(1.0, -1.0 / float(np.log(self.correlation))).correlations(samples)
        covariance = covariance + slow.size**2 * slow.correlations(samples)
        white = np.linalg.solve(np.linalg.cholesky(covariance), values.reshape(samples, -1))
        return np.asarray(white, dtype=np.float64).reshape(values.shape)


def draw_errors(g: Generator, outputs: Array) -> Errors:
    """Draw noise of a size in proportion to the outputs (m, T, R)."""
    deviations = tuple(uniform(g, *NOISE) * float(output.std()) for output in outputs)
    correlation = uniform(g, 0.2, 0.6) if happens(g, 0.4) else 0.0
    return Errors(deviations, correlation, choose(g, FAMILIES))


def sample(g: Generator, errors: Errors, samples: int, runs: int) -> Array:
    """Draw errors (m, T, R) without outliers."""

    def run_errors(deviation: float) -> Array:
        if errors.correlation:
            return autoregressive((errors.correlation,), deviation, errors.family).sample(g, samples).numpy()
        return deviation * unit_variance(g, errors.family, samples).numpy()

    values = np.stack([np.stack([run_errors(d) for _ in range(runs)], -1) for d in errors.deviations])
    for own, deviation, slow in zip(values, errors.deviations, errors.slow, strict=False):
        if slow.size:
            process = autoregressive((float(np.exp(-1.0 / slow.lasting)),), slow.size * deviation)
            own += np.stack([process.sample(g, samples).numpy() for _ in range(runs)], -1)
    return values


def contaminate(g: Generator, errors: Errors, samples: int, runs: int) -> tuple[Array, np.ndarray]:
    """Draw outliers (m, T, R) and their mask, for each output separately."""
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
