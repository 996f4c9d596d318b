"""Slopes that are not finite: a parameter's is an error that names it, a candidate's leaves the candidate out."""

import sys

import pytest
import torch

from mkc_torch.diagnosis.linearised.tangents import tangents_of
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.locate import locate
from mkc_torch.diagnosis.search.strongest import strongest
from mkc_torch.effects.base import GainEffect
from tests.diagnosis.line import Line

MODULE = sys.modules[strongest.__module__]


class Edge(Line):
    """``+ √(slope²)``, whose slope is not a number at 0; forward mode does not say by which parameter."""

    def residual(self, theta, changes):
        return super().residual(theta, changes) - theta[1].square().sqrt()


class Offset(GainEffect):
    id = "offset"
    port = "mixed"
    gain = "offset"

    def course(self, shape, context):  # noqa: ARG002
        return torch.ones_like(context.time)


class Vertical(Offset):
    id = "vertical"

    def course(self, shape, context):  # noqa: ARG002
        return torch.full_like(context.time, torch.nan)


class Lost(Line):
    """Finite while effects are fitted, and never again."""

    lost = False

    def residual(self, theta, changes):
        return super().residual(theta, changes) * (torch.nan if self.lost and changes else 1.0)


def test_a_parameter_without_a_slope_is_named():
    model = JointModel(Edge())
    with pytest.raises(ValueError, match="no finite slope by level, slope at the fitted values"):
        tangents_of(model, torch.tensor([1.0, 0.0], dtype=torch.float64))


def test_a_candidate_without_a_slope_is_left_out():
    model = JointModel(Line())
    terms = (Term(Offset(), None, {}), Term(Vertical(), None, {}))
    first, second = tangents_of(model, model.prepared.start(), terms).candidates
    assert float(first.abs().max()) > 0
    assert float(second.abs().max()) == 0


def test_a_simulation_that_is_lost_again_says_so(monkeypatch):
    line = Lost()
    base = fitted(JointModel(line), line.start())
    refit = MODULE._refit_all

    def then_lost(*args):
        refit(*args)
        line.lost = True

    monkeypatch.setattr(MODULE, "_refit_all", then_lost)
    with pytest.raises(ValueError, match="gives none now at the same parameters"):
        locate(base, (Term(Offset(), None, {}),), level=0.05, surrogates=19, generator=torch.Generator(), parts=False)


class Remembering(Line):
    """A trajectory is found again under a transform only where it was the last one that was found."""

    last = None

    def residual(self, theta, changes):
        left = super().residual(theta, changes)
        if torch._C._functorch.is_functorch_wrapped_tensor(theta):
            return left if self.last == self.searched else left * torch.nan
        self.last = theta.tolist()
        return left


def test_slopes_are_looked_for_from_the_trajectory_at_the_same_parameters():
    line = Remembering(60)
    model = JointModel(line)
    parameters = torch.tensor([0.9, 0.6], dtype=torch.float64)
    line.searched = parameters.tolist()
    model.residual(parameters + 1.0)
    assert bool(tangents_of(model, parameters).nuisance.isfinite().all())
