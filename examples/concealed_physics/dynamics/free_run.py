"""Open-loop runs of differential equations over recorded inputs, with many runs and models in parallel.

Shapes: N samples, R runs, S moments in a step, n states, m outputs, u inputs; "*batch" are parallel models.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from mkc_torch import Recording
from mkc_torch.simulation import Dynamics

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

Rate = Callable[[Tensor, Tensor], Tensor]
"""States (*batch, R, n) and inputs (R, u) to the states' rates of change (*batch, R, n)."""

_DEGREE = 5
"""Of the spline between the samples of a "smooth" input."""


@dataclass(frozen=True)
class Runs:
    """Parallel runs; shorter runs hold their last sample.

    Attributes:
        time: (N, R) in s.
        measured: (N, R, m).
        inputs: (N − 1, S, R, u), at the beginning, in the middle and at the end of each part of a step.
        present: (N, R), False where a run is over.
    """

    time: Float[Tensor, "N R"]
    measured: Float[Tensor, "N R m"]
    inputs: Float[Tensor, "N-1 S R u"]
    present: Bool[Tensor, "N R"]

    @property
    def since(self) -> Float[Tensor, "N R"]:
        """In s since each run's start."""
        return self.time - self.time[0]

    def first(self, count: int) -> Runs:
        """The first samples."""
        return Runs(self.time[:count], self.measured[:count], self.inputs[: count - 1], self.present[:count])

    def until(self, share: float) -> Runs:
        """The first share of each run; the rest counts as over."""
        return replace(self, present=self.present & (self.since <= share * self.since[-1]))

    def longest(self) -> int:
        """Number of samples after which every run is over."""
        return int(self.present.any(-1).nonzero().max()) + 1


def outputs_of(system: Dynamics, recording: Recording) -> tuple[str, ...]:
    """The columns that a system answers to."""
    return system.outputs or tuple(state for state in system.states if state in recording)


def runs_of(system: Dynamics, recording: Recording, parts: int) -> Runs:
    """The runs of a recording, each interval between samples divided into so many parts."""
    singles = list(recording.experiments().values()) if "experiment" in recording else [recording]
    longest = max(len(single["time"]) for single in singles)
    names = outputs_of(system, recording)

    def padded(values: Tensor, length: int) -> Tensor:
        return torch.cat([values, values[-1:].expand(length - len(values), *values.shape[1:])])

    return Runs(
        torch.stack([padded(s["time"], longest) for s in singles], 1),
        torch.stack([padded(s.stack(*names), longest) for s in singles], 1),
        torch.stack([padded(stations(system, s, parts), longest - 1) for s in singles], 2),
        torch.stack([torch.arange(longest) < len(s["time"]) for s in singles], 1),
    )


def stations(system: Dynamics, recording: Recording, parts: int) -> Float[Tensor, "N-1 S u"]:
    """A run's inputs at the moments of each step, held, linear or smooth in between as the system has it."""
    time = recording["time"]
    share = torch.linspace(0.0, 1.0, 2 * parts + 1, dtype=time.dtype)
    if not system.inputs:
        return time.new_zeros(len(time) - 1, len(share), 0)
    values = recording.stack(*system.inputs)
    early, late = values[:-1].unsqueeze(1), values[1:].unsqueeze(1)
    if system.input_hold == "held":
        return early.expand(-1, len(share), -1)
    if system.input_hold == "linear":
        return torch.lerp(early, late, share.unsqueeze(-1))
    at = torch.lerp(time[:-1].unsqueeze(-1), time[1:].unsqueeze(-1), share)
    return torch.from_numpy(make_interp_spline(time.numpy(), values.numpy(), k=_DEGREE)(at.numpy()))


def windows(runs: Runs, length: int) -> Runs:
    """Runs cut into windows of so many steps, the first window of every run before all second ones.

    A window ends with the sample that the next one of its run begins with.

    Example:
        >>> time = torch.arange(7.0).unsqueeze(-1)
        >>> cut = windows(Runs(time, time.unsqueeze(-1), torch.zeros(6, 3, 1, 0), time >= 0), 3)
        >>> cut.time.T
        tensor([[0., 1., 2., 3.],
                [3., 4., 5., 6.]])
    """
    N = len(runs.time)
    starts = torch.arange(0, N - 1, length)
    rows = starts + torch.arange(length + 1).unsqueeze(-1)  # (length + 1, windows)
    inside = rows < N
    rows = rows.clamp(max=N - 1)
    time = runs.time[rows].flatten(1)
    present = (runs.present[rows] & inside.unsqueeze(-1)).flatten(1)
    measured = runs.measured[rows].flatten(1, 2)
    inputs = runs.inputs[rows[:-1].clamp(max=N - 2)].movedim(1, 2).flatten(2, 3)
    return Runs(time, measured, inputs, present)


def free_run(rate: Rate, begin: Float[Tensor, "*batch R n"], runs: Runs) -> Float[Tensor, "N *batch R n"]:
    """Return the states by the classical Runge-Kutta method; not finite where they diverge."""
    parts = (runs.inputs.shape[1] - 1) // 2
    steps = (runs.time.diff(dim=0) / parts).unsqueeze(-1)
    x = begin
    states = [x]
    for step, inputs in zip(steps, runs.inputs, strict=True):
        half = 0.5 * step
        for part in range(parts):
            early, middle, late = inputs[2 * part : 2 * part + 3]
            a = rate(x, early)
            b = rate(x + half * a, middle)
            c = rate(x + half * b, middle)
            d = rate(x + step * c, late)
            x = x + step / 6.0 * (a + 2.0 * (b + c) + d)
        states.append(x)
    return torch.stack(states)


