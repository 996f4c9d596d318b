"""The ψ functions: the published formulas, and tuning constants by quadrature and from published tables."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm

from mkc_torch.linear._psi import (
    BISQUARE_50,
    TUNING_95,
    Psi,
    bisquare_for_breakdown,
    bisquare_for_efficiency,
    checked_tuning,
    gaussian_efficiency,
)


def huber(t: float, k: float) -> float:
    return min(k, max(t, -k))


def hampel(t: float, a: float, b: float, c: float) -> float:
    size = abs(t)
    if size <= a:
        return t
    if size <= b:
        return a * math.copysign(1.0, t)
    return a * (c - size) / (c - b) * math.copysign(1.0, t) if size <= c else 0.0


def tukey(t: float, k: float) -> float:
    return t * (1 - (t / k) ** 2) ** 2 if abs(t) <= k else 0.0


def andrews(t: float, a: float) -> float:
    return a * math.sin(t / a) if abs(t) <= math.pi * a else 0.0


def welsch(t: float, c: float) -> float:
    return t * math.exp(-((t / c) ** 2))


PSI = {"huber": huber, "hampel": hampel, "tukey": tukey, "andrews": andrews, "welsch": welsch}
KINKS = {"huber": 1, "hampel": 3, "tukey": 1, "andrews": 1, "welsch": 0}


@pytest.mark.parametrize("name", PSI)
def test_weights_times_residuals_equal_the_published_formulas(name):
    tuning = TUNING_95[name]
    z = torch.cat([torch.linspace(-12, 12, 241), torch.tensor([*tuning, 1e-9, 1e9])]).double()
    weight = Psi(name, tuning).weight(z)
    expected = torch.tensor([PSI[name](float(t), *tuning) for t in z], dtype=torch.float64)
    torch.testing.assert_close(weight * z, expected, rtol=1e-12, atol=1e-12)
    assert float(Psi(name, tuning).weight(torch.zeros(1))) == 1.0
    outwards = Psi(name, tuning).weight(torch.linspace(0, 20, 500))
    assert bool((outwards.diff() <= 0).all())
    assert bool(((outwards >= 0) & (outwards <= 1)).all())


@pytest.mark.parametrize("name", PSI)
def test_default_tuning_has_ninety_five_per_cent_efficiency(name):
    tuning = TUNING_95[name]
    at = sorted(tuning if name != "andrews" else (math.pi * tuning[0],))
    points = at[: KINKS[name]] or None

    def mean(f):
        return 2 * quad(lambda t: f(t) * norm.pdf(t), 0, 15, points=points, epsabs=1e-12, limit=200)[0]

    # E ψ' by differences, not by the identity that the code uses
    slope = mean(lambda t: (PSI[name](t + 1e-5, *tuning) - PSI[name](t - 1e-5, *tuning)) / 2e-5)
    expected = slope**2 / mean(lambda t: PSI[name](t, *tuning) ** 2)
    assert gaussian_efficiency(name, tuning) == pytest.approx(expected, abs=1e-5)
    assert gaussian_efficiency(name, tuning) == pytest.approx(0.95, abs=5e-5)


def test_bisquare_constants_equal_the_published_constants():
    # robustbase for the first two; Rousseeuw & Yohai (1984), table of breakdown points, constants and efficiencies
    assert bisquare_for_breakdown(0.5) == pytest.approx(1.547645, abs=1e-6)
    assert bisquare_for_efficiency(0.95) == pytest.approx(4.685061, abs=1e-5)
    assert bisquare_for_breakdown(0.5) == pytest.approx(BISQUARE_50, abs=1e-12)
    for breakdown, c, efficiency in [
        (0.5, 1.547, 0.287),
        (0.35, 2.251, 0.560),
        (0.25, 2.937, 0.759),
        (0.1, 5.182, 0.966),
    ]:
        assert bisquare_for_breakdown(breakdown) == pytest.approx(c, abs=1.5e-3)
        assert gaussian_efficiency("tukey", (bisquare_for_breakdown(breakdown),)) == pytest.approx(efficiency, abs=1e-3)


def test_bisquare_breakdown_is_the_mean_of_rho():
    c = bisquare_for_breakdown(0.3)
    u = np.linspace(0, 12, 200_001) / c
    rho = np.where(u < 1, 1 - (1 - np.minimum(u, 1) ** 2) ** 3, 1.0)
    assert 2 * np.trapezoid(rho * norm.pdf(u * c), u * c) == pytest.approx(0.3, abs=1e-7)


@pytest.mark.parametrize(
    ("name", "tuning", "expected"),
    [
        ("huber", 0.0, "one positive number"),
        ("tukey", (1.0, 2.0), "one positive number"),
        ("welsch", float("nan"), "one positive number"),
        ("andrews", "wide", "one positive number"),
        ("hampel", 2.0, "three numbers 0 < a <= b < c"),
        ("hampel", (2.0, 1.0, 4.0), "three numbers 0 < a <= b < c"),
        ("hampel", (1.0, 2.0, 2.0), "three numbers 0 < a <= b < c"),
    ],
)
def test_bad_tuning_is_refused(name, tuning, expected):
    with pytest.raises(ValueError, match=f"`tuning` of '{name}' to be {expected} but got"):
        checked_tuning(name, tuning)


def test_an_unknown_psi_is_refused():
    with pytest.raises(ValueError, match=r"`psi` to be one of 'huber', .*'welsch' but got 'cauchy'"):
        checked_tuning("cauchy", None)


@pytest.mark.parametrize("name", PSI)
def test_the_slope_equals_the_derivative_of_the_value(name):
    psi = Psi(name, TUNING_95[name])
    z = torch.linspace(-9.97, 9.97, 400, dtype=torch.float64)  # no kink within a difference
    differences = (psi.value(z + 1e-6) - psi.value(z - 1e-6)) / 2e-6
    torch.testing.assert_close(psi.slope(z), differences, rtol=0, atol=1e-7)
