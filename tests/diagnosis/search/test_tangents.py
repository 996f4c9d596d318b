"""Derivatives that are not finite: a parameter raises an error that names it, a candidate is left out."""

import pytest
import torch

from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects.base import GainEffect
from mkc_torch.nonlinear import NoFitError
from tests.diagnosis.line import Line


class Edge(Line):
    """``+ √(slope²)``, whose derivative is NaN at 0, in forward mode for all parameters."""

    def residual(self, theta, changes):
        return super().residual(theta, changes) - theta[1].square().sqrt()


class Offset(GainEffect):
    id = "offset"
    port = "mixed"
    gain = "offset"

    def waveform(self, shape, context):
        return torch.ones_like(context.time)


class Vertical(Offset):
    id = "vertical"

    def waveform(self, shape, context):
        return torch.full_like(context.time, torch.nan)


def test_a_parameter_without_a_finite_derivative_is_named():
    model = JointModel(Edge())
    with pytest.raises(NoFitError, match="no finite derivative by level, slope"):
        tangents_of(model, torch.tensor([1.0, 0.0], dtype=torch.float64), NoiseSettings())


def test_a_candidate_without_a_finite_derivative_is_left_out():
    model = JointModel(Line())
    terms = (Term(Offset(), None, {}), Term(Vertical(), None, {}))
    first, second = tangents_of(model, model.prepared.start(), NoiseSettings(), terms).candidates
    assert float(first.abs().max()) > 0
    assert float(second.abs().max()) == 0