def first_states(
    rate: Rate,
    guess: Float[Tensor, "*batch R n"],
    runs: Runs,
    outputs: list[int],
    seconds: float | None,
    iterations: int = 8,
) -> Float[Tensor, "*batch R n"]:
    """Fit initial states to the first seconds of the measurement, by Levenberg-Marquardt.

    Args:
        rate: of the states.
        guess: to start from.
        runs: the measured ones.
        outputs: which states are measured.
        seconds: how much of each run is looked at; None for all of it.
        iterations: at most.
    """
    seen = runs.present if seconds is None else runs.present & (runs.since <= seconds)
    count = max(int(seen.any(-1).nonzero().max()) + 1, 2)
    short, seen = runs.first(count), seen[:count]
    n = guess.shape[-1]
    size = guess.abs().flatten(0, -2).amax(0).clamp(min=1e-6)
    nudges = torch.cat([torch.zeros(1, n), torch.diag(1e-5 * size)]).to(guess)
    nudges = nudges.view(n + 1, *(1,) * (guess.dim() - 1), n)
    weight = seen.view(count, *(1,) * (guess.dim() - 2), -1, 1)

    def residual(begin: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (N, *batch, R, m) and their derivatives (N, *batch, R, m, n)."""
        simulated = free_run(rate, begin + nudges, short)[..., outputs].movedim(1, 0)
        target = short.measured.view(count, *(1,) * (guess.dim() - 2), *short.measured.shape[1:])
        left = torch.where(weight, (target - simulated[0]).nan_to_num(1e6, 1e6, -1e6), 0.0)
        slope = (simulated[1:] - simulated[:1]).movedim(0, -1) / (1e-5 * size)
        return left, torch.where(weight.unsqueeze(-1), slope.nan_to_num(0.0, 0.0, 0.0), 0.0)

    def cost(left: Tensor) -> Tensor:
        return left.square().sum((0, -1))

    begin, damping = guess, torch.full(guess.shape[:-1], 1e-3, dtype=guess.dtype)
    left, slope = residual(begin)
    for _ in range(iterations):
        hessian = torch.einsum("k...mi,k...mj->...ij", slope, slope)
        diagonal = hessian.diagonal(dim1=-2, dim2=-1)
        least = 1e-12 * diagonal.amax(-1, keepdim=True) + 1e-300
        damped = hessian + torch.diag_embed(damping.unsqueeze(-1) * diagonal + least)
        move = torch.linalg.solve(damped, torch.einsum("k...mi,k...m->...i", slope, left))
        trial = begin + move.nan_to_num(0.0, 0.0, 0.0)
        new_left, new_slope = residual(trial)
        better = cost(new_left) < cost(left)
        done = bool((cost(left) - cost(new_left) <= 1e-6 * cost(left)).all())
        begin = torch.where(better.unsqueeze(-1), trial, begin)
        left = torch.where(better.unsqueeze(-1), new_left, left)
        slope = torch.where(better.unsqueeze(-1).unsqueeze(-1), new_slope, slope)
        damping = torch.where(better, 0.1 * damping, 10.0 * damping)
        if done:
            break
    return begin


def error(
    simulated: Float[Tensor, "N *batch R m"], runs: Runs, scored: Bool[Tensor, "N R"], *, absolute: bool
) -> Float[Tensor, "*batch"]:
    """Return the mean absolute or RMS error of the scored samples; infinite where a run diverges.

    Example:
        >>> time = torch.arange(2.0).unsqueeze(-1)
        >>> runs = Runs(time, torch.zeros(2, 1, 1), torch.zeros(1, 3, 1, 0), time >= 0)
        >>> error(torch.tensor([1.0, torch.nan]).view(2, 1, 1), runs, time < 1, absolute=True)
        tensor(1.)
    """
    models = simulated.dim() - 3
    target = runs.measured.view(len(runs.measured), *(1,) * models, *runs.measured.shape[1:])
    counted = scored.view(len(scored), *(1,) * models, scored.shape[1], 1)
    away = (simulated - target).nan_to_num(torch.inf, torch.inf, torch.inf)
    away = torch.where(counted, away.abs() if absolute else away.square(), 0.0)
    mean = away.sum((0, -2, -1)) / (scored.sum() * simulated.shape[-1])
    return mean if absolute else mean.sqrt()


def named(names: tuple[str, ...], values: Float[Tensor, "*batch n"]) -> SimpleNamespace:
    """Columns as attributes, as a simulation's derivative takes them."""
    return SimpleNamespace(**dict(zip(names, values.unbind(-1), strict=True)))


def rate_of(system: Dynamics, values: Float[Tensor, " p"]) -> Rate:
    """Return the rates of a simulation's states, with these parameters."""
    p = named(tuple(system.parameters), values)

    def rate(x: Tensor, u: Tensor) -> Tensor:
        found = system.derivative(x.new_zeros(()), named(system.states, x), named(system.inputs, u), p)
        assert isinstance(found, Mapping)
        return torch.stack([found[state] for state in system.states], -1)

    return rate


def spread(values: Float[Tensor, "N R n"], present: Bool[Tensor, "N R"]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation, 1 where there is none, of what is present."""
    seen = values[present]
    deviation = seen.std(0)
    return seen.mean(0), torch.where(deviation > 0, deviation, 1.0)


def as_array(values: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """For packages that do not take tensors."""
    return values.detach().numpy()
