"""Concentration steps by a Triton kernel equal those by torch; run on a GPU, or by Triton's interpreter on the CPU."""

from typing import Any

import pytest
import torch
from torch import Tensor

from mkc_torch.linear import (
    LeastTrimmedSquares,
    MKCRegression,
    SRegression,
    _alternation,
    _concentration,
    _maximum,
    _problem,
    _robust_start,
    _scale_search,
)
from mkc_torch.linear._problem import LinearProblem, linear_problem, solve_gram
from mkc_torch.linear._scale_search import ScaleSearch, elemental_starts
from mkc_torch.linear.least_trimmed_squares import QuantileScale, TrimmedScale
from mkc_torch.linear.s_regression import MScale
from tests.triton_interpreter import skip_without_interpreter

skip_without_interpreter()

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


@pytest.fixture(autouse=True)
def _skip_without_interpreter():
    if DEVICE == "cpu" and not _concentration._kernels()[0].is_interpreted:
        pytest.skip("the kernel was imported before TRITON_INTERPRET=1 was set")


def sample(n: int, N: int = 30, count: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(n)
    X = torch.randn(count, N, n, generator=generator, dtype=torch.float64)
    X[..., 0] = 1.0
    y = X.sum(-1) + torch.randn(count, N, generator=generator, dtype=torch.float64)
    y[:, : N // 5] += 20.0
    return X.to(DEVICE), y.to(DEVICE)


def weighted_problem(kind: str, n: int, dtype: torch.dtype = torch.float64) -> LinearProblem:
    X, y = (v.to(dtype) for v in sample(n))
    if kind == "shared X":
        X = X[0]
    number = torch.arange(y.shape[-1], device=DEVICE)
    weight = {"weights": 0.2 + number.to(dtype) % 3, "some left out": (number % 3 > 0).to(dtype)}.get(kind)
    return linear_problem(X, y, weight)


def torch_alternation(problem: LinearProblem, *args: Any, **options: Any) -> _maximum.LikelihoodMaximum:
    """The alternation by operations of torch."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_maximum, "runs_kernel", lambda _: False)
        return _maximum._alternate(problem, *args, **options)


KINDS = ("plain", "shared X", "weights", "some left out")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rule", [QuantileScale(0.6), TrimmedScale(0.6), MScale(0), MScale(2), MScale(30)], ids=str)
def test_scales_by_the_kernel_equal_those_of_torch(rule, kind):
    problem = weighted_problem(kind, n=3)
    beta = elemental_starts(problem, 1, 0)
    found = _concentration.concentrate(problem, beta, rule.options(problem))
    expected = rule.scale(problem, problem.residual(beta))
    torch.testing.assert_close(found.scale, expected, rtol=1e-12, atol=0.0)
    torch.testing.assert_close(found.beta, beta)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("n", [1, 4])
@pytest.mark.parametrize("rule", [TrimmedScale(0.6), MScale(2)], ids=str)
def test_concentration_steps_by_the_kernel_equal_those_of_torch(rule, n, kind):
    problem = weighted_problem(kind, n)
    beta = start = elemental_starts(problem, 1, 0)
    for _ in range(2):
        beta, _scale = _scale_search._step(problem, beta, rule, None)
    found = _concentration.concentrate(problem, start, rule.options(problem), max_iter=2, keeps=False)
    torch.testing.assert_close(found.beta, beta, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(found.scale, rule.scale(problem, problem.residual(beta)), rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_weighted_fits_by_the_kernel_equal_those_of_torch(kind, dtype):
    problem = weighted_problem(kind, 4, dtype)
    weight = torch.rand(2, 3, 30, 1, generator=torch.Generator().manual_seed(0), dtype=dtype).to(DEVICE)
    expected = solve_gram(*problem.normal_equations(weight))
    tolerance = 1e-10 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(_concentration.weighted_fits(problem, weight), expected, rtol=tolerance, atol=tolerance)


def test_a_descent_by_the_kernel_ends_at_the_coefficients_and_convergence_of_torch():
    problem = weighted_problem("plain", n=2)
    beta = elemental_starts(problem, 2, 0)
    rule = TrimmedScale(0.6)
    start = _scale_search._Candidates(beta, None, torch.zeros(beta.shape[:2], dtype=torch.bool, device=DEVICE))
    for steps in (1, 100):
        search = ScaleSearch(rule, rule, max_iter=steps)
        plain = _scale_search._descend(problem, start, search)
        found = _concentration.concentrate(
            problem, beta, rule.options(problem), max_iter=steps, tolerance=_scale_search._tolerance(beta, search)
        )
        torch.testing.assert_close(found.beta, plain.beta)
        assert bool(found.converged.all()) == (steps > 1)


def test_the_scale_does_not_depend_on_a_start_near_zero():
    problem = weighted_problem("plain", n=2)
    beta, rule = elemental_starts(problem, 1, 0), MScale(30)
    expected = rule.scale(problem, problem.residual(beta))
    near = torch.full_like(expected, 1e-100)
    found = _concentration.concentrate(problem, beta, rule.options(problem), near=near)
    torch.testing.assert_close(found.scale, expected, rtol=1e-12, atol=0.0)


def test_a_column_that_is_zero_on_the_kept_samples_gives_finite_coefficients():
    """The column is an indicator of trimmed samples."""
    X, y = (v[:1] for v in sample(2))
    X[..., 1] = 0.0
    X[:, :2, 1] = 1.0
    problem, rule = linear_problem(X, y), TrimmedScale(0.6)
    beta = elemental_starts(problem, 1, 0)
    found = _concentration.concentrate(problem, beta, rule.options(problem), max_iter=5)
    assert bool(torch.isfinite(found.beta).all())
    assert bool((found.scale <= rule.scale(problem, problem.residual(beta)) + 1e-12).all())


def test_an_exact_fit_has_scale_zero_and_converges():
    X, _ = sample(2)
    y = X.sum(-1)
    y[:, :10] += 5.0
    problem = linear_problem(X, y)
    beta = problem.in_basis(X.new_ones(2, 2)).unsqueeze(1)
    for rule in (TrimmedScale(0.6), MScale(30)):
        found = _concentration.concentrate(problem, beta, rule.options(problem), max_iter=5, tolerance=1e-12)
        assert float(found.scale.max()) < 1e-12
        torch.testing.assert_close(found.beta, beta)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    "make",
    [lambda: SRegression(starts=8), lambda: LeastTrimmedSquares(starts=8), MKCRegression],
    ids=["S", "LTS", "MKC"],
)
def test_a_fit_by_the_kernels_equals_the_fit_by_torch(make, dtype, monkeypatch):
    X, y = (v.to(dtype) for v in sample(2))
    plain = make().fit(X.cpu(), y.cpu())
    launches = []
    for module, name in ((_scale_search, "concentrate"), (_problem, "weighted_fits")):
        kernel = getattr(module, name)
        counted = lambda *a, kernel=kernel, name=name, **k: launches.append(name) or kernel(*a, **k)  # noqa: E731 - in a loop
        monkeypatch.setattr(module, name, counted)
        monkeypatch.setattr(module, "runs_kernel", _concentration.suits_kernel)
    fit = make().fit(X, y)
    assert launches.count("concentrate") >= 2
    assert "weighted_fits" in launches
    tolerance = 1e-8 if dtype == torch.float64 else 1e-4
    for name in ("coef_", "weights_", "covariance_"):
        torch.testing.assert_close(getattr(fit, name).cpu(), getattr(plain, name), rtol=tolerance, atol=tolerance)


def test_fits_that_require_derivatives_use_torch(monkeypatch):
    monkeypatch.setattr(_problem, "runs_kernel", _concentration.suits_kernel)
    X, y = sample(2)
    y.requires_grad_(True)
    problem = linear_problem(X, y)
    assert problem.weighted_fit(torch.ones_like(problem.Y)).requires_grad
    with torch.no_grad():
        assert not problem.weighted_fit(torch.ones_like(problem.Y)).requires_grad


def test_large_problems_and_several_channels_use_torch():
    X, y = sample(2)
    assert _concentration.suits_kernel(linear_problem(X, y))
    assert not _concentration.suits_kernel(linear_problem(X.unsqueeze(2).expand(-1, -1, 2, -1), y.unsqueeze(-1) + X))
    assert not _concentration.suits_kernel(linear_problem(X.repeat(1, 200, 1), y.repeat(1, 200)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("given", ["learned", "known width", "known scale"])
def test_the_alternation_by_the_kernel_equals_that_of_torch(kind, given):
    problem = weighted_problem(kind, n=3)
    begin = _robust_start.robust_start(problem)
    sigma, d = {"known width": (2.0, None), "known scale": (None, 1.2)}.get(given, (None, None))
    known = _maximum.FixedParameters(sigma, d, None, "lts")
    d_min, bound = _maximum.lower_limit_of_d(problem, begin), 60.0 * torch.ones_like(begin.scale)
    start = known.initial_state(problem, begin.beta, begin.scale, bound, d_min)
    for steps, ends in ((1, False), (100, True)):
        plain = torch_alternation(problem, begin.beta, start, max_iter=steps, tol=1e-10)
        found = _alternation.alternate_by_kernel(problem, begin.beta, start, max_iter=steps, tol=1e-10, patience=2)
        assert bool(found.ended.all()) == ends
        # rounding decides at which of equal values the steps end
        for value in [*found.history[len(plain.history) :], *plain.history[len(found.history) :]]:
            torch.testing.assert_close(value, plain.history[-1], rtol=1e-10, atol=1e-10)
        for value, expected in zip(found.history, plain.history, strict=False):
            torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found.history[-1], plain.history[-1], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(found.beta, plain.beta, rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(found.state.kappa, plain.state.kappa, rtol=1e-5, atol=1e-9)
        torch.testing.assert_close(found.state.log_d, plain.state.log_d, rtol=1e-6, atol=1e-6)
