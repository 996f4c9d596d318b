"""Curves without a name as formulas: those of known functions are found, in the units of the data."""

import pytest
import torch

from mkc_torch.diagnosis.environment import Curve
from mkc_torch.diagnosis.findings.shape import formulas


def curve(make, low=-2.0, high=2.0, *, band=0.01, noise=0.0, driver="speed", unit="m/s²"):
    x = torch.linspace(low, high, 80, dtype=torch.float64)
    value = make(x)
    generator = torch.Generator().manual_seed(0)
    value = value + noise * torch.randn(value.shape, generator=generator, dtype=torch.float64)
    value = value.unsqueeze(-1)
    return Curve(driver, "m/s", x, value, torch.full_like(value, band), ("rate of speed",), unit)


@pytest.mark.parametrize(
    ("make", "range_", "text"),
    [
        (lambda x: -0.5 * x, (-2.0, 2.0), "−0.5 speed m/s² (RMS error 0 %)"),
        (lambda x: 3.0 - 0.25 * x**3, (-2.0, 2.0), "3 − 0.25 speed³ m/s² (RMS error 0 %)"),
        (lambda x: -1.2 * torch.sign(x), (-2.0, 2.0), "−1.2 sign(speed) m/s² (RMS error 0 %)"),
        (lambda x: -0.4 * x + 0.03 * x * x.abs(), (-5.0, 5.0), "−0.4 speed + 0.03 speed |speed| m/s² (RMS error 0 %)"),
        (lambda x: 2.0 * x.sqrt(), (0.0, 9.0), "2 √speed m/s² (RMS error 0 %)"),
        (lambda x: 0.05 / x**2, (0.2, 1.5), "0.05 / speed² m/s² (RMS error 0 %)"),
        (lambda x: 2.0 * x, (-9.0, -1.0), "2 speed m/s² (RMS error 0 %)"),
    ],
)
def test_formulas_of_known_functions_are_found(make, range_, text):
    assert formulas(curve(make, *range_)) == (f"δ(rate of speed) = {text}",)


def test_a_formula_has_no_more_terms_than_the_band_requires():
    slightly_bent = curve(lambda x: x + 0.02 * x**3, band=0.2)
    (text,) = formulas(slightly_bent)
    assert "speed³" not in text
    (closer,) = formulas(curve(lambda x: x + 0.02 * x**3, band=1e-4))
    assert "0.02 speed³" in closer


def test_a_curve_without_a_formula_has_a_large_rms_error():
    (text,) = formulas(curve(lambda x: torch.sin(6.0 * x), band=1e-3))
    off = int(text.rpartition("(RMS error ")[2].split(" %")[0])
    assert off > 20


def test_each_channel_has_its_own_formula():
    x = torch.linspace(0.0, 40.0, 50, dtype=torch.float64)
    value = torch.stack([0.1 * x, -0.2 * x + 1.0], -1)
    found = formulas(Curve("temp", "°C", x, value, torch.full_like(value, 0.01), ("mag_x", "mag_y"), "µT"))
    assert found == ("δ(mag_x) = 0.1 temp µT (RMS error 0 %)", "δ(mag_y) = 1 − 0.2 temp µT (RMS error 0 %)")


def test_a_zero_curve_has_a_formula():
    assert formulas(curve(torch.zeros_like))[0].startswith("δ(rate of speed) = ")
