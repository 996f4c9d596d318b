"""Transitions of a flow over several samples, and the noise that disturbances of size 1 add to the states meanwhile.

They are composed by doubling, so that the cost grows with the logarithm of the longest horizon. Noise models share
them: only the sizes of the disturbances differ between models.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

    from mkc_torch.simulation.dynamics.kalman import FilterModels, Flow


@dataclass(frozen=True)
class Disturbances:
    """The U different disturbances of B noise models, regardless of their sizes.

    Attributes:
        place: (U,), the index of a rate, or the number of rates plus the index of an output.
        lasting: (U,), time constant in s; 0 for white noise of a rate.
        variance: (B, U), the variance of each in each model.
        slots: (B, D), index of each lasting disturbance of each model.
    """

    place: Int[np.ndarray, " U"]
    lasting: Float[np.ndarray, " U"]
    variance: Float[np.ndarray, "B U"]
    slots: Int[np.ndarray, "B D"]

    @classmethod
    def of(cls, models: FilterModels) -> Disturbances:
        """The disturbances of these models."""
        white = np.flatnonzero(models.white.any(0))
        pairs = np.stack([models.place.ravel().astype(float), models.lasting.ravel()], 1)
        different, index = np.unique(pairs, axis=0, return_inverse=True)
        slots = index.reshape(models.place.shape) + len(white)
        variance = np.zeros((len(models), len(white) + len(different)))
        variance[:, : len(white)] = models.white[:, white] ** 2
        for slot, size in zip(slots.T, models.size.T, strict=True):
            variance[np.arange(len(models)), slot] += size**2
        place = np.concatenate([white, different[:, 0].astype(int)])
        return cls(place, np.concatenate([np.zeros(len(white)), different[:, 1]]), variance, slots)


@dataclass(frozen=True)
class Ahead:
    """What leads to each sample from the sample a horizon before, or from the start of its run.

    Attributes:
        carry: (n, n, N), transition of the states; 0 where the run starts in between.
        shift: (n, N), shift of the states.
        column: (n, U, N), effect on the states of the value 1 of each disturbance at the sample before.
        share: (U, N), share of that value which is left.
        noise: (n, n, U, N), covariance of the states by a disturbance of size 1 in between.
        mixed: (n, U, N), covariance of the states with the disturbance.
        own: (U, N), variance of the disturbance, given its value before.
    """

    carry: Float[np.ndarray, "n n N"]
    shift: Float[np.ndarray, "n N"]
    column: Float[np.ndarray, "n U N"]
    share: Float[np.ndarray, "U N"]
    noise: Float[np.ndarray, "n n U N"]
    mixed: Float[np.ndarray, "n U N"]
    own: Float[np.ndarray, "U N"]

    def twice(self, horizon: int) -> Ahead:
        """The same over twice the horizon."""
        behind, here = slice(0, max(self.shift.shape[-1] - horizon, 0)), slice(horizon, None)
        A, c, share = self.carry[..., here], self.column[..., here], self.share[..., here]
        carry, column, left = np.zeros_like(self.carry), np.zeros_like(self.column), np.zeros_like(self.share)
        shift, noise, mixed, own = self.shift.copy(), self.noise.copy(), self.mixed.copy(), self.own.copy()
        carry[..., here] = times(A, self.carry[..., behind])
        shift[..., here] += times_vector(A, self.shift[..., behind])
        by_states = A[:, :, None]
        column[..., here] = times_vector(by_states, self.column[..., behind]) + c * self.share[..., behind]
        left[..., here] = share * self.share[..., behind]
        # of the states before, half of what they share with the disturbance: its transpose is the other half
        before = times_vector(by_states, self.mixed[..., behind])
        both = (before + 0.5 * c * self.own[..., behind])[:, None] * c[None]
        moved = times_transposed(times(by_states, self.noise[..., behind]), by_states)
        noise[..., here] += moved + both + both.swapaxes(0, 1)
        mixed[..., here] += (before + c * self.own[..., behind]) * share
        own[..., here] += share**2 * self.own[..., behind]
        return Ahead(carry, shift, column, left, noise, mixed, own)

    def shown(
        self, seen: Float[np.ndarray, "m n N"], output: Int[np.ndarray, " U"]
    ) -> tuple[Float[np.ndarray, "m U N"], Float[np.ndarray, "m m U N"]]:
        """Effect on the outputs of the value 1 of each disturbance before, and their covariance by one of size 1.

        Args:
            seen: derivative of the outputs by the states.
            output: (U,), index of the output that drifts; below 0 for a disturbance of a rate.
        """
        by_states = seen[:, :, None]
        column = times_vector(by_states, self.column)
        noise = times_transposed(times(by_states, self.noise), by_states)
        for u in np.flatnonzero(output >= 0):
            column[output[u], u] = self.share[u]
            noise[output[u], output[u], u] = self.own[u]
        return column, noise


def composed(flow: Flow, kinds: Disturbances, horizons: Sequence[int]) -> Iterator[tuple[Ahead, int]]:
    """Yield what leads to each sample over each horizon, and the horizon.

    Args:
        flow: the linearised trajectory.
        kinds: the disturbances.
        horizons: ascending powers of two, in samples.
    """
    ahead, horizon = _one_step(flow, kinds), 1
    while True:
        if horizon in horizons:
            yield ahead, horizon
        if horizon >= horizons[-1]:
            return
        ahead, horizon = ahead.twice(horizon), 2 * horizon


def _one_step(flow: Flow, kinds: Disturbances) -> Ahead:
    N, n, U = len(flow.new), flow.transition.shape[1], len(kinds.place)
    carry, shift = np.zeros((n, n, N)), np.zeros((n, N))
    carry[..., 1:], shift[:, 1:] = flow.transition.transpose(1, 2, 0), -flow.shift.T
    column, share, own = np.zeros((n, U, N)), np.zeros((U, N)), np.zeros((U, N))
    noise = np.zeros((n, n, U, N))
    for u, (place, lasting) in enumerate(zip(kinds.place, kinds.lasting, strict=True)):
        along = flow.noise_input[:, :, place].T if place < flow.rates else None
        if lasting > 0.0:
            share[u, 1:] = np.where(flow.step > 0, np.exp(-flow.step / lasting), 0.0)
            own[u] = 1.0 - share[u] ** 2
            if along is not None:
                column[:, u, 1:] = along
        elif along is not None:
            noise[:, :, u, 1:] = along[:, None] * along[None]
    return Ahead(carry, shift, column, share, noise, np.zeros((n, U, N)), own)


def times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of matrices whose elements are in the first two dimensions."""
    result: np.ndarray = np.einsum("ij...,jk...->ik...", a, b)
    return result


def times_transposed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of matrices and the transposes of others."""
    result: np.ndarray = np.einsum("ij...,kj...->ik...", a, b)
    return result


def times_vector(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Products of matrices and vectors."""
    result: np.ndarray = np.einsum("ij...,j...->i...", a, b)
    return result
