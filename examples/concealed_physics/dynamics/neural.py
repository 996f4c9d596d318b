"""A small neural ODE: the rates of the simulation, corrected by a perceptron and trained by multiple shooting.

Neural ODE: Chen et al., NeurIPS 2018; multiple shooting: Bock & Plitt, IFAC World Congress 1984.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import torch
from free_run import Rate, Runs, free_run, rate_of, spread, windows
from problem import FITTED, Outcome, Problem
from torch import Tensor
from torch.nn.functional import linear

HIDDEN = 16
"""Units of each of the two layers."""

EPOCHS = 300
"""Epochs of the longest training."""

CHECKS = 5
"""Number of times that a training is judged."""

RATE = 1e-2
"""Learning rate of Adam at the start."""

JOINED = 1.0
"""Weight of the gaps between the windows of multiple shooting, relative to the data."""


@dataclass(frozen=True)
class Network:
    """A perceptron of two layers on scaled states and drives; its output is in the rates' typical size.

    Attributes:
        weights: matrices and offsets of the layers, alternating.
        mean: mean of states and drives.
        deviation: standard deviation of states and drives.
        size: typical size of the corrected rates.
    """

    weights: list[Tensor]
    mean: Tensor
    deviation: Tensor
    size: Tensor

    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Return matrices (after, before) and offsets of the layers; the first and last layers include the scales."""
        first, a, second, b, last, c = self.weights
        inward = first / self.deviation.unsqueeze(-1)
        return [(inward.T, a - self.mean @ inward), (second.T, b), ((last * self.size).T, c * self.size)]


def new_network(problem: Problem, runs: Runs, seed: int) -> Network:
    """Return a network whose correction is 0."""
    x = problem.from_measured(runs)
    u = torch.cat([runs.inputs[:, 0], runs.inputs[-1:, -1]])
    values = problem.with_drives(x, u)
    mean, deviation = spread(values, runs.present)
    step = runs.time.diff(dim=0).unsqueeze(-1)
    slopes = x.diff(dim=0)[..., problem.targets] / torch.where(step > 0, step, torch.inf)
    _, size = spread(slopes, runs.present[1:])
    generator = torch.Generator().manual_seed(seed)
    wide = [values.shape[-1], HIDDEN, HIDDEN, len(problem.targets)]
    weights = []
    for layer, (before, after) in enumerate(pairwise(wide)):
        matrix = torch.randn(before, after, generator=generator, dtype=x.dtype) / before**0.5
        weights += [matrix * (layer < 2), x.new_zeros(after)]
    return Network([weight.requires_grad_() for weight in weights], mean, deviation, size)


def neural_rate(problem: Problem, network: Network, parameters: Tensor) -> Rate:
    """Return the rates of the simulation, corrected by the perceptron."""
    known = rate_of(problem.case.system, parameters)
    (first, a), (second, b), (last, c) = network.layers()
    into = torch.eye(len(problem.case.system.states), dtype=parameters.dtype)[:, problem.targets]
    last, c = into @ last, into @ c

    def rate(x: Tensor, u: Tensor) -> Tensor:
        hidden = torch.tanh(linear(problem.with_drives(x, u), first, a))
        return known(x, u) + linear(torch.tanh(linear(hidden, second, b)), last, c)

    return rate


def trained(
    problem: Problem, runs: Runs, length: int, epochs: int, check: Callable[[int, Rate], None], seed: int
) -> Rate:
    """Train a neural ODE by multiple shooting over windows.

    Args:
        problem: the case; the simulation's parameters start at its fitted parameters.
        runs: training runs.
        length: window length in steps.
        epochs: number of epochs of Adam; the learning rate decreases to 0 as a cosine.
        check: called with the number of epochs and the current rates; StopIteration ends the training.
        seed: seed of the initial weights.
    """
    network = new_network(problem, runs, seed)
    R = runs.time.shape[1]
    cut = windows(runs, length)
    begin = problem.from_measured(runs)[:-1:length].flatten(0, 1)
    _, deviation = spread(begin.unsqueeze(0), cut.present[:1])
    scale = deviation[problem.outputs]
    moved = torch.zeros_like(begin, requires_grad=True)
    factors = torch.zeros_like(problem.fitted, requires_grad=True)
    optimiser = torch.optim.Adam([*network.weights, moved, factors], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
    joined = (cut.present[:2].all(0)[R:]).unsqueeze(-1)

    def rate() -> Rate:
        return neural_rate(problem, network, problem.fitted * (1.0 + factors))

    for epoch in range(1, epochs + 1):
        optimiser.zero_grad()
        starts = begin + deviation * moved
        states = free_run(rate(), starts, cut)
        away = ((states[..., problem.outputs] - cut.measured) / scale)[cut.present]
        gaps = torch.where(joined, (states[-1, :-R] - starts[R:]) / deviation, 0.0)
        loss = away.square().mean() + JOINED * gaps.square().sum() / joined.sum().clamp(min=1)
        loss.backward()
        torch.nn.utils.clip_grad_norm_([*network.weights, moved, factors], 1.0)
        optimiser.step()
        schedule.step()
        if epoch % max(epochs // CHECKS, 1) == 0:
            with torch.no_grad():
                try:
                    check(epoch, rate())
                except StopIteration:
                    break
    return rate()


def neural_ode(problem: Problem, early: Problem, seed: int = 0) -> Outcome:
    """Return the neural ODE's result; windows and epochs are chosen on the held-out part of the training runs."""
    judged: dict[tuple[int, int], float] = {}
    for length in problem.physics.windows:

        def note(epoch: int, rate: Rate, length: int = length) -> None:
            judged[length, epoch] = float(early.judged(rate))

        trained(early, problem.train.until(FITTED), length, EPOCHS, note, seed)
    length, epochs = min(judged, key=lambda key: judged[key])

    def stop(epoch: int, _: Rate) -> None:
        if epoch == epochs:
            raise StopIteration

    with_all = trained(problem, problem.train, length, EPOCHS, stop, seed)
    settings = f"windows of {length} steps, {epochs} of {EPOCHS} epochs"
    with torch.no_grad():
        errors = problem.unseen(with_all)
    return Outcome(errors, "-", f"{settings}; held-out error {problem.in_unit(judged[length, epochs])}")
