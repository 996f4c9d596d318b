"""Values and derivatives of an FMU's equations at many points, with a cache of the last results."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mkc_torch.simulation.fmu.binary import Binary
from mkc_torch.simulation.fmu.description import Description
from mkc_torch.simulation.foreign.evaluation import CachedEvaluation, Group

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_STEP = float(np.finfo(np.float64).eps) ** (1.0 / 3.0)
"""Relative step of a central difference, at which the errors by rounding and by curvature are similar."""

_STRAIGHT = 1e-8
"""Relative difference of slopes over two step sizes up to which a function counts as affine."""

_AGREE = 1e-4
"""Relative difference between directional derivative and central difference up to which the former is used."""


class Evaluation(CachedEvaluation):
    """An FMU as a function of time, states, inputs and parameters that returns rates or outputs.

    Args:
        description: description of the FMU; its binary is loaded at the first use in each process.
    """

    def __init__(self, description: Description) -> None:
        super().__init__()
        self.description = description
        self._binary: Binary | None = None
        self._trusted: dict[tuple[bool, int], bool] = {}
        self._affine: dict[tuple[bool, int], bool] = {}

    def __getstate__(self) -> Description:
        return self.description

    def __setstate__(self, description: Description) -> None:
        Evaluation.__init__(self, description)

    @property
    def binary(self) -> Binary:
        if self._binary is None:
            self._binary = Binary(self.description)
        return self._binary

    def count(self, outputs: bool) -> int:
        return len(self.description.outputs if outputs else self.description.rates)

    def fresh(self, outputs: bool, rows: tuple[Array, Array, Array], parameters: Array) -> Array:
        if not self.binary.begin(parameters.tolist()):
            return np.full((len(rows[0]), self.count(outputs)), np.nan)
        return self.binary.values(outputs, *rows)

    def columns(
        self,
        outputs: bool,
        rows: tuple[Array, Array, Array],
        given: Array,
        group: Group,
        numbers: Sequence[int],
        base: Array,
    ) -> Array:
        quantities = list(getattr(self.description, group))
        trusted = [self._is_trusted(outputs, rows, given, group, k) for k in numbers]
        found = np.empty((len(rows[0]), self.count(outputs), len(numbers)))
        by = [place for place, usable in enumerate(trusted) if usable]
        if by and self.binary.begin(given.tolist()):
            references = [quantities[numbers[place]].reference for place in by]
            found[:, :, by] = self.binary.slopes(outputs, *rows, references).swapaxes(1, 2)
        elif by:
            found[:, :, by] = np.nan
        for place, k in enumerate(numbers):
            if trusted[place]:
                continue
            if group == "parameters" and self._is_affine(outputs, rows, given, k):
                step = self._step_within(given, k)
                found[:, :, place] = self._one_sided_difference(outputs, rows, given, k, base, step)
            else:
                found[:, :, place] = self._central_difference(outputs, rows, given, group, k)
        return found

    def _is_affine(self, outputs: bool, rows: tuple[Array, Array, Array], given: Array, place: int) -> bool:
        """Whether rates are affine in a parameter, tested once at a few points: a single step gives the derivative.

        Where they are not affine at other points, the step is still small.
        """
        if (outputs, place) not in self._affine:
            few = _rows(rows, slice(None, None, max(1, len(rows[0]) // 16)))
            base = self.fresh(outputs, few, given)
            step = self._step_within(given, place)
            near, far = (
                self._one_sided_difference(outputs, few, given, place, base, step * more) for more in (1.0, 30.0)
            )
            rounding = 8.0 * np.finfo(np.float64).eps * np.abs(base).max(initial=0.0) / abs(step)
            close = np.abs(near - far) <= _STRAIGHT * np.abs(far).max(initial=0.0) + rounding
            self._affine[outputs, place] = bool(close.all())
        return self._affine[outputs, place]

    def _one_sided_difference(
        self, outputs: bool, rows: tuple[Array, Array, Array], given: Array, place: int, base: Array, step: float
    ) -> Array:
        """The derivative by a parameter, (S, k), by a one-sided difference."""
        moved = given.copy()
        moved[place] += step
        return (self.fresh(outputs, rows, moved) - base) / (moved[place] - given[place])

    def _step_within(self, given: Array, place: int) -> float:
        """A step of a parameter within its upper bound."""
        parameter = list(self.description.parameters.values())[place]
        step = _STEP * (abs(given[place]) or abs(parameter.value) or 1.0)
        return step if given[place] + 30.0 * step <= parameter.upper else -step

    def _is_trusted(
        self, outputs: bool, rows: tuple[Array, Array, Array], given: Array, group: Group, place: int
    ) -> bool:
        """Whether the FMU's directional derivative exists and agrees with a difference, tested once at a few points."""
        description = self.description
        if not description.derivatives or (group == "parameters" and description.version == 2):
            return False  # FMI 2.0 has them only by states and inputs
        reference = list(getattr(description, group))[place].reference
        if (outputs, reference) not in self._trusted:
            every = max(1, len(rows[0]) // 4)
            few = _rows(rows, slice(None, None, every))
            difference = self._central_difference(outputs, few, given, group, place)
            self.binary.begin(given.tolist())
            own = self.binary.slopes(outputs, few[0], few[1], few[2], [reference])[:, 0]
            size = np.abs(difference).max(initial=1e-300)
            close = bool((np.abs(own - difference) <= _AGREE * size).all())
            self._trusted[outputs, reference] = close
        return self._trusted[outputs, reference]

    def _central_difference(
        self, outputs: bool, rows: tuple[Array, Array, Array], given: Array, group: Group, place: int
    ) -> Array:
        """The derivative by a variable, (S, k), by a central difference."""
        time, states, inputs = rows
        if group == "parameters":
            step = abs(self._step_within(given, place))
            parameter = list(self.description.parameters.values())[place]
            ends = [given.copy(), given.copy()]
            ends[0][place] = max(given[place] - step, parameter.lower)
            ends[1][place] = min(given[place] + step, parameter.upper)
            low, high = (self.fresh(outputs, rows, end) for end in ends)
            return (high - low) / (ends[1][place] - ends[0][place])
        table = states if group == "states" else inputs
        step = _step(table[:, place])
        answers, places = [], []
        for sign in (-1.0, 1.0):
            moved = table.copy()
            moved[:, place] += sign * step
            places.append(moved[:, place])
            pair = (moved, inputs) if group == "states" else (states, moved)
            answers.append(self.fresh(outputs, (time, *pair), given))
        return (answers[1] - answers[0]) / (places[1] - places[0])[:, None]


def _rows(parts: tuple[Array, Array, Array], which: Any) -> tuple[Array, Array, Array]:
    time, states, inputs = (np.ascontiguousarray(part[which]) for part in parts)
    return time, states, inputs


def _step(values: Sequence[float] | Array) -> float:
    """A step for a whole column by its mean absolute value, because a value near 0 has no scale."""
    size = float(np.abs(values).mean()) if len(values) else 1.0
    return _STEP * (size if np.finfo(size).tiny < _STEP * size < np.inf else 1.0)
