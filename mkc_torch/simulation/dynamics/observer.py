"""Observers: trajectories that are corrected by the measured outputs at each sample.

Under process noise, an open-loop simulation drifts from the recording, and its residuals are strongly correlated. An
observer with fixed Kalman gains corrects states and disturbances at each sample, and the innovations are the residual:
an innovations model (Ljung, "System Identification", 1999, 4.3; Kristensen, Madsen & Jørgensen, Automatica 40 (2004),
225).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from mkc_torch.simulation.dynamics.equations import Equations
from mkc_torch.simulation.dynamics.trajectory import Grid, Trajectory, slopes
from mkc_torch.simulation.dynamics.varying import Acting
from mkc_torch.simulation.ports import Answer, Changes, Nearby

if TYPE_CHECKING:
    from jaxtyping import Float, Int

CLIP = 4.0
"""Standard deviations that the correction by an innovation saturates at, since it may be an outlier."""


@dataclass(frozen=True)
class Disturbance:
    """Process noise of a state's rate, or drift of an output.

    Attributes:
        place: name of the state or the output.
        at_rate: whether it acts on a rate.
        lasting: time constant in s of its autocorrelation; 0 for white noise.
        size: standard deviation, in the unit of the rate or of the output.
    """

    place: str
    at_rate: bool
    lasting: float
    size: float

    def lasting_at_least(self, time: float) -> Disturbance:
        """The disturbance with a time constant of at least this many seconds."""
        return replace(self, lasting=max(self.lasting, time))


@dataclass(frozen=True)
class Observer:
    """Kalman gains at the samples, and the scale of the innovations.

    Attributes:
        outputs: names of the outputs.
        disturbances: all disturbances.
        sensor: (m,), standard deviation of each output's white noise.
        gain: (N, n + D, m), of n states and the D lasting disturbances; 0 where a sample is masked.
        white: (N, m, m), whitens the innovations of a sample. The logarithms of its diagonal have mean 0 for each
            output, so that likelihoods compare across observers.
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
        """The disturbances with a time constant, in the order of their states."""
        return tuple(disturbance for disturbance in self.disturbances if disturbance.lasting > 0.0)

    def whitened(self, new: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
        """Whiten innovations to independent residuals of equal size, in the outputs' units."""
        return (self.white @ new.unsqueeze(-1)).squeeze(-1)


def clipped(new: Float[Tensor, "N m"], spread: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """Clip innovations smoothly to ``CLIP`` standard deviations."""
    limit = CLIP * spread
    return limit * torch.tanh(new / limit)


def clipped_slope(new: Float[Tensor, "N m"], spread: Float[Tensor, "N m"]) -> Float[Tensor, "N m"]:
    """The derivative of :func:`clipped` by the innovations."""
    return 1.0 - torch.tanh(new / (CLIP * spread)).square()


@dataclass(frozen=True)
class ObserverJump:
    """The correction of a trajectory's states at the samples; a :class:`..trajectory.Jump`.

    Attributes:
        observer: the gains.
        rows: (N,), grid index of each sample.
        places: indices of the corrected states among the trajectory's states.
        measured: (N, m), the recording minus the contributions of effects and sensors.
        predict: from the states at the samples, (N, n), to the outputs, (N, m).
    """

    observer: Observer
    rows: Int[Tensor, " N"]
    places: tuple[int, ...]
    measured: Float[Tensor, "N m"]
    predict: Callable[[Tensor], Tensor]

    def applied(self, states: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
        at = states[self.rows]
        moved = clipped(self.measured - self.predict(at), self.observer.spread)
        return states.index_put((self.rows,), at + self._spread_out((self._gain @ moved.unsqueeze(-1)).squeeze(-1), at))

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
        """Scatter values of the corrected states to all states; 0 elsewhere."""
        all_ = values.new_zeros(*values.shape[:-1], at.shape[1])
        return all_.index_copy(-1, torch.tensor(self.places, device=at.device), values)


class Observable(Protocol):
    """The interface of a prepared system that noise estimation uses.

    Attributes:
        system: the equations.
        channels: names of the outputs.
        disturbable: states whose rate process noise can act on.
        measured: (N, m), the recorded outputs.
        counts: (N, m), False where a sample is an outlier among its neighbours.
        time: (N,), times of the samples in s.
        begins: (N,), True where a run starts.
        grid: the grid times.
        rows: (N,), grid index of each sample.
        guess: (G, n), a first guess of the states at the grid times.
        bounds: lower and upper bounds of the parameters.
        observer: the observer that corrects the states; None in open loop.
        lasting: lasting disturbances that the observer estimates.
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
    def disturbable(self) -> tuple[str, ...]: ...
    @property
    def lasting(self) -> tuple[Disturbance, ...]: ...
    def observed(self, observer: Observer | None) -> Any: ...
    def trajectory(self, theta: Tensor, changes: Changes, near: Nearby | None = None) -> Trajectory: ...
    def answer(self, theta: Tensor, changes: Changes, near: Nearby | None = None) -> Answer: ...
    def rate(self, theta: Tensor, changes: Changes) -> Callable[[Tensor], Tensor]: ...
    def jump(self, theta: Tensor, changes: Changes) -> ObserverJump | None: ...
    def seen(self, theta: Tensor, changes: Changes) -> Tensor: ...
    def acting_at_samples(self, theta: Tensor, changes: Changes) -> Acting: ...
    def predicted(self, acting: Acting, changes: Changes) -> Callable[[Tensor], Tensor]: ...
    def outputs_by_states(self, theta: Tensor, changes: Changes, states: Tensor) -> Tensor: ...
    def output_disturbance(self, states: Tensor) -> Tensor: ...
