"""The prior of a system's parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.simulation.parameter import Parameter


def prior_of(known: Sequence[Parameter], starts: int) -> GaussianPrior | None:
    """Return the prior of the parameters, with none of the initial states; None where no parameter has any.

    Two finite limits stand for a uniform distribution, by its mean and standard deviation: at a limit of the gravity,
    for example, missing drag would be estimated too large.

    Args:
        known: the parameters.
        starts: number of initial states, which follow.
    """
    mean, precision = torch.zeros(2, len(known) + starts, dtype=torch.float64)
    for k, parameter in enumerate(known):
        width = parameter.upper - parameter.lower
        if parameter.uncertainty is not None:
            mean[k], precision[k] = parameter.value, parameter.uncertainty**-2
        elif 0.0 < width < math.inf:
            mean[k], precision[k] = 0.5 * (parameter.lower + parameter.upper), 12.0 / width**2
    return GaussianPrior(mean, precision) if bool((precision > 0).any()) else None
