import pytest
import torch

from mkc_torch._support.order_statistic import order_statistic


def by_cumulated_share(values, weight, h):
    """Return the h-th smallest value of each column by a sum over the sorted weights."""
    ordered, index = values.sort(dim=-2)
    cumulated = weight.expand_as(values).gather(-2, index).cumsum(-2)
    reached = cumulated >= h / values.shape[-2] * cumulated[..., -1:, :] * (1 - 1e-12)
    return ordered.gather(-2, reached.double().argmax(-2, keepdim=True)).squeeze(-2)


@pytest.mark.parametrize("h", [1, 7.3, 101, 153, 200])
@pytest.mark.parametrize("share", [1.0, 0.6])
def test_zero_weights_equal_a_weighted_order_statistic(h, share):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 5, 200, 3, generator=generator, dtype=torch.float64)
    weight = (torch.rand(200, 1, generator=generator) < share).double()
    expected = by_cumulated_share(values, weight, h)
    assert torch.equal(order_statistic(values, weight, h), expected)


def test_each_problem_of_a_batch_has_its_own_weights():
    values = torch.arange(6.0).view(1, 6, 1).expand(2, 6, 1)
    weight = torch.tensor([[1.0, 0, 0, 1, 0, 0], [0, 0, 1, 1, 1, 0]]).unsqueeze(-1)
    assert order_statistic(values, weight, 3).tolist() == [[0.0], [3.0]]
