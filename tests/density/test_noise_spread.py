"""Noise whose spread depends on the input is distinguished from outliers, on other shapes than set the limits."""

import numpy as np
import pytest
import torch

from mkc_torch import MKCLoss
from mkc_torch.density import ChannelTails, NoiseSpread
from mkc_torch.density.noise_spread import spread_over

N = 800
SHAPES = {
    "sawtooth": lambda x: 0.1 + 0.9 * (3.0 * x % 1.0),
    "root": lambda x: 0.02 + np.sqrt(x),
    "two levels": lambda x: np.where(abs(x - 0.5) < 0.2, 0.1, 0.7),
    "exponential": lambda x: np.exp(-3.0 * x),
}
WRONG = ["uniform", "one-sided", "far", "near"]
SEEDS = range(5)


def drawn(seed, shape=None, wrong=None, share=0.3):
    """Errors and the column on which their spread depends, and an unrelated column."""
    random = np.random.default_rng(seed)
    x, other = random.uniform(size=(2, N))
    error = random.normal(size=N) * (0.3 if shape is None else SHAPES[shape](x))
    rows = random.uniform(size=N) < (share if wrong else 0.0)
    far = {"uniform": random.uniform(-10, 10, N), "one-sided": random.uniform(3, 10, N), "far": 1e3, "near": 2.0}
    return np.where(rows, far.get(wrong, 0.0), error), [("other", other), ("x", x)]


@pytest.mark.parametrize("shape", SHAPES)
def test_noise_that_depends_on_a_column_is_found_without_outliers(shape):
    for seed in SEEDS:
        found = spread_over(*with_weights(*drawn(seed, shape)))
        assert found.column == "x"
        assert found.p_value < 1e-4
        assert not found.has_outliers
        assert str(found).endswith("no outliers; use MKCHead")


@pytest.mark.parametrize("wrong", WRONG)
def test_outliers_alone_are_no_dependence(wrong):
    for seed in SEEDS:
        for share in (0.05, 0.3, 0.45):
            assert spread_over(*with_weights(*drawn(seed, wrong=wrong, share=share))) is None


@pytest.mark.parametrize("wrong", ["uniform", "one-sided", "far"])
@pytest.mark.parametrize("shape", ["sawtooth", "exponential"])
def test_outliers_in_noise_that_depends_on_a_column_are_reported_with_it(shape, wrong):
    for seed in SEEDS:
        found = spread_over(*with_weights(*drawn(seed, shape, wrong, share=0.2)))
        assert found.column == "x"
        assert found.has_outliers
        assert found.tails.share_beyond == pytest.approx(0.2, abs=0.1)


def test_equal_noise_is_no_dependence():
    assert [spread_over(*with_weights(*drawn(seed))) for seed in range(40)] == [None] * 40


def test_the_spread_is_that_of_the_groups_and_has_the_unit_of_the_error():
    error, columns = drawn(0, "two levels")
    found = spread_over(*with_weights(1e3 * error, columns))
    assert found.least == pytest.approx(100.0, rel=0.3)
    assert found.most == pytest.approx(700.0, rel=0.3)


def test_a_column_of_two_values_makes_two_groups():
    random = np.random.default_rng(0)
    x = random.uniform(size=N) < 0.3
    found = spread_over(np.where(x, 1.0, 0.2) * random.normal(size=N), np.ones(N), [("x", x.astype(float))])
    assert found.column == "x"
    assert found.most / found.least == pytest.approx(5.0, rel=0.2)


def test_errors_of_weight_0_are_ignored_and_few_errors_give_no_statement():
    error, columns = drawn(0, "root")
    weight = (np.arange(N) % 2).astype(float)
    kept = [(name, values[1::2]) for name, values in columns]
    assert spread_over(error, weight, columns) == spread_over(error[1::2], np.ones(N // 2), kept)
    assert spread_over(error, (np.arange(N) < 79).astype(float), columns) is None
    assert spread_over(np.zeros(N), np.ones(N), columns) is None


def with_weights(error, columns):
    return error, np.ones(N), columns


def heteroscedastic_batch(seed=1):
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(N, 3, generator=g)
    prediction = torch.stack([x[:, 0], x[:, 1]], -1)
    noise = torch.randn(N, 2, generator=g) * torch.stack([0.05 + x[:, 0], torch.full((N,), 0.3)], -1)
    return x, prediction, prediction + noise


def test_a_loss_reports_noise_that_depends_on_its_predictions():
    _, prediction, target = heteroscedastic_batch()
    loss = MKCLoss(2)
    loss(prediction, target)
    for tails in (loss.tails(), loss.tails(prediction, target)):
        lines = str(tails).splitlines()
        assert lines[0].startswith("channel 0: noise depends on the prediction (spread ")
        assert lines[0].endswith("no outliers; use MKCHead")
        assert lines[1] == "channel 1: Gaussian"
        assert tails.spread[1] is None


def test_a_loss_reports_noise_that_depends_on_a_feature_alone():
    x, prediction, target = heteroscedastic_batch()
    target[:, 1] = prediction[:, 1] + (target - prediction)[:, 1] * (0.1 + 5.0 * x[:, 2])
    loss = MKCLoss(2)
    loss(prediction, target)
    assert loss.tails(prediction, target).spread[1] is None
    assert loss.tails(prediction, target, features=x).spread[1].column == "feature 2"
    image = [values.T[None] for values in (prediction, target)]
    channels_second = MKCLoss(2, channel_dim=1)
    channels_second(*image)
    assert channels_second.tails(*image, features=x[None]).spread[1].column == "feature 2"


def test_masked_predictions_need_not_be_numbers():
    x, prediction, target = heteroscedastic_batch()
    mask = torch.ones(N, dtype=torch.bool)
    mask[:3], prediction[:3] = False, torch.nan
    loss = MKCLoss(2)
    loss(prediction, target, mask[:, None])
    assert loss.tails(prediction, target, mask[:, None], features=x).spread[0] is not None


def test_bad_features_are_refused():
    x, prediction, target = heteroscedastic_batch()
    loss = MKCLoss(2)
    loss(prediction, target)
    with pytest.raises(ValueError, match=r"`features` of finite values of shape \(800, p\) but got \(3, 800\)"):
        loss.tails(prediction, target, features=x.T)
    with pytest.raises(ValueError, match="but got NaN or infinity"):
        loss.tails(prediction, target, features=torch.full_like(x, torch.nan))
    with pytest.raises(ValueError, match="with `input` and `target`"):
        loss.tails(features=x)
    with pytest.raises(TypeError, match="Expected argument `features` to be a real floating-point tensor"):
        loss.tails(prediction, target, features=x.numpy())


def test_the_text_names_outliers_and_their_share():
    heavy = NoiseSpread("the prediction", 0.1, 2.0, 1e-9, ChannelTails(31.2, 0.091, 0.01))
    assert str(heavy) == (
        "noise depends on the prediction (spread 0.1 to 2), 9 ± 1 % of the errors beyond 3 local d; use MKCHead"
    )
