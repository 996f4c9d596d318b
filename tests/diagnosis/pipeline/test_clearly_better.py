"""Whether the fit without a finding is clearly less likely, whatever the standard error of its size."""

import types

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.pipeline.build import _clearly_better
from mkc_torch.diagnosis.settings import NamingSettings
from tests.diagnosis.cart import DRAG, cart_terms, free_fit

SAMPLES = 400


def fits(*residuals):
    """Return fits with these residuals, each with an effect of one amplitude and one fitted shape number."""
    effect = types.SimpleNamespace(fitted_shape={"time_constant": (0.1, 1.0)})
    model = types.SimpleNamespace(sizes=[1], terms=[types.SimpleNamespace(effect=effect)])
    return [
        types.SimpleNamespace(model=model, residual=residual.unsqueeze(-1), recorded=None) for residual in residuals
    ]


def noise(seed):
    return 0.1 * torch.randn(SAMPLES, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("size", "better"), [(0.0, False), (0.02, False), (1.0, True)])
def test_the_last_finding_needs_a_gain_above_its_penalty(size, better):
    decay = size * torch.exp(-(torch.arange(SAMPLES) % 100) / 10.0)
    assert _clearly_better(fits(noise(0) + decay, noise(0)), 0, NamingSettings()) is better


@pytest.mark.parametrize("drag_first", [True, False])
def test_each_finding_is_compared_with_the_model_of_all_others(drag_first):
    alone = free_fit(DRAG)
    (drag,), (force,) = (cart_terms(alone, name) for name in ("quadratic_drag", "constant_force"))
    terms = (drag, force) if drag_first else (force, drag)

    def fit(count):
        model = JointModel(alone.model.prepared, terms[:count])
        return fitted(model, torch.cat([alone.parameters, alone.parameters.new_zeros(count)]), alone.bound)

    chain = [alone, fit(1), fit(2)]
    answers = [_clearly_better(chain, number, NamingSettings()) for number in range(2)]
    assert answers == [drag_first, not drag_first]  # the drag alone, at either place
