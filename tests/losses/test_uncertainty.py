import math

import pytest
import torch
from torch import nn

from mkc_torch import (
    HeteroscedasticMKCLoss,
    MKCDistribution,
    MKCLoss,
    beyond_bound,
    fit_density,
    inlier_weight,
    outliers,
    predictive_interval,
)
from mkc_torch.functional import mkc_weight

INF, NAN = math.inf, math.nan
FIXED = {"learn_sigma": False, "learn_d": False}


def make_loss(num_channels=3, *, dtype=torch.float64, **options):
    m = num_channels
    settings = {"sigma": [0.7, 3.0, 20.0][:m], "d": [0.5, 1.0, 2.0][:m], "bound": [9.0, 40.0, 1e3][:m], **options}
    return MKCLoss(m, **{k: torch.tensor(v, dtype=dtype) if isinstance(v, list) else v for k, v in settings.items()})


def data(*shape, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [(3 * torch.randn(*shape, dtype=torch.float64, generator=generator)).to(dtype) for _ in range(2)]


# --- weights and flags


@pytest.mark.parametrize(("shape", "channel_dim"), [((5, 3), -1), ((3, 5), 0), ((5, 3, 4), 1), ((3,), 0)])
@pytest.mark.parametrize("options", [{}, FIXED], ids=["learned", "fixed"])
def test_inlier_weights_equal_those_of_the_fixed_point(shape, channel_dim, options):
    loss = make_loss(channel_dim=channel_dim, **options)
    x, y = data(*shape)
    expected = mkc_weight((x - y).movedim(channel_dim, -1), loss.sigma, loss.d).movedim(-1, channel_dim)
    found = inlier_weight(loss, x, y)
    torch.testing.assert_close(found, expected.detach(), rtol=1e-14, atol=0)
    assert not found.requires_grad
    assert ((found >= 0) & (found <= 1)).all()


def test_the_inlier_weight_equals_the_gradient_relative_to_least_squares():
    loss = make_loss(reduction="sum")
    x, y = data(6, 3)
    x.requires_grad_()
    (slope,) = torch.autograd.grad(loss(x, y), x)
    torch.testing.assert_close(inlier_weight(loss, x, y), (slope * loss.d**2 / (x - y)).detach())


def test_infinite_sigma_gives_weight_1_everywhere():
    loss = make_loss(sigma=INF, **FIXED)
    x, y = data(4, 3)
    assert (inlier_weight(loss, x, 1e30 * y) == 1).all()
    assert not outliers(loss, x, 1e30 * y).any()


def test_weights_of_half_precision_are_computed_in_float32():
    loss = make_loss(dtype=torch.float32)
    x, y = data(4, 3, dtype=torch.bfloat16)
    found = inlier_weight(loss, x, y)
    assert found.dtype == torch.float32
    assert torch.equal(found, inlier_weight(loss, x.float(), y.float()))


def test_a_nan_is_refused_as_by_the_loss():
    loss = make_loss()
    x, y = data(4, 3)
    y[2, 1] = NAN
    for function in (inlier_weight, outliers):
        with pytest.raises(ValueError, match=r"without NaN.*got 1, the first at index \(2, 1\).*torch\.where"):
            function(loss, x, y)
    assert not outliers(loss, x, torch.where(torch.isfinite(y), y, x))[2, 1]


def test_outliers_are_the_errors_beyond_their_distance():
    loss = make_loss()
    x, y = data(200, 3)
    y[0] = INF
    for limit in (0.01, 0.1, 0.5):
        reach = loss.sigma * loss.d * math.sqrt(2 * math.log(1 / limit))
        assert torch.equal(outliers(loss, x, y, limit), (x - y).abs() > reach)
    assert outliers(loss, x, y).dtype == torch.bool


def test_simulated_outliers_are_found_and_few_others():
    generator = torch.Generator().manual_seed(0)
    y = torch.randn(2000, 1, dtype=torch.float64, generator=generator)
    planted = torch.rand(2000, 1, generator=generator) < 0.2
    y = torch.where(planted, 10 + 20 * torch.rand(2000, 1, dtype=torch.float64, generator=generator), y)
    fit = fit_density(y)
    loss = MKCLoss(1, sigma=fit.sigma, d=fit.d, bound=fit.bound, **FIXED)
    flags = outliers(loss, torch.zeros_like(y), y)
    assert flags[planted].all()
    assert flags[~planted].double().mean() < 0.01


@pytest.mark.parametrize("limit", [0.0, 1.0, -0.1, NAN])
def test_a_limit_outside_0_and_1_is_refused(limit):
    with pytest.raises(ValueError, match=r"`weight_below`.*\(0, 1\)"):
        outliers(make_loss(), *data(4, 3), weight_below=limit)


# --- beyond the bound


def test_elements_beyond_the_bound_are_counted_per_channel():
    loss = make_loss(2, bound=10.0, channel_dim=1)
    y = torch.zeros(2, 2, 4, dtype=torch.float64)
    y[0, 0, 0], y[1, 0, 2], y[1, 1, 3], y[0, 1, 1] = 10.1, -11.0, 1e9, 10.0
    found = beyond_bound(loss, torch.zeros_like(y), y)
    assert found.count.tolist() == [2, 1]
    assert found.share.tolist() == [2 / 8, 1 / 8]
    assert found.count.dtype == torch.int64


def test_weights_and_masks_change_the_share_and_exclude_masked_elements():
    loss = make_loss(2, bound=10.0)
    x, y = torch.zeros(4, 2), torch.tensor([[20.0, 0.0], [0.0, 20.0], [20.0, 0.0], [NAN, INF]])
    found = beyond_bound(loss, x, y, torch.tensor([3.0, 0.5, 0.0, 0.0]))
    assert found.count.tolist() == [1, 1]
    assert found.share.tolist() == pytest.approx([3 / 3.5, 0.5 / 3.5])
    mask = torch.tensor([[True, False], [True, False], [False, False], [False, False]])
    found = beyond_bound(loss, x, y, mask)
    assert found.count.tolist() == [1, 0]
    assert found.share[0] == 0.5
    assert found.share[1].isnan()
    with pytest.raises(ValueError, match=r"`target`.*finite.*got 2"):
        beyond_bound(loss, x, y)


def test_a_single_sample_of_rank_one_is_counted():
    found = beyond_bound(make_loss(), torch.zeros(3), torch.tensor([10.0, 10.0, 1e4]))
    assert found.count.tolist() == [1, 0, 1]
    assert found.share.tolist() == [1, 0, 1]


# --- intervals


def coverage(loss, y, level):
    low, high = predictive_interval(loss, torch.zeros_like(y), level)
    return ((y > low) & (y < high)).double().mean(0), (y <= low).double().mean(0)


def within_binomial(share, expected, count):
    return bool(((share - expected).abs() < 4 * math.sqrt(expected * (1 - expected) / count)).all())


@pytest.fixture(scope="module")
def draws():
    """A loss and 20 000 draws of its density."""
    torch.manual_seed(0)
    loss = make_loss()
    return loss, MKCDistribution(loss.sigma.detach(), loss.d.detach(), loss.bound).sample((20_000,))


@pytest.mark.e2e
@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_interval_covers_draws_of_the_density_at_its_level_with_equal_tails(draws, level):
    loss, y = draws
    inside, below = coverage(loss, y, level)
    count = y.shape[0]
    assert within_binomial(inside, level, count)
    assert within_binomial(below, (1 - level) / 2, count)


@pytest.mark.parametrize("level", [0.5, 0.9, 0.99])
def test_interval_fitted_to_gaussian_noise_covers_new_noise(level):
    generator = torch.Generator().manual_seed(1)
    count, scale = 40_000, torch.tensor([0.3, 5.0], dtype=torch.float64)
    seen, y = (scale * torch.randn(count, 2, dtype=torch.float64, generator=generator) for _ in range(2))
    fit = fit_density(seen)
    inside, _ = coverage(MKCLoss(2, sigma=fit.sigma, d=fit.d, bound=fit.bound, **FIXED), y, level)
    assert within_binomial(inside, level, count / 2)  # the fitted d is as uncertain as the share


@pytest.mark.parametrize(("shape", "channel_dim"), [((5, 3), -1), ((3, 5), 0), ((5, 3, 4), -2), ((3,), 0)])
def test_interval_is_the_quantiles_about_each_prediction(shape, channel_dim):
    loss = make_loss(channel_dim=channel_dim)
    x, _ = data(*shape)
    low, high = predictive_interval(loss, x, 0.8)
    assert low.shape == high.shape == x.shape
    density = MKCDistribution(loss.sigma, loss.d, loss.bound, x.movedim(channel_dim, -1))
    for end, level in ((low, 0.1), (high, 0.9)):
        torch.testing.assert_close(
            end, density.icdf(torch.tensor(level).double()).detach().movedim(-1, channel_dim), rtol=1e-9, atol=1e-6
        )
    assert not low.requires_grad


def test_interval_at_infinite_sigma_is_gaussian_and_grows_with_the_level():
    loss = MKCLoss(1, sigma=INF, d=2.0, bound=200.0, **FIXED)
    ends = [predictive_interval(loss, torch.zeros(1, 1), level).high.item() for level in (0.682689492, 0.95, 0.9973)]
    assert ends == pytest.approx([2.0, 2 * 1.959964, 2 * 2.99998], rel=1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32])
