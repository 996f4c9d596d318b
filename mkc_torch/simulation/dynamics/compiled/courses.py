"""Columns that depend on the parameters alone, and their derivatives, computed by torch for traced functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from mkc_torch._support.forward_mode import twice_reverse_tangents
from mkc_torch.simulation.dynamics.compiled.expressions import Array


class Courses:
    """Columns as a function of the parameters that need not be traceable, as an input behind a delay.

    Args:
        function: maps the parameters (p,) to the columns (S, u).

    Example:
        >>> time = torch.arange(3.0, dtype=torch.float64)
        >>> courses = Courses(lambda parameters: (parameters[0] * time**2).unsqueeze(-1))
        >>> courses.column([2.0], 0, None), courses.column([2.0], 0, 0)
        (array([0., 2., 8.]), array([0., 1., 4.]))
    """

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        tangents = twice_reverse_tangents(function)

        # an evaluation needs each column at the same parameters in turn
        @lru_cache(maxsize=2)
        def values(parameters: tuple[float, ...]) -> Array:
            return function(torch.tensor(parameters, dtype=torch.float64)).detach().numpy()

        @lru_cache(maxsize=2)
        def slopes(parameters: tuple[float, ...]) -> Array:
            return tangents(torch.tensor(parameters, dtype=torch.float64)).detach().numpy()

        self._values, self._slopes = values, slopes

    def column(self, parameters: Sequence[float], number: int, by: int | None) -> Array:
        """Return a column, (S,), or its derivative by the parameter of index ``by``."""
        known = tuple(parameters)
        return self._values(known)[:, number] if by is None else self._slopes(known)[by, :, number]
