"""Value, pull and weight of a residual."""

import pytest
import torch

from mkc_torch import MKCLoss

LOSS = MKCLoss(2, sigma=torch.tensor([1.5, 4.0]), d=torch.tensor([0.5, 2.0]), bound=30.0).double()


def errors():
    return torch.linspace(-20.0, 20.0, 81, dtype=torch.float64).unsqueeze(-1).expand(81, 2).clone()


def test_the_pull_is_the_derivative_of_the_value_and_the_weight_its_ratio_to_least_squares():
    error = errors().requires_grad_()
    (slope,) = torch.autograd.grad(LOSS.rho(error).sum(), error)
    torch.testing.assert_close(LOSS.influence(error), slope)
    inside = error.detach().abs() > 0
    ratio = (LOSS.influence(error) * LOSS.d.square() / error)[inside]
    torch.testing.assert_close(LOSS.weight(error)[inside], ratio)


def test_far_away_the_value_is_the_square_of_the_bandwidth_and_nothing_pulls():
    far = torch.full((1, 2), 1e6, dtype=torch.float64)
    torch.testing.assert_close(LOSS.rho(far), LOSS.sigma.square().unsqueeze(0))
    assert LOSS.influence(far).abs().max().item() == 0.0
    assert LOSS.weight(far).max().item() == 0.0


def test_a_picture_shows_the_three_curves_of_a_channel():
    pytest.importorskip("matplotlib")
    axes = LOSS.plot(1)
    lines = {line.get_label(): line for line in axes.lines}
    assert set(lines) == {"value", "pull, times d", "weight"}
    x, y = (torch.as_tensor(v).double() for v in lines["value"].get_data())
    assert float(x.max()) == pytest.approx(12.0)
    torch.testing.assert_close(y, LOSS.rho(x.unsqueeze(-1).expand(-1, 2))[:, 1].detach())
    with pytest.raises(ValueError, match=r"`channel` in \[0, 2\) but got 2"):
        LOSS.plot(2)


def test_errors_of_other_channels_are_refused():
    with pytest.raises(ValueError, match=r"`error` with 2 channels in its last dimension but got \(3,\)"):
        LOSS.weight(torch.zeros(3))
    with pytest.raises(TypeError, match="`error` to be"):
        LOSS.rho([0.0, 1.0])