def test_interval_of_the_smallest_sigma_in_float32_and_half_precision(dtype):
    loss = MKCLoss(1, sigma=0.05, d=1.0, bound=10.0)
    low, high = predictive_interval(loss, torch.zeros(2, 1, dtype=dtype), 0.9)
    assert low.dtype == torch.float32
    assert (high > 8.9).all()  # nearly uniform
    assert torch.equal(low, -high)


@pytest.mark.parametrize("level", [0.0, 1.0, 90, NAN])
def test_a_level_that_is_not_a_probability_is_refused(level):
    with pytest.raises(ValueError, match=r"`level`.*\(0, 1\)"):
        predictive_interval(make_loss(), torch.zeros(4, 3), level)


@pytest.mark.parametrize("function", [inlier_weight, outliers, beyond_bound])
def test_arguments_that_the_loss_refuses_are_refused(function):
    loss, x = make_loss(), torch.zeros(4, 3)
    with pytest.raises(ValueError, match="`input` and `target` of the same shape"):
        function(loss, x, torch.zeros(4, 1))
    with pytest.raises(ValueError, match="3 channels"):
        function(loss, x[:, :2], x[:, :2])
    with pytest.raises(TypeError, match=r"`target`.*floating-point"):
        function(loss, x, x.long())
    with pytest.raises(ValueError, match="at least one element"):
        function(loss, x[:0], x[:0])
    with pytest.raises(TypeError, match=r"`input`.*floating-point.*got ndarray"):
        function(loss, x.numpy(), x)


