"""Helpers of alternating fits: weights of an E-step, the Gaussian state, and states of some problems of a batch."""

import torch

from mkc_torch.density.em import gaussian_state, normalised, replace_problems, weighted_rms
from mkc_torch.density.likelihood import initial_state, negative_log_likelihood

E = torch.linspace(-2.0, 3.0, 60, dtype=torch.float64).reshape(3, 10, 2)
WEIGHT = torch.arange(60, dtype=torch.float64).reshape(3, 10, 2) % 4
BOUND = torch.full((3, 2), 20.0, dtype=torch.float64)
LEAST = torch.full((3, 2), 0.2, dtype=torch.float64)


def test_normalised_weights_sum_to_one():
    found = normalised(WEIGHT)
    assert found is not None
    torch.testing.assert_close(found.sum(-2), torch.ones(3, 2).double())
    assert normalised(None) is None


def test_weighted_rms_is_the_weighted_root_mean_square_with_a_lower_limit():
    wanted = ((WEIGHT * E.square()).sum(-2) / WEIGHT.sum(-2)).sqrt()
    torch.testing.assert_close(weighted_rms(E, normalised(WEIGHT), LEAST), torch.maximum(wanted, LEAST))
    assert torch.equal(weighted_rms(0.0 * E, None, LEAST), LEAST)


def test_the_gaussian_state_has_the_maximum_likelihood_on_the_domain():
    state = initial_state(E, None, LEAST, BOUND, LEAST)
    gaussian = gaussian_state(E, None, state)
    assert (gaussian.kappa == 0).all()
    torch.testing.assert_close(torch.exp(gaussian.log_d), weighted_rms(E, None, LEAST))
    torch.testing.assert_close(gaussian.value, negative_log_likelihood(E, None, gaussian))
    assert torch.equal(gaussian.log_bound, state.log_bound)


def test_problems_are_replaced_at_their_index():
    whole = initial_state(E, None, LEAST, BOUND, LEAST)
    part = gaussian_state(E, None, whole).select(torch.tensor([2]))
    found = replace_problems(whole, torch.tensor([1]), part)
    assert torch.equal(found.kappa[1], part.kappa[0])
    assert torch.equal(found.log_d[[0, 2]], whole.log_d[[0, 2]])
    assert found.free_kappa == whole.free_kappa
