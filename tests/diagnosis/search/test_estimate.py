"""The final step of generalised least squares."""

import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.search.estimate import estimate
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from tests.diagnosis.line import Line


class Cliff(Line):
    """A line that is finite at the fitted parameters only."""

    known = None

    def residual(self, theta, changes):
        left = super().residual(theta, changes)
        if self.known is None or torch.equal(theta.detach(), self.known):
            return left
        return left * torch.nan


def test_the_step_is_smaller_than_the_errors():
    line = Line(600)
    fit = fitted(JointModel(line), line.start())
    found = estimate(fit, NoiseSettings())
    moved = (found.fit.parameters - fit.parameters).abs()
    assert bool((moved > 0).any())
    assert bool((moved < found.standard_error).all())
    torch.testing.assert_close(found.fit.residual, found.fit.model.residual(found.fit.parameters))


def test_a_step_to_a_residual_that_is_not_finite_is_rejected(monkeypatch):
    line = Cliff(600)
    fit = fitted(JointModel(line), line.start())
    monkeypatch.setattr("mkc_torch.diagnosis.search.estimate.tangents_of", tangents_before(line))
    found = estimate(fit, NoiseSettings())
    assert torch.equal(found.fit.parameters, fit.parameters)
    assert bool(found.fit.residual.isfinite().all())


def tangents_before(line):
    """Return the tangents of the plain line; afterwards the line is finite only where it was fitted."""

    def then_not_finite(model, parameters, settings):
        found = tangents_of(model, parameters, settings)
        line.known = parameters.detach().clone()
        return found

    return then_not_finite
