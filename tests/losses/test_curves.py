"""Value, influence and weight of a residual, a label, and an error among others."""

import math

import pytest
import torch

from mkc_torch import GeneralizedCrossEntropyLoss, HeteroscedasticMKCLoss, LELoss, MKCLoss
from mkc_torch.losses import entropy_like

LOSS = MKCLoss(2, sigma=torch.tensor([1.5, 4.0]), d=torch.tensor([0.5, 2.0]), bound=30.0).double()


def error_grid():
    return torch.linspace(-20.0, 20.0, 81, dtype=torch.float64).unsqueeze(-1).expand(81, 2).clone()


def test_influence_is_the_derivative_of_the_value_and_weight_its_ratio_to_least_squares():
    error = error_grid().requires_grad_()
    (slope,) = torch.autograd.grad(LOSS.rho(error).sum(), error)
    torch.testing.assert_close(LOSS.influence(error), slope)
    inside = error.detach().abs() > 0
    ratio = (LOSS.influence(error) * LOSS.d.square() / error)[inside]
    torch.testing.assert_close(LOSS.weight(error)[inside], ratio)


def test_far_away_the_value_is_the_squared_bandwidth_and_influence_is_0():
    far = torch.full((1, 2), 1e6, dtype=torch.float64)
    torch.testing.assert_close(LOSS.rho(far), LOSS.sigma.square().unsqueeze(0))
    assert LOSS.influence(far).abs().max().item() == 0.0
    assert LOSS.weight(far).max().item() == 0.0


def drawn_lines(axes) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    lines = [line for line in axes.lines if not line.get_label().startswith("_")]
    return {line.get_label(): tuple(torch.as_tensor(v).double() for v in line.get_data()) for line in lines}


def test_a_plot_shows_the_three_curves_of_a_channel():
    pytest.importorskip("matplotlib")
    curves = drawn_lines(LOSS.plot(1))
    assert set(curves) == {"value / σ²", "influence · d", "weight"}
    for name, of, factor in (
        ("value / σ²", LOSS.rho, 1.0 / 16.0),
        ("influence · d", LOSS.influence, 2.0),
        ("weight", LOSS.weight, 1.0),
    ):
        x, y = curves[name]
        assert float(x.min()) == -float(x.max())
        assert float(x.max()) == pytest.approx(24.0)  # three bandwidths of four scales of two
        torch.testing.assert_close(y, factor * of(x.unsqueeze(-1).expand(-1, 2))[:, 1].detach())
    for channel in (2, -1, True):
        with pytest.raises(ValueError, match=rf"`channel` in \[0, 2\).*got {channel}; 0 is the first"):
            LOSS.plot(channel)


def test_a_gaussian_is_drawn_unscaled_on_given_axes():
    figure = pytest.importorskip("matplotlib.figure")
    axes = figure.Figure().add_subplot()
    gaussian = MKCLoss(1, sigma=math.inf, d=1.0, learn_sigma=False)
    assert gaussian.plot(axes=axes) is axes
    x, y = drawn_lines(axes)["value"]
    torch.testing.assert_close(y, 0.5 * x.square())


def test_errors_of_other_channels_are_refused():
    with pytest.raises(ValueError, match=r"`error`.*2 channels.*got \(3,\)"):
        LOSS.weight(torch.zeros(3))
    with pytest.raises(TypeError, match="`error` to be"):
        LOSS.rho([0.0, 1.0])


SAMPLES, ENTROPY = HeteroscedasticMKCLoss(bound=50.0), LELoss()


def slope_of(rho, x: torch.Tensor) -> torch.Tensor:
    x = x.clone().requires_grad_()
    return torch.autograd.grad(rho(x).sum(), x)[0]


def test_each_sample_has_its_own_curves():
    error = torch.linspace(-9.0, 9.0, 40).double()
    sigma, d = torch.linspace(0.5, 5.0, 40).double(), torch.linspace(2.0, 0.1, 40).double()
    influence = SAMPLES.influence(error, sigma, d)
    torch.testing.assert_close(influence, slope_of(lambda e: SAMPLES.rho(e, sigma, d), error))
    torch.testing.assert_close(SAMPLES.weight(error, sigma, d), influence * d.square() / error)
    alike = MKCLoss(1, sigma=2.0, d=0.5, bound=50.0, learn_sigma=False, learn_d=False).double()
    for name in ("rho", "influence", "weight"):
        expected = getattr(alike, name)(error.unsqueeze(-1)).squeeze(-1).detach()
        torch.testing.assert_close(getattr(SAMPLES, name)(error, 2.0, 0.5), expected)


def test_the_value_of_a_sample_is_the_loss_without_its_normaliser():
    error, sigma, d = torch.tensor([[0.3], [-4.0]]), torch.full((2, 1), 1.5), torch.full((2, 1), 0.7)
    loss = HeteroscedasticMKCLoss(bound=50.0, reduction="none")
    change = loss(error, torch.zeros(2, 1), sigma, d) - loss(torch.zeros(2, 1), torch.zeros(2, 1), sigma, d)
    torch.testing.assert_close(change, loss.rho(error, sigma, d))