def result_fields(function, loss, x):
    found = function(loss, x, x)
    return vars(found).values() if hasattr(found, "__dict__") and not isinstance(found, torch.Tensor) else found


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
@pytest.mark.parametrize(
    "function", [inlier_weight, outliers, beyond_bound, lambda loss, x, _: predictive_interval(loss, x)]
)
def test_another_loss_is_refused_and_a_compiled_loss_accepted(function):
    x = torch.zeros(4, 3)
    for other, got in (
        (nn.MSELoss(), "MSELoss"),
        (HeteroscedasticMKCLoss(9.0), "HeteroscedasticMKCLoss"),
        (MKCLoss, "the class MKCLoss"),
        ("mkc", "str"),
    ):
        with pytest.raises(TypeError, match=rf"`loss`.*MKCLoss.*got {got}; pass the loss that is trained with"):
            function(other, x, x)
    loss = make_loss()
    for found, expected in zip(
        result_fields(function, torch.compile(loss), x), result_fields(function, loss, x), strict=True
    ):
        assert torch.equal(found, expected)


def test_predictions_that_are_not_finite_are_refused():
    loss, x = make_loss(), torch.zeros(4, 3)
    bad = x.clone()
    bad[2, 1] = NAN
    for call in (lambda: predictive_interval(loss, bad), lambda: beyond_bound(loss, bad, x)):
        with pytest.raises(ValueError, match=r"`input`.*finite.*got 1.*\(2, 1\)"):
            call()
    with pytest.raises(ValueError, match=r"`weight`.*>= 0 and finite.*got -1"):
        beyond_bound(loss, x, x, -torch.ones(4))


def test_limits_that_are_not_numbers_are_refused():
    x = torch.zeros(4, 3)
    with pytest.raises(TypeError, match=r"`weight_below`.*\(0, 1\).*got 'a'"):
        outliers(make_loss(), x, x, "a")
    with pytest.raises(TypeError, match=r"`level`.*\(0, 1\).*got None"):
        predictive_interval(make_loss(), x, None)
