"""Fits of histone acetylation with given sets of motif-specific rates, many sets at once, and their AICc.

The noise is log-normal with σ = 1, as in the PEtab problem. The mean logarithm of each motif is sufficient then, and a
fit is one of 15 numbers by nonlinear least squares.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from acetylation import (
    EFFECTS,
    LARGEST_LOG_RATE,
    MOTIFS,
    NOMINAL_LOG_RATE,
    REACTIONS,
    HistoneAcetylation,
    recording,
    with_slopes,
)
from petab_select.criteria import calculate_aicc
from torch import Tensor

from mkc_torch.effects import Context
from mkc_torch.nonlinear import minimise

Selection = frozenset[int]
"""Numbers of the reactions with their own rate."""

MAX_STEPS = 60
LARGEST_STEP = 2.0
"""Largest change of a logarithm in a step."""
CONVERGED = 1e-9
"""A fit has converged when a step decreases the sum of squares by less than this."""


@dataclass(frozen=True)
class Fit:
    """A fitted selection: its AICc, and the log factors by reaction, with log a_b under -1."""

    aicc: float
    parameters: Mapping[int, float]


class Calibration:
    """Fits selections of motif-specific rates to measured abundances.

    Args:
        logs: logarithms of the measured abundances, by motif.
    """

    def __init__(self, logs: Mapping[str, Tensor]) -> None:
        self.logs = logs
        self.rows = torch.tensor([MOTIFS.index(motif) for motif in logs])
        self.means = torch.stack([rows.mean() for rows in logs.values()])
        counts = torch.tensor([float(len(rows)) for rows in logs.values()], dtype=torch.float64)
        self.roots, self.count = counts.sqrt(), int(counts.sum())
        each = (rows + 0.5 * math.log(2.0 * math.pi) + 0.5 * (rows - rows.mean()).square() for rows in logs.values())
        self.perfect = float(sum(part.sum() for part in each))

    def aicc(self, squares: float, rates: int) -> float:
        """AICc as petab-select computes it.

        Args:
            squares: sum of squares of the means' residuals, weighted by their number of measurements.
            rates: number of motif-specific rates; ``a_b`` is estimated in addition.
        """
        return float(calculate_aicc(self.perfect + 0.5 * squares, rates + 1, self.count, 0))

    def bound(self, rates: int) -> float:
        """Return the least possible AICc with this number of motif-specific rates: that of an exact fit."""
        return self.aicc(0.0, rates)

    def fitted(self, selections: Iterable[Selection], near: Fit | None = None) -> dict[Selection, Fit]:
        """Return fits by selection: the better of two starts, the shared rate and the parameters of ``near``."""
        found: dict[Selection, Fit] = {}
        by_size: dict[int, list[Selection]] = {}
        for item in selections:
            by_size.setdefault(len(item), []).append(item)
        for same in by_size.values():
            for start in [{}] if near is None else [{}, near.parameters]:
                for item, fit in zip(same, self._from(start, same), strict=True):
                    found[item] = min(found.get(item, fit), fit, key=lambda fit: fit.aicc)
        return found

    def by_effects(self, selection: Selection) -> Fit:
        """Fit all measurements by the simulation with an effect for each motif-specific rate."""
        prepared = HistoneAcetylation().prepare(recording(self.logs))
        effects = [EFFECTS[number] for number in sorted(selection)]
        nothing = prepared.time.new_zeros(len(prepared.time), 0)
        context = Context(prepared.time, nothing, (), nothing, "", ())

        def residual(theta: Tensor) -> Tensor:
            changes = {
                effect.port: lambda _signal, effect=effect, gamma=gamma: effect.change(gamma, {}, context)
                for effect, gamma in zip(effects, theta[1:].split(1), strict=True)
            }
            return prepared.residual(theta[:1], changes)

        start = torch.tensor([NOMINAL_LOG_RATE, *[0.0] * len(effects)], dtype=torch.float64)
        most = torch.full_like(start, LARGEST_LOG_RATE)
        solution = minimise(residual, start, lower=-most, upper=most)
        squares = float(solution.residual.square().sum())
        scatter = sum(float((rows - rows.mean()).square().sum()) for rows in self.logs.values())
        parameters = dict(zip((-1, *sorted(selection)), solution.theta.tolist(), strict=True))
        return Fit(self.aicc(squares - scatter, len(selection)), parameters)

    def _from(self, start: Mapping[int, float], selections: Sequence[Selection]) -> list[Fit]:
        """Fit selections of one size; rates that are not in the start begin at the shared rate."""
        numbers = [sorted(item) for item in selections]
        places = torch.tensor(numbers, dtype=torch.long).reshape(len(selections), -1)
        begin = [[start.get(-1, NOMINAL_LOG_RATE), *(start.get(number, 0.0) for number in item)] for item in numbers]
        theta, squares = self._least_squares(torch.tensor(begin, dtype=torch.float64), places)
        return [
            Fit(self.aicc(value, len(item)), dict(zip((-1, *item), row, strict=True)))
            for item, value, row in zip(numbers, squares.tolist(), theta.tolist(), strict=True)
        ]

    def _residual(self, theta: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted residuals (B, 15) and their derivatives (B, 15, 1 + k)."""
        log_rates = theta[:, :1].repeat(1, len(REACTIONS)).scatter_add(1, places, theta[:, 1:])
        logs, slopes = with_slopes(log_rates)
        residual = self.roots * (logs[:, self.rows] - self.means)
        slopes = self.roots.unsqueeze(-1) * slopes[:, self.rows]
        own = slopes.gather(2, places.unsqueeze(1).expand(-1, len(self.rows), -1))
        return residual, torch.cat([slopes.sum(-1, keepdim=True), own], -1)

    def _least_squares(self, theta: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Parameters (B, 1 + k) and sums of squares (B,) by Levenberg-Marquardt within the bounds.

        Converged fits leave the batch. `mkc_torch.nonlinear.minimise` keeps the batch until the last fit converges
        and takes ten times as long here.
        """
        damping = torch.full((len(theta),), 1e-2, dtype=torch.float64)
        residual, slopes = self._residual(theta, places)
        squares = residual.square().sum(-1)
        ends, end_squares, alive = theta.clone(), squares.clone(), torch.arange(len(theta))
        for _ in range(MAX_STEPS):
            trial = (theta + _step(theta, residual, slopes, damping)).clamp(-LARGEST_LOG_RATE, LARGEST_LOG_RATE)
            trial_residual, trial_slopes = self._residual(trial, places)
            trial_squares = trial_residual.square().sum(-1)
            better = trial_squares <= squares
            done = (better & (squares - trial_squares < CONVERGED)) | (damping > 1e8)
            theta = torch.where(better.unsqueeze(-1), trial, theta)
            residual = torch.where(better.unsqueeze(-1), trial_residual, residual)
            slopes = torch.where(better[:, None, None], trial_slopes, slopes)
            squares = torch.where(better, trial_squares, squares)
            damping = torch.where(better, 0.2 * damping, 5.0 * damping).clamp(1e-9, 1e9)
            ends[alive], end_squares[alive] = theta, squares
            if bool(done.all()):
                break
            left = ~done
            alive, theta, places, damping = alive[left], theta[left], places[left], damping[left]
            residual, slopes, squares = residual[left], slopes[left], squares[left]
        return ends, end_squares


def _step(theta: Tensor, residual: Tensor, slopes: Tensor, damping: Tensor) -> Tensor:
    """Damped Gauss-Newton steps (B, p); parameters at a bound stay there if the gradient points outwards."""
    gradient = (slopes * residual.unsqueeze(-1)).sum(1)
    at_bound = theta.abs() >= LARGEST_LOG_RATE - 1e-12
    free = (~(at_bound & (theta * gradient < 0.0))).double()
    curvature = slopes.mT @ slopes * free.unsqueeze(-1) * free.unsqueeze(-2)
    diagonal = curvature.diagonal(dim1=-2, dim2=-1)
    curvature = curvature + torch.diag_embed(damping.unsqueeze(-1) * (diagonal + 1e-3) + 1.0 - free)
    step = -torch.linalg.solve(curvature, (gradient * free).unsqueeze(-1)).squeeze(-1)
    return step.clamp(-LARGEST_STEP, LARGEST_STEP)