def test_the_plot_of_a_sample_shows_its_scaled_curves():
    pytest.importorskip("matplotlib")
    curves = drawn_lines(SAMPLES.plot(sigma=1.0, d=0.5))
    x, y = curves["influence · d"]
    torch.testing.assert_close(y, 0.5 * SAMPLES.influence(x, 1.0, 0.5))
    assert float(x.max()) == 3.0
    assert set(curves) == {"value / σ²", "influence · d", "weight"}
    for arguments, name in (({"sigma": 0.01}, "sigma"), ({"d": -1.0}, "d")):
        with pytest.raises(ValueError, match=f"`{name}`"):
            SAMPLES.plot(**arguments)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.2, 3.0, math.inf])
def test_the_curves_of_a_label_are_functions_of_its_probability(sigma):
    loss = GeneralizedCrossEntropyLoss(sigma=sigma, reduction="none").double()
    p = torch.linspace(0.001, 0.999, 60, dtype=torch.float64)
    logits = torch.stack([p.log(), (1.0 - p).log()], -1)
    labels = torch.zeros(60, dtype=torch.int64)
    torch.testing.assert_close(loss.rho(p), loss(logits, labels))
    torch.testing.assert_close(loss.influence(p), slope_of(loss.rho, p))
    torch.testing.assert_close(loss.weight_at(p), loss.influence(p) / (-1.0 / p))  # over cross-entropy's
    torch.testing.assert_close(loss.weight_at(p), loss.inlier_weight(logits, labels))


def test_curves_of_a_label_at_probabilities_0_and_1_are_their_limits():
    ends = torch.tensor([0.0, 1.0])
    loss = GeneralizedCrossEntropyLoss(sigma=2.0)
    assert loss.rho(ends).tolist() == [4.0, 0.0]
    assert loss.influence(ends).tolist() == [-math.inf, -1.0]
    assert loss.weight_at(ends).tolist() == [0.0, 1.0]
    with pytest.raises(ValueError, match=r"`probability`.*\[0, 1\].*got 1\.5.*softmax"):
        loss.rho(torch.tensor([0.5, 1.5]))
    with pytest.raises(TypeError, match="`probability` to be"):
        loss.weight_at(0.5)


@pytest.mark.parametrize("sigma", [1.2, math.inf])
def test_the_plot_of_a_label_shows_value_influence_and_weight(sigma):
    pytest.importorskip("matplotlib")
    loss = GeneralizedCrossEntropyLoss(sigma=sigma).double()
    curves = drawn_lines(loss.plot())
    assert set(curves) == {"value", "influence on the logit", "influence of cross-entropy", "weight"}
    p, influence = curves["influence on the logit"]
    # by autograd through two logits
    logit = torch.logit(p[1:-1]).requires_grad_()
    (slope,) = torch.autograd.grad(loss.rho(logit.sigmoid()).sum(), logit)
    torch.testing.assert_close(influence[1:-1], -slope)
    assert all(bool(torch.isfinite(y).all()) for _, y in curves.values())


def test_curves_of_the_entropy_equal_its_change_by_an_added_error():
    generator = torch.Generator().manual_seed(0)
    batch = torch.randn(60, generator=generator, dtype=torch.float64)
    error = torch.linspace(-30.0, 30.0, 40, dtype=torch.float64)
    joined = torch.stack([entropy_like(torch.cat([batch, e.reshape(1)])) for e in error])
    torch.testing.assert_close(ENTROPY.rho(error, batch), joined)
    torch.testing.assert_close(ENTROPY.influence(error, batch), slope_of(lambda e: ENTROPY.rho(e, batch), error))
    torch.testing.assert_close(ENTROPY.weight(error, batch), ENTROPY.influence(error, batch) / error)
    # the entropy does not depend on the unit
    torch.testing.assert_close(ENTROPY.rho(1e6 * error, 1e6 * batch), joined)
    assert ENTROPY.influence(torch.zeros(1), batch).tolist() == [0.0]
    assert ENTROPY.weight(torch.zeros(1), batch).tolist() == [math.inf]


def test_the_plot_of_the_entropy_shows_its_change_by_an_added_error():
    pytest.importorskip("matplotlib")
    batch = torch.linspace(-2.0, 3.0, 50, dtype=torch.float64)
    curves = drawn_lines(ENTROPY.plot(batch))
    x, y = curves["change of value · 51"]
    torch.testing.assert_close(y, 51.0 * (ENTROPY.rho(x, batch) - ENTROPY.rho(torch.zeros(1), batch)))
    scale = 1.4826 * float(batch.abs().quantile(0.5))
    assert [float(x.min()), float(x.max())] == pytest.approx([-6.0 * scale, 6.0 * scale], rel=0.05)
    assert all(bool(torch.isfinite(values).all()) for _, values in curves.values())
    assert "201" in next(iter(drawn_lines(ENTROPY.plot())))


@pytest.mark.parametrize(
    ("batch", "error", "message"),
    [
        (torch.zeros(5), ValueError, "`batch` .* not 0 but got only zeros"),
        (torch.zeros(0), ValueError, "`batch` to hold an error that is not 0 but got none"),
        (torch.tensor([1.0, math.nan]), ValueError, "`batch` .*finite"),
        ([1.0], TypeError, "`batch` to be"),
    ],
)
def test_a_batch_without_errors_is_refused(batch, error, message):
    for call in (lambda: ENTROPY.rho(torch.ones(1), batch), lambda: ENTROPY.plot(batch)):
        with pytest.raises(error, match=message):
            call()


def test_a_plot_for_a_batch_of_mostly_zeros_is_refused():
    pytest.importorskip("matplotlib")
    with pytest.raises(ValueError, match="more than half are 0"):
        ENTROPY.plot(torch.tensor([0.0, 0.0, 0.0, 1.0]))
