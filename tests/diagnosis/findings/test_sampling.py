"""Points of a curve are closer together where it bends."""

import pytest
import torch

from mkc_torch.diagnosis.findings.shape import bending_points


def drawn_error(value, chosen):
    """Largest distance between a curve and straight lines between its points, over the curve's range."""
    fine = torch.arange(len(value), dtype=value.dtype)
    left = torch.searchsorted(chosen, fine.long(), right=True).clamp(1, len(chosen) - 1) - 1
    a, b = chosen[left], chosen[left + 1]
    between = torch.lerp(value[a], value[b], (fine - a) / (b - a))
    return float((between - value).abs().max() / (value.max() - value.min()))


def stribeck(speed):
    return (speed / 0.02).tanh() * (1.0 + 0.6 * torch.exp(-((speed / 0.1) ** 2)))


def test_stribeck_friction_is_drawn_to_a_hundredth_of_its_range():
    value = stribeck(torch.linspace(-5.0, 5.0, 800, dtype=torch.float64))
    chosen = bending_points(value.unsqueeze(-1), 80)
    assert len(chosen) <= 82
    assert drawn_error(value, chosen) < 0.01
    assert drawn_error(value, torch.linspace(0, 799, 80).long()) > 0.1  # evenly spaced points miss the peak


@pytest.mark.parametrize(
    "value", [torch.zeros(800, 2), torch.linspace(0.0, 1.0, 800, dtype=torch.float64).unsqueeze(-1)]
)
def test_a_line_has_evenly_spaced_points(value):
    chosen = bending_points(value.double(), 80)
    assert int(chosen[0]) == 0
    assert int(chosen[-1]) == 799
    assert int(chosen.diff().max()) <= 12


def test_a_short_curve_keeps_all_points():
    assert bending_points(torch.rand(5, 1, generator=torch.Generator().manual_seed(0)), 80).tolist() == [0, 1, 2, 3, 4]


def test_values_that_are_not_finite_are_allowed():
    value = torch.linspace(0.0, 1.0, 200).unsqueeze(-1)
    value[50] = torch.nan
    assert bending_points(value, 20)[-1] == 199
