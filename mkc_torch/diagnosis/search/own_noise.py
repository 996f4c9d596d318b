"""Joint fits, each under its own remaining noise, and the penalty of that noise."""

from __future__ import annotations

from collections.abc import Mapping

from mkc_torch.diagnosis.model.fit import FittedModel, fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import estimate_noise, noise_of_fit
from mkc_torch.diagnosis.model.shaped import shape_fitted
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

__all__ = ["priced", "with_own_noise"]


def with_own_noise(fit: FittedModel, declared: Mapping[str, float], settings: Settings) -> FittedModel:
    """Return the joint fit of a candidate, with its shape, under the most likely sizes of the remaining noise."""
    noise = estimate_noise(fit, declared, settings.noise, noise_of_fit(fit, declared))
    if noise is None:
        return shape_fitted(fit)
    model = JointModel(fit.model.prepared.observed(noise.observer), fit.model.terms, fit.model.near)
    try:
        again = fitted(model, fit.parameters, fit.bound, graduate=False, fresh=True)
    except NoFitError:
        return shape_fitted(fit)
    return shape_fitted(again if priced(again, settings) > priced(fit, settings) else fit)


def priced(fit: FittedModel, settings: Settings) -> float:
    """Return the log-likelihood less the penalty of the disturbances in a fit's noise."""
    observer = fit.model.prepared.observer
    return fit.log_likelihood - settings.noise.disturbance_gain * (
        0 if observer is None else len(observer.disturbances)
    )
