"""Whether a fit depends on the step of integration."""

from __future__ import annotations

import torch

from mkc_torch.diagnosis.linearised.estimate import estimate
from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.nonlinear import NoFitError
from mkc_torch.simulation.protocol import PreparedSimulation

__all__ = ["with_smaller_step"]

MOVED_ERRORS = 0.5
"""Standard errors by which half the step has to move a parameter for the step to matter."""

NEGLIGIBLE = 1e-3
"""Relative change of every parameter below which the standard errors are not computed."""


def with_smaller_step(fit: FittedModel, settings: NoiseSettings) -> PreparedSimulation | None:
    """Return the system with half the step if that moves a parameter by more than half its standard error.

    Args:
        fit: of a simulation with or without effects.
        settings: of the noise that standard errors are of.

    Returns:
        None if the step does not matter, if the user set it, or if it is the smallest.
    """
    known, model = fit.model.prepared, fit.model
    finer = known.finer()
    if finer is None:
        return None
    try:
        again = fitted(JointModel(finer, model.terms), fit.parameters, fit.bound, graduate=False)
    except NoFitError:
        return None
    move = (again.parameters - fit.parameters).abs()
    # initial states are not results
    reported = torch.ones_like(move, dtype=torch.bool)
    reported[model.base - known.beginnings : model.base] = False
    if not bool((move > NEGLIGIBLE * fit.parameters.abs())[reported].any()):
        return None
    error = estimate(fit, settings).standard_error
    return finer.open_loop() if bool((move > MOVED_ERRORS * error)[reported].any()) else None
