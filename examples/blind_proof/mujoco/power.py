"""How many standard errors an element is away from none, and from the other elements of its robot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from examples.blind_proof.mujoco.elements import Element
from examples.blind_proof.mujoco.stepping import Array, Truth, fitted_numbers, stepped

_STEP = 1e-3
"""Relative step of the fitted numbers, and step of the initial positions and speeds."""


@dataclass(frozen=True)
class Power:
    """Standard errors of the best test of an element.

    Attributes:
        z: against nothing hidden, with the fitted numbers and the initial state free.
        rivals: the other elements with the standard errors by which the recording separates them, nearest first.
    """

    z: float
    rivals: tuple[tuple[Element, float], ...]

    @property
    def z_sep(self) -> float:
        return min([distance for _, distance in self.rivals], default=self.z)


def power(truth: Truth, controls: Array, deviations: Array, outliers: float) -> Power:
    """Return the power of the best test.

    Args:
        truth: the robot with its element.
        controls: (N, k).
        deviations: standard deviation of each output's noise, (m,).
        outliers: share of the samples that say nothing.
    """
    without = replace(truth, element=None)
    base = stepped(without, controls)
    weight = math.sqrt(1.0 - outliers) / deviations

    def trace(changed: Truth) -> Array:
        return ((stepped(changed, controls) - base) * weight).ravel()

    free = np.stack([trace(other) for other in _nearby(without)], 1)
    basis = np.linalg.qr(free / np.linalg.norm(free, axis=0))[0]

    def seen(values: Array) -> Array:
        return values - basis @ (basis.T @ values)

    own = seen(trace(truth))
    rivals = []
    for rival in truth.robot.elements:
        if rival is not truth.element:
            other = seen(trace(replace(truth, element=rival, size=math.sqrt(rival.sizes[0] * rival.sizes[1]))))
            length = float(other @ other)
            away = own - other * (float(own @ other) / length) if length > 0.0 else own
            rivals.append((rival, float(np.linalg.norm(away))))
    return Power(float(np.linalg.norm(own)), tuple(sorted(rivals, key=lambda pair: pair[1])))


def _nearby(truth: Truth) -> Iterator[Truth]:
    """Yield the robot with each fitted number, and each part of the initial state, a little changed."""
    for name in fitted_numbers(truth.robot):
        yield replace(truth, factors={**truth.factors, name: truth.factors.get(name, 1.0) * (1.0 + _STEP)})
    begin = np.array(truth.begin)
    for place in range(len(begin)):
        moved = begin.copy()
        moved[place] += _STEP
        yield replace(truth, begin=tuple(moved.tolist()))
