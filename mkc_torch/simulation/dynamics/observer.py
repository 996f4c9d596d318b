"""A trajectory that is corrected by what was measured: prediction from sample to sample, where states are pushed.

Where what is left of a simulation is not the sensors' noise alone, a free run drifts from the recording, and its
residual says little about the next sample. With the gains of a Kalman filter, fixed beforehand, states and pushes are
moved at each sample towards what was measured, and what is new in each sample is the residual: an innovations model
(Ljung, "System Identification", 1999, 4.3; Kristensen, Madsen & Jørgensen, Automatica 40 (2004), 225).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.trajectory import Grid, Trajectory, slopes
from mkc_torch.simulation.protocol import Answer, Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float, Int

__all__ = ["CLIP", "Disturbance", "Observable", "Observer", "ObserverJump", "clipped", "clipped_slope"]

CLIP = 4.0
"""Standard deviations of what is new in a sample beyond which it moves the states no further: it may be an outlier."""


@dataclass(frozen=True)
class Disturbance:
    """Something random that acts on the rate of a state, or is added to an output.

    Attributes:
        place: the state or the output.
        at_rate: whether it acts on a rate.
        lasting: time constant in s in which it forgets its value; 0 for one that is new at each sample.
        size: standard deviation, in the unit of the rate or of the output.
    """

    place: str
    at_rate: bool
    lasting: float
    size: float

    def lasting_at_least(self, time: float) -> Disturbance:
        """The same with a memory of its own."""
        return replace(self, lasting=max(self.lasting, time))


@dataclass(frozen=True)
class Observer:
    """Gains by which states and lasting disturbances are corrected at the samples, and the scale of what is new.

    Attributes:
        outputs: names.
        disturbances: all of them.
        sensor: (m,), standard deviation of each output's white noise.
        gain: (N, n + D, m), of n states and the D lasting disturbances, 0 where a sample does not count.
        white: (N, m, m), what makes the innovations of a sample independent and of one size; its determinants have
            a mean logarithm of 0 for each output, so that likelihoods compare across observers.
        spread: (N, m), standard deviation of each innovation.
    """

    outputs: tuple[str, ...]
    disturbances: tuple[Disturbance, ...]
    sensor: Float[Tensor, " m"]
    gain: Float[Tensor, "N k m"]
    white: Float[Tensor, "N m m"]
    spread: Float[Tensor, "N m"]

    @property
    def lasting(self) -> tuple[Disturbance, ...]:
        """Those that have a memory, in the order of their states."""
        return tuple(one for one in self.disturbances if one.lasting > 0.0)

    def whitened(self, new: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
        """Innovations as independent residuals of one size, in the outputs' units."""
        return torch.einsum("nij,nj->ni", self.white, new)


def clipped(new: Float[Tensor, "N m"], spread: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """What an observer takes of innovations of these standard deviations: a few of them at most."""
    limit = CLIP * spread
    return limit * torch.tanh(new / limit)


def clipped_slope(new: Float[Tensor, "N m"], spread: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """The derivative of :func:`clipped` by the innovations."""
    return 1.0 - torch.tanh(new / (CLIP * spread)).square()


@dataclass(frozen=True)
class ObserverJump:
    """The jump of a trajectory's states at the samples.

    Attributes:
        observer: the gains.
        rows: (N,), the moment of each sample.
        places: where the states that the gains are of stand among those of the trajectory.
        measured: (N, m), with what effects and sensors make of the outputs taken off.
        predict: outputs at the samples by the states there, (N, n) to (N, m).
    """

    observer: Observer
    rows: Int[Tensor, " N"]
    places: tuple[int, ...]
    measured: Float[Tensor, "N m"]
    predict: Callable[[Tensor], Tensor]

    def applied(self, states: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
        at = states[self.rows]
        moved = clipped(self.measured - self.predict(at), self.observer.spread)
        return states.index_put((self.rows,), at + self._spread_out(torch.einsum("nkm,nm->nk", self._gain, moved), at))

    def slope(self, states: Float[Tensor, "G n"]) -> Float[Tensor, "G n n"]:
        at = states[self.rows]
        slope = clipped_slope(self.measured.detach() - self.predict(at).detach(), self.observer.spread)
        C = slopes(self.predict, at) * slope.unsqueeze(-1)
        n = states.shape[1]
        eye = torch.eye(n, dtype=states.dtype, device=states.device).expand(len(states), n, n)
        pulled = self._spread_out(-(self._gain @ C).movedim(1, -1), at).movedim(-1, 1)
        return eye.index_put((self.rows,), eye[: len(at)] + pulled)

    @property
    def _gain(self) -> Tensor:
        return self.observer.gain

    def _spread_out(self, values: Float[Tensor, "N *rest k"], at: Float[Tensor, "N n"]) -> Float[Tensor, "N *rest n"]:
        """Values for the states with gains, as values for all states."""
        all_ = values.new_zeros(*values.shape[:-1], at.shape[1])
        return all_.index_copy(-1, torch.tensor(self.places, device=at.device), values)


class Observable(Protocol):
    """What the noise of the world asks of a prepared system of differential equations.

    Attributes:
        system: names and functions.
        channels: the outputs.
        pushable: states whose rate something unrecorded can push.
        measured, counts: (N, m), the outputs as they were recorded, and which samples are no outliers by themselves.
        time, begins: (N,), of the samples, and where a run begins.
        grid, rows, guess: the moments, those of the samples, and a first guess of the states then.
        bounds: of the parameters.
        observer: that corrects it; None where it runs freely.
        lasting: what an observer follows beside the states.
    """

    system: Equations
    channels: tuple[str, ...]
    measured: Tensor
    counts: Tensor
    time: Tensor
    begins: Tensor
    grid: Grid
    rows: Tensor
    guess: Tensor
    bounds: tuple[Tensor, Tensor]
    observer: Observer | None

    @property
    def pushable(self) -> tuple[str, ...]: ...
    @property
    def lasting(self) -> tuple[Disturbance, ...]: ...
    def observed(self, observer: Observer | None) -> Any: ...
    def trajectory(self, theta: Tensor, changes: Changes, near: Nearby | None = None) -> Trajectory: ...
    def answer(self, theta: Tensor, changes: Changes, near: Nearby | None = None) -> Answer: ...
    def rate(self, theta: Tensor, changes: Changes) -> Callable[[Tensor], Tensor]: ...
    def jump(self, theta: Tensor, changes: Changes) -> ObserverJump | None: ...
    def seen(self, theta: Tensor, changes: Changes) -> Tensor: ...
    def predicted(self, theta: Tensor) -> Callable[[Tensor], Tensor]: ...
