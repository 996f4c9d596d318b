"""The minimum covariance determinant: published estimates, all subsets, breakdown, equivariance, limits."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.covariance import MinCovDet
from torch import Tensor

from mkc_torch.covariance import MinimumCovarianceDeterminant
from mkc_torch.covariance._corrections import consistency_factor, small_sample_factor
from tests.covariance.reference import REFERENCES, SETS
from tests.draws import normal as sample

MCD = MinimumCovarianceDeterminant


def contaminated(seed: int, N: int = 60, p: int = 3, share: float = 0.3) -> Tensor:
    """Correlated samples (N, p); the first ``share`` of the rows are far outliers."""
    X = sample(seed, N, p) @ (torch.eye(p, dtype=torch.float64) + 0.5 * sample(seed + 1, p, p))
    X[: int(share * N)] += 10.0 + sample(seed + 2, int(share * N), p)
    return X


def covariance(X: Tensor) -> Tensor:
    error = X - X.mean(-2, keepdim=True)
    return error.mT @ error / (X.shape[-2] - 1)


def smallest_log_determinant(X: Tensor, h: int) -> Tensor:
    """The smallest log determinant of all subsets."""
    index = torch.tensor(list(itertools.combinations(range(X.shape[0]), h)))
    return torch.logdet(covariance(X[index])).min()


# published results


@pytest.mark.parametrize("reference", REFERENCES, ids=lambda r: f"{r.name} {r.alpha:g}")
def test_estimates_equal_robustbase(reference):
    fit = MCD(reference.alpha).fit(SETS[reference.name]())
    assert fit.h_ == int(fit.support_.sum()) == reference.h
    assert float(fit.objective_) == pytest.approx(reference.objective, rel=1e-6)
    assert fit.raw_location_.tolist() == pytest.approx(list(reference.raw_location), rel=1e-6)
    assert fit.location_.tolist() == pytest.approx(list(reference.location), rel=1e-6)
    # R divides the variance of a single column by h; its criterion and all its covariances divide by h - 1
    divisor = reference.h / (reference.h - 1) if len(reference.location) == 1 else 1.0
    variance = [divisor * value for value in reference.raw_variance]
    assert fit.raw_covariance_.diagonal().tolist() == pytest.approx(variance, rel=1e-6)
    expected = reference.covariance()
    unit = expected.diagonal().sqrt()
    torch.testing.assert_close(
        fit.covariance_ / unit / unit[:, None], expected / unit / unit[:, None], rtol=0, atol=1e-6
    )
    if len(reference.location) > 1:
        far = (fit.distances_ > fit.distance_cutoff_).nonzero().flatten() + 1
        assert far.tolist() == list(reference.far)


@pytest.mark.parametrize(
    ("name", "rows"),
    [
        ("hbk", set(range(1, 15))),  # Hawkins, Bradu & Kass (1984): all leverage points, good ones too
        ("stackloss", {1, 2, 3, 21}),  # Rousseeuw & van Zomeren (1990), table 1
        ("stars_cyg_y", {7, 11, 20, 30, 34}),  # Rousseeuw & Leroy (1987), p. 262, and the star between
    ],
)
def test_published_outliers_have_distances_beyond_the_cutoff(name, rows):
    fit = MCD().fit(SETS[name]())
    assert rows <= {int(i) + 1 for i in (fit.distances_ > fit.distance_cutoff_).nonzero()}


@pytest.mark.parametrize("name", ["stackloss", "hbk", "hbk_y", "salinity", "delivery_y", "versicolor", "iris"])
def test_the_objective_is_not_above_that_of_scikit_learn(name):
    X = SETS[name]()
    peer = MinCovDet(random_state=0).fit(X.numpy())
    mine = MCD(h=int(peer.raw_support_.sum())).fit(X)
    theirs = float(torch.logdet(covariance(X[torch.as_tensor(peer.raw_support_)])))
    assert float(mine.objective_) <= theirs + 1e-9


@pytest.mark.parametrize("name", ["stackloss", "salinity", "wood", "hbk", "stars_cyg_y"])
def test_estimates_equal_scikit_learn_without_the_small_sample_correction(name):
    """The first three sets have the same support, the last three the same reweighted samples."""
    X = SETS[name]()
    N, p = X.shape
    peer = MinCovDet(random_state=0).fit(X.numpy())
    h, k = int(peer.raw_support_.sum()), int(peer.support_.sum())
    fit = MCD(h=h, consistency="cutoff").fit(X)
    half = (N + p + 1) // 2
    fraction = 0.5 + 0.5 * (h - half) / (N - half)  # scikit-learn rounds up
    small = {which: small_sample_factor(N, p, fraction, reweighted=which) for which in (False, True)}
    # scikit-learn divides by the number of samples
    if name in ("stackloss", "salinity", "wood"):
        assert fit.support_.tolist() == peer.raw_support_.tolist()
        torch.testing.assert_close(fit.raw_location_, torch.as_tensor(peer.raw_location_))
        raw = torch.as_tensor(peer.raw_covariance_) * consistency_factor(h / N, p) * h / (h - 1)
        torch.testing.assert_close(fit.raw_covariance_, raw * small[False])
    if name in ("wood", "hbk", "stars_cyg_y"):
        assert fit.weights_.bool().tolist() == peer.support_.tolist()
        torch.testing.assert_close(fit.location_, torch.as_tensor(peer.location_))
        torch.testing.assert_close(fit.covariance_, torch.as_tensor(peer.covariance_) * small[True] * k / (k - 1))


# the optimum


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("N", "p", "h"), [(10, 2, 7), (12, 3, 8), (11, 1, 6), (12, 1, 9), (9, 2, 9)])
def test_the_optimum_equals_the_search_over_all_subsets(seed, N, p, h):
    X = sample(seed, N, p) * torch.exp(sample(seed + 100, N, 1))
    assert float(MCD(h=h).fit(X).objective_) == pytest.approx(float(smallest_log_determinant(X, h)), abs=1e-9)


@pytest.mark.parametrize("far", [1e3, 1e9, 1e70])
def test_a_single_column_with_far_values_keeps_its_digits(far):
    values = sample(0, 41, 1)
    values[:10] = -far * (1.0 + values[:10].abs())
    ordered = values.flatten().sort().values
    least = torch.stack([ordered[i : i + 23].var() for i in range(19)]).min()
    assert float(MCD(h=23).fit(values).objective_) == pytest.approx(float(least.log()), abs=1e-12)


@pytest.mark.parametrize("name", SETS)
def test_every_seed_finds_the_same_optimum(name):
    X = SETS[name]()
    found = [float(MCD(seed=seed, reweight=False).fit(X).objective_) for seed in range(1, 4)]
    assert max(found) == pytest.approx(min(found), abs=1e-9)


def test_no_exchange_of_two_samples_lowers_the_determinant():
    X = contaminated(4, N=30)
    fit = MCD(starts=2).fit(X)
    inside, outside = fit.support_.nonzero().flatten(), (~fit.support_).nonzero().flatten()
    for i, j in itertools.product(inside.tolist(), outside.tolist()):
        others = fit.support_.clone()
        others[i], others[j] = False, True
        assert float(torch.logdet(covariance(X[others]))) >= float(fit.objective_) - 1e-9


def test_large_samples_reach_a_fixed_point():
    X = sample(0, 2500, 3)
    X[:900] += 8.0
    fit = MCD(starts=50).fit(X)
    assert bool(fit.converged_)
    assert not fit.weights_[:900].any()
    raw = torch.linalg.inv(covariance(X[fit.support_]))
    error = X - X[fit.support_].mean(0)
    nearest = torch.einsum("ni,ij,nj->n", error, raw, error).topk(fit.h_, largest=False).indices
    assert set(nearest.tolist()) == set(fit.support_.nonzero().flatten().tolist())


# robustness and consistency


@pytest.mark.parametrize("p", [1, 2, 4])
@pytest.mark.parametrize("far", ["cluster", "point", "cloud", "farther"])
def test_forty_percent_of_far_outliers_have_no_influence(p, far):
    X = sample(p, 100, p)
    clean = X[40:].clone()
    X[:40] = {
        # nearer clusters would have the smallest determinant in four columns
        "cluster": 1e3 + 0.1 * sample(9, 40, p),
        "point": torch.full((40, p), 1e4, dtype=torch.float64),
        "cloud": 1e3 * sample(9, 40, p),
        "farther": 1e70 * torch.sign(sample(9, 40, p)),
    }[far]
    fit = MCD(consistency="cutoff").fit(X)
    if far != "cloud":  # a few points of a cloud may lie near
        assert not fit.weights_[:40].any()
        assert (fit.distances_[:40] > fit.distance_cutoff_).all()
    torch.testing.assert_close(fit.location_, clean.mean(0), atol=0.25, rtol=0)
    size = torch.linalg.eigvals(torch.linalg.solve(covariance(clean), fit.covariance_)).real
    assert 0.4 < float(size.min()) <= float(size.max()) < 1.6


def test_a_tight_cluster_of_smallest_determinant_is_the_support():
    X = sample(0, 200, 4)
    X[:80] = 30.0 + 0.1 * sample(1, 80, 4)
    fit = MCD().fit(X)
    clean = MCD(h=fit.h_).fit(X[80:])
    assert fit.support_[:80].all()
    assert float(fit.objective_) < float(clean.objective_)


def test_the_share_correction_is_larger_than_the_cutoff_correction():
    X = sample(0, 200, 2)
    X[:80] += 50.0
    share, cutoff = (MCD(consistency=which).fit(X) for which in ("share", "cutoff"))
    k = int(share.weights_.sum())
    ratio = consistency_factor(k / 200, 2) / consistency_factor(0.975, 2)
    torch.testing.assert_close(share.covariance_, cutoff.covariance_ * ratio)
    assert ratio > 1.8


@pytest.mark.parametrize("options", [{}, {"consistency": "cutoff"}, {"support_fraction": 0.75}], ids=str)
def test_the_covariance_of_gaussian_samples_is_consistent(options):
    mixed = torch.tensor([[2.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.5, -0.3, 0.1]], dtype=torch.float64)
    X = sample(0, 20000, 3) @ mixed.mT + 5.0
    fit = MCD(starts=50, **options).fit(X)
    white = torch.linalg.inv(mixed)
    for estimate in (fit.covariance_, fit.raw_covariance_):
        share = torch.linalg.eigvalsh(white @ estimate @ white.mT)
        assert (share - 1.0).abs().max() < (0.03 if estimate is fit.covariance_ else 0.1)
    torch.testing.assert_close(fit.location_, torch.full_like(fit.location_, 5.0), atol=0.05, rtol=0)
    assert float((fit.distances_ > fit.distance_cutoff_).double().mean()) == pytest.approx(0.025, abs=0.004)


@pytest.mark.parametrize(("N", "p"), [(30, 2), (24, 4)])
def test_the_determinant_of_few_samples_is_unbiased(N, p):
    fit = MCD(starts=50).fit(sample(0, 300, N, p))
    for estimate in (fit.raw_covariance_, fit.covariance_):
        assert float((torch.logdet(estimate) / p).exp().mean()) == pytest.approx(1.0, abs=0.12)


# limits and properties


def test_full_support_without_reweighting_gives_the_sample_covariance():
    X = contaminated(0)
    for fit in (MCD(1.0, reweight=False).fit(X), MCD(h=60, reweight=False).fit(X)):
        torch.testing.assert_close(fit.location_, X.mean(0))
        torch.testing.assert_close(fit.covariance_, torch.cov(X.mT))
        torch.testing.assert_close(fit.correlation_, torch.corrcoef(X.mT))
        assert bool(fit.weights_.all())


def test_without_reweighting_the_raw_estimates_are_the_result():
    fit = MCD(reweight=False).fit(contaminated(0))
    assert torch.equal(fit.covariance_, fit.raw_covariance_)
    assert torch.equal(fit.weights_.bool(), fit.support_)
    assert not torch.allclose(fit.covariance_, MCD().fit(contaminated(0)).covariance_)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 999),
    p=st.integers(1, 4),
    N=st.integers(14, 40),
    logs=st.lists(st.floats(-8, 8), min_size=4, max_size=4),
    shift=st.floats(-1e3, 1e3),
)
def test_the_estimate_is_affine_equivariant(seed, p, N, logs, shift):
    X = contaminated(seed, N, p)
    orthogonal = torch.linalg.qr(sample(seed + 5, p, p)).Q
    change = orthogonal * torch.exp(torch.tensor(logs[:p], dtype=torch.float64) / 4.0) * 10.0 ** (logs[0] / 2.0)
    before = MCD(starts=40).fit(X)
    moved = MCD(starts=40).fit(X @ change.mT + shift)
    assert torch.equal(before.support_, moved.support_)
    size = float(change.abs().max())
    torch.testing.assert_close(moved.location_, change @ before.location_ + shift, rtol=1e-7, atol=1e-7 * (size + 1))
    torch.testing.assert_close(
        moved.covariance_, change @ before.covariance_ @ change.mT, rtol=1e-6, atol=1e-7 * size**2
    )
    torch.testing.assert_close(moved.distances_, before.distances_, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(("N", "p"), [(40, 3), (40, 1), (250, 2)])
def test_a_problem_does_not_depend_on_the_others(N, p):
    problems = torch.stack([contaminated(seed, N, p) for seed in range(6)])
    together = MCD().fit(problems.unflatten(0, (2, 3)))
    for b, X in enumerate(problems):
        alone = MCD().fit(X)
        at = divmod(b, 3)
        for name in ("support_", "weights_", "location_", "covariance_", "correlation_", "raw_location_",
                     "raw_covariance_", "distances_", "objective_", "converged_"):  # fmt: skip
            torch.testing.assert_close(getattr(together, name)[at], getattr(alone, name), rtol=1e-10, atol=1e-12)


def test_the_estimate_does_not_depend_on_the_order_of_samples():
    X = SETS["hbk_y"]()
    order = torch.randperm(75, generator=torch.Generator().manual_seed(0))
    fit, shuffled = MCD().fit(X), MCD().fit(X[order])
    torch.testing.assert_close(shuffled.covariance_, fit.covariance_)
    assert torch.equal(shuffled.support_, fit.support_[order])


def test_single_precision_equals_double_precision():
    X = (contaminated(0) + 1e3).float()
    single, double = MCD().fit(X), MCD().fit(X.double())
    for name in ("location_", "covariance_", "distances_", "weights_", "objective_"):
        assert getattr(single, name).dtype == torch.float32
        torch.testing.assert_close(getattr(single, name), getattr(double, name).float())


@pytest.mark.parametrize("p", [1, 3])
@pytest.mark.parametrize("reweight", [True, False])
def test_derivatives_equal_those_of_the_moments_of_the_used_samples(p, reweight):
    X = contaminated(3, N=16, p=p).requires_grad_()

    def results(X):
        fit = MCD(reweight=reweight, starts=30).fit(X)
        return fit.location_, fit.covariance_, fit.raw_covariance_, fit.distances_, fit.mahalanobis(2.0 * X)

    assert torch.autograd.gradcheck(results, (X,))
    fit = MCD(reweight=reweight).fit(X)
    (slope,) = torch.autograd.grad(fit.location_[0], X)
    torch.testing.assert_close(slope[:, 0], fit.weights_ / fit.weights_.sum())


def test_a_huge_outlier_gives_no_nan_derivative():
    X = contaminated(3)
    X[0] = 1e75
    X.requires_grad_()
    fit = MCD().fit(X)
    for result in (fit.location_.sum(), fit.covariance_.sum(), fit.distances_.sum()):
        assert torch.isfinite(torch.autograd.grad(result, X, retain_graph=True)[0]).all()


def test_distances_equal_the_mahalanobis_formula():
    fit = MCD().fit(contaminated(0))
    new = 5.0 * sample(3, 2, 7, 3)
    error = new - fit.location_
    squared = torch.einsum("bni,ij,bnj->bn", error, torch.linalg.inv(fit.covariance_), error)
    torch.testing.assert_close(fit.mahalanobis(new), squared.sqrt())
    many = MCD().fit(torch.stack([contaminated(0), contaminated(1)]))
    torch.testing.assert_close(many.mahalanobis(new)[0], fit.mahalanobis(new[0]))
    assert fit.distance_cutoff_ == pytest.approx(
        3.0575, abs=1e-4
    )  # sqrt(9.3484), the 0.975 quantile of chi-square with 3 degrees of freedom


def test_support_fraction_and_h_are_equivalent():
    X = contaminated(0)  # N = 60, p = 3
    for fraction, h in ((0.5, 32), (0.75, 46), (1.0, 60)):
        first, other = MCD(fraction).fit(X), MCD(h=h).fit(X)
        assert first.h_ == h
        torch.testing.assert_close(first.covariance_, other.covariance_)
