"""A problem in float64, for what float32 cannot resolve."""

from __future__ import annotations

from dataclasses import replace

from mkc_torch.linear._problem import LinearProblem


def in_double(problem: LinearProblem) -> LinearProblem:
    """The same problem with its values in float64."""
    weight = problem.sample_weight
    return replace(
        problem,
        basis=problem.basis.double(),
        to_coef=problem.to_coef.double(),
        Y=problem.Y.double(),
        sample_weight=None if weight is None else weight.double(),
    )
