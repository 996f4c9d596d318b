"""The final step of generalised least squares."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.estimate import estimate, within_bounds
from mkc_torch.diagnosis.search.linearise import CosineProjection, linearise
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects import GainEffect, Quantity
from mkc_torch.simulation import Port
from tests.diagnosis.line import Line


class Cliff(Line):
    """A line whose residual is this many times as large away from the fitted parameters."""

    known, away = None, math.nan

    def residual(self, theta, changes):
        left = super().residual(theta, changes)
        if self.known is None or torch.equal(theta.detach(), self.known):
            return left
        return left * self.away


def test_the_step_is_smaller_than_the_errors():
    line = Line(600)
    fit = fitted(JointModel(line), line.start())
    found = estimate(fit, NoiseSettings())
    moved = (found.fit.parameters - fit.parameters).abs()
    assert bool((moved > 0).any())
    assert bool((moved < found.standard_error).all())
    torch.testing.assert_close(found.fit.residual, found.fit.model.residual(found.fit.parameters))


@pytest.mark.parametrize("away", [math.nan, 1.5])
def test_a_step_to_a_worse_residual_is_rejected(monkeypatch, away):
    line = Cliff(600)
    line.away = away
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


class Chirp(GainEffect):
    """A sine of two fitted numbers, fast in a recording of :class:`Line`."""

    id, port = "chirp", "left"
    fitted_shape = {"frequency": (50.0, 5000.0), "rise": (1.0, 500.0)}

    def quantities(self, shape, context):
        return (Quantity("gain", 1, "V"),)

    def waveform(self, shape, context):
        time = context.time
        return torch.sin((shape["frequency"] + shape["rise"] * time) * time)


class LineWithChirp(Line):
    """A line whose left channel has an effect of its own, fast compared with the line."""

    ports = {**Line.ports, "left": Port(("left",), "V")}

    def __init__(self, N, *terms):
        super().__init__(N)
        for frequency, rise in terms:
            self.measured[:, 0] += torch.sin((frequency + rise * self.time) * self.time)

    def residual(self, theta, changes):
        left = super().residual(theta, changes)
        if "left" in changes:
            change = changes["left"](self.time.new_zeros(len(self.time), 1))
            left = left - torch.cat([change, torch.zeros_like(change)], -1)
        return left


def test_shape_numbers_have_errors_if_their_tangents_are_faster_than_those_of_the_other_parameters():
    shapes = [(2000.0, 30.0), (2600.0, 20.0)]
    line = LineWithChirp(1500, *shapes)
    terms = [Term(Chirp(), None, {"frequency": frequency, "rise": rise}) for frequency, rise in shapes]
    fit = fitted(JointModel(line, terms), torch.tensor([1.0, 0.5, 1.0, 1.0], dtype=torch.float64))
    tangents = tangents_of(fit.model, fit.parameters, NoiseSettings())
    # the case that matters: with the shapes, most tangents are fast
    values, counts = fit.pseudo(NoiseSettings())
    fast = replace(tangents, nuisance=tangents.nuisance[..., 2:])
    kept = [CosineProjection.of(values, counts, known, None).kept for known in (tangents, fast)]
    assert kept[0] < kept[1]
    found = estimate(fit, NoiseSettings())
    for errors in found.shape_errors:
        assert 0.0 < errors["frequency"] < 1.0


def test_a_known_spectrum_sets_the_number_of_coefficients():
    line = LineWithChirp(1500)
    model = JointModel(line)
    fit = fitted(model, line.start())
    tangents = tangents_of(model, fit.parameters, NoiseSettings())
    values, counts = fit.pseudo(NoiseSettings())
    known = linearise(model, fit.parameters, values, counts, tangents, drift=False).spectrum
    fast = replace(tangents, nuisance=line.mixing[..., :2])
    again = linearise(model, fit.parameters, values, counts, fast, spectrum=known, drift=False)
    near = linearise(model, fit.parameters, values, counts, fast, near=known)
    assert len(known.root) == len(again.spectrum.root) == len(near.spectrum.root) < 1500


@given(seed=st.integers(0, 2**32 - 1), size=st.integers(1, 6), width=st.floats(0.01, 3.0))
def test_parameters_inside_their_bounds_take_their_conditional_estimates(seed, size, width):
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(size, size + 2, generator=generator, dtype=torch.float64)
    covariance = root @ root.mT
    parameters, step = torch.zeros(size, dtype=torch.float64), 3.0 * root[:, 0]
    lower, upper = parameters - width, parameters + width
    moved, left = within_bounds(parameters, step, covariance, (lower, upper))
    ends = parameters - moved
    assert bool(((ends >= lower - 1e-12) & (ends <= upper + 1e-12)).all())
    free = (ends > lower + 1e-9) & (ends < upper - 1e-9)
    # the gradient of (step - moved)ᵀ covariance⁻¹ (step - moved) is 0 in the free directions
    gradient = torch.linalg.solve(covariance, step - moved)
    assert float((gradient * covariance.diagonal().sqrt())[free].abs().sum()) < 1e-6
    assert bool((left.diagonal() <= covariance.diagonal() + 1e-9).all())
    assert float(left.diagonal()[~free].abs().sum()) < 1e-6 * float(covariance.diagonal().sum())


def test_a_step_within_the_bounds_is_unchanged():
    step, covariance = torch.tensor([0.3, -0.2]), torch.tensor([[1.0, 0.9], [0.9, 1.0]])
    found = within_bounds(torch.zeros(2), step, covariance, (torch.full((2,), -1.0), torch.ones(2)))
    torch.testing.assert_close(found, (step, covariance))
