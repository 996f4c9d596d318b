from collections import Counter

import pytest
import torch

from examples.blind_proof.draws import generator, unit_variance
from examples.blind_proof.magnetometer.noise import (
    FAMILIES,
    KIND_SHARES,
    KINDS,
    MOST_OUTLIERS,
    Outliers,
    axis_errors,
    contaminate,
    draw_noise,
    draw_outliers,
)


@pytest.mark.parametrize(("family", "kurtosis"), [("gaussian", 3.0), ("laplace", 6.0), ("student", 9.0)])
def test_noise_families_have_unit_variance_and_their_kurtosis(family, kurtosis):
    x = unit_variance(generator(0, family), family, 400_000)
    assert float(x.var()) == pytest.approx(1.0, rel=0.02)
    # the fourth moment of Student's t with five degrees of freedom converges slowly
    assert float(x.pow(4).mean()) == pytest.approx(kurtosis, rel=0.35 if family == "student" else 0.05)


def test_noise_kinds_have_their_declared_shares():
    drawn = [draw_noise(generator(1, k), 4500, 50.0) for k in range(600)]
    counts = Counter(noise.kind for noise in drawn)
    for kind, share in zip(KINDS, KIND_SHARES, strict=True):
        assert counts[kind] / 600 == pytest.approx(share, abs=0.06)
    assert set(FAMILIES) == {noise.family for noise in drawn}
    assert all(0.2 <= noise.sigma <= 0.8 for noise in drawn)


@pytest.mark.parametrize("kind", KINDS)
def test_errors_have_the_stated_size(kind):
    noise = next(n for k in range(200) if (n := draw_noise(generator(2, k), 4500, 50.0)).kind == kind)
    errors = axis_errors(generator(3), noise, 4500)
    assert errors.shape == (4500, 3)
    largest = 4.0 if noise.walks else 2.0
    assert bool((errors.std(0) < largest * noise.sigma).all() and (errors.std(0) > 0.3 * noise.sigma).all())


def test_an_offset_walk_reaches_half_to_five_sigmas():
    walks = [n for k in range(300) if "walk" in (n := draw_noise(generator(4, k), 4500, 50.0)).kind and n.walks]
    assert {n.kind for n in walks} == {"offset walk", "ar1 and offset walk"}
    ends = [process.innovation * 4500**0.5 / n.sigma for n in walks for process in n.walks]
    assert min(ends) > 0.3
    assert max(ends) < 7.5


def test_one_sided_outliers_have_their_share_sign_and_size():
    up = torch.tensor([0.0, 0.0, 1.0]).double().expand(4000, 3)
    for burst in (1.0, 20.0):
        bad, mask = contaminate(generator(5), Outliers(0.15, burst, True, (5.0, 50.0)), 0.5, up)
        assert int(mask.sum()) == 600
        sizes = bad[mask].norm(dim=-1) / 0.5
        assert float(sizes.min()) * (1 + 1e-9) >= 5.0
        assert float(sizes.max()) <= 50.0 * (1 + 1e-9)
        assert bool((bad[mask][:, 2] > 0).all())
        assert float(bad[~mask].abs().max()) == 0.0


def test_bursts_are_longer_than_isolated_outliers():
    def runs(burst):
        _, mask = contaminate(
            generator(6), Outliers(0.1, burst, False, (5.0, 50.0)), 0.5, torch.zeros(4000, 3).double()
        )
        return int((mask[1:] & ~mask[:-1]).sum())

    assert runs(20.0) < 0.3 * runs(1.0)


def test_shares_of_outliers_stay_in_range():
    shares = [draw_outliers(generator(7, k)).share for k in range(200)]
    assert max(shares) <= MOST_OUTLIERS
    assert 10 <= shares.count(0.0) <= 55
