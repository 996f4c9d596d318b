"""Random sets from a hash: distinct, uniform, reproducible, and the same in every batch."""

import pytest
import torch

from mkc_torch._support.elemental_sets import drawn_of_used, drawn_samples, drawn_sets, mixed
from mkc_torch.linear import LeastTrimmedSquares, MKCRegression, SRegression

CPU = torch.device("cpu")


def test_hash_is_splitmix64():
    # the first three outputs of splitmix64 from the state 0
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [h % (1 << 64) for h in mixed(torch.arange(3)).tolist()] == expected


@pytest.mark.parametrize(("size", "limit"), [(1, 1), (3, 3), (3, 7), (6, 300)])
def test_indices_of_a_set_are_distinct_and_below_the_limit(size, limit):
    sets = drawn_sets(5, 2000, size, limit, CPU)
    assert sets.shape == (2000, size)
    assert int(sets.min()) >= 0
    assert int(sets.max()) < limit
    assert bool((sets.sort(-1).values.diff(dim=-1) > 0).all())


def test_every_set_is_equally_probable():
    sets = drawn_sets(0, 20_000, 2, 5, CPU).sort(-1).values
    counts = torch.bincount(5 * sets[:, 0] + sets[:, 1], minlength=25)
    counts = counts[counts > 0]
    assert len(counts) == 10
    # chi-square with 9 degrees of freedom: 27.9 has probability 0.001
    assert float((counts - 2000.0).square().sum() / 2000.0) < 27.9


def test_first_sets_depend_on_the_seed_and_not_on_their_number(device):
    few, many = (drawn_sets(7, k, 3, 50, device) for k in (10, 1000))
    assert torch.equal(few, many[:10])
    assert torch.equal(few.cpu(), drawn_sets(7, 10, 3, 50, CPU))
    assert not torch.equal(few, drawn_sets(8, 10, 3, 50, device))
    assert torch.equal(drawn_samples(3, 20, 90, device).cpu(), drawn_samples(3, 20, 90, CPU))


def test_sets_of_used_rows_equal_those_of_the_list_of_used_rows():
    used = torch.rand(4, 30, generator=torch.Generator().manual_seed(0)) < 0.7
    sets = drawn_of_used(2, 100, 3, used, 30, CPU)
    for mask, of_problem in zip(used, sets, strict=True):
        places = mask.nonzero().squeeze(-1)
        assert torch.equal(of_problem, places[drawn_sets(2, 100, 3, len(places), CPU)])


def test_too_few_values_give_sets_with_repetitions():
    used = torch.zeros(1, 5, dtype=torch.bool)
    used[0, 3] = True
    assert set(drawn_of_used(0, 10, 2, used, 5, CPU)[..., 0].flatten().tolist()) == {3}


def test_samples_are_distinct_and_ascending():
    samples = drawn_samples(1, 40, 100, CPU)
    assert len(samples) == 40
    assert bool((samples.diff() > 0).all())
    assert int(samples.max()) < 100


@pytest.mark.parametrize("estimator", [LeastTrimmedSquares(), SRegression(), MKCRegression()], ids=repr)
def test_a_fit_does_not_depend_on_its_batch(estimator, device):
    generator = torch.Generator().manual_seed(0)
    X = torch.randn(9, 40, 3, dtype=torch.float64, generator=generator).to(device)
    y = X.sum(-1) + torch.randn(9, 40, dtype=torch.float64, generator=generator).to(device)
    whole = estimator.fit(X, y).coef_
    for part in (slice(0, 4), slice(6, 7)):
        torch.testing.assert_close(estimator.fit(X[part], y[part]).coef_, whole[part], rtol=1e-9, atol=1e-9)
