"""Coverage of directions: fractions, gaps and information of sets whose coverage is known."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mkc_torch.calibration.coverage import GAP_DEGREES, NEAR_DEGREES, Gap, coverage, fibonacci_sphere, nearest_axis
from tests.draws import normal as sample


def cap_share(degrees: float) -> float:
    """Share of the sphere within an angle of a direction."""
    return 0.5 * (1.0 - math.cos(math.radians(degrees)))


def directions_within(degrees: float, count: int = 4000) -> Tensor:
    """Directions within an angle of +z."""
    sphere = fibonacci_sphere(count)
    return sphere[sphere[:, 2] > math.cos(math.radians(degrees))]


def test_the_spiral_covers_the_sphere_evenly():
    points = fibonacci_sphere(5000)
    torch.testing.assert_close(torch.linalg.vector_norm(points, dim=-1), torch.ones(5000).double())
    assert float(points.mean(0).abs().max()) < 1e-3
    torch.testing.assert_close(points.mT @ points / 5000, torch.eye(3).double() / 3, rtol=0, atol=1e-3)
    distance = torch.cdist(points[:1000], points).fill_diagonal_(9.0).amin(-1)
    assert float(distance.amin()) > 0.5 * float(distance.median())


def test_a_full_sphere_is_covered():
    found = coverage(fibonacci_sphere(1000))
    assert found.fraction == 1.0
    assert found.gaps == ()
    assert found.information == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("degrees", [30.0, 60.0, 90.0, 120.0])
def test_the_fraction_of_a_cap_includes_the_band_around_it(degrees):
    found = coverage(directions_within(degrees, 20_000))
    assert found.fraction == pytest.approx(cap_share(degrees + NEAR_DEGREES), abs=0.01)


@pytest.mark.parametrize("degrees", [30.0, 60.0, 90.0, 120.0])
def test_the_gap_of_a_cap_is_opposite_and_as_wide_as_the_rest(degrees):
    gap = coverage(directions_within(degrees, 20_000)).gaps[0]
    assert gap.direction[2] < -0.99
    assert gap.degrees == pytest.approx(180.0 - degrees, abs=3.0)
    assert nearest_axis(gap.direction) == "-z"


def test_a_single_direction_covers_its_cap():
    found = coverage(torch.tensor([[0.0, 0.0, 7.0]], dtype=torch.float64))
    assert found.fraction == pytest.approx(cap_share(NEAR_DEGREES), abs=0.003)
    assert found.gaps[0].degrees > 175.0
    assert found.information == pytest.approx(0.0, abs=1e-12)


def test_an_equator_leaves_gaps_at_both_poles():
    angle = torch.linspace(0.0, 2 * math.pi, 400, dtype=torch.float64)
    found = coverage(torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], -1))
    assert found.fraction == pytest.approx(math.sin(math.radians(NEAR_DEGREES)), abs=0.01)
    assert {nearest_axis(g.direction) for g in found.gaps[:2]} == {"+z", "-z"}
    assert all(g.degrees == pytest.approx(90.0, abs=3.0) for g in found.gaps[:2])
    assert found.information == pytest.approx(0.0, abs=1e-9)


def test_two_gaps_are_reported_largest_first():
    sphere = fibonacci_sphere(4000)
    keep = (sphere[:, 0] < math.cos(math.radians(60))) & (sphere[:, 1] > -math.cos(math.radians(45)))
    gaps = coverage(sphere[keep]).gaps
    assert [nearest_axis(g.direction) for g in gaps] == ["+x", "-y"]
    assert gaps[0].degrees == pytest.approx(60.0, abs=3.0)
    assert gaps[1].degrees == pytest.approx(45.0, abs=3.0)


def test_a_gap_below_the_limit_is_not_reported():
    sphere = fibonacci_sphere(4000)
    assert coverage(sphere[sphere[:, 2] < math.cos(math.radians(GAP_DEGREES - 5))]).gaps == ()
    assert len(coverage(sphere[sphere[:, 2] < math.cos(math.radians(GAP_DEGREES + 5))]).gaps) == 1


def test_thirty_even_samples_leave_no_gap():
    assert coverage(fibonacci_sphere(30)).gaps == ()


def test_information_decreases_with_the_size_of_the_cap():
    values = [coverage(directions_within(d)).information for d in (180.0, 120.0, 90.0, 60.0, 30.0)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 0.9
    assert values[-1] < 1e-3


def test_information_is_the_least_eigenvalue_relative_to_even_coverage():
    directions = torch.nn.functional.normalize(sample(0, 300, 3) + torch.tensor([0.0, 0.0, 1.5]), dim=-1)

    def functions(u: Tensor) -> Tensor:
        x, y, z = u.unbind(-1)
        r = math.sqrt(2)
        return torch.stack([x, y, z, x * x, y * y, z * z, r * x * y, r * x * z, r * y * z], -1)

    # moments of the even sphere: E[u_i²] = 1/3, E[u_i⁴] = 1/5, E[u_i² u_j²] = 1/15
    even = torch.zeros(9, 9, dtype=torch.float64)
    even[:3, :3] = torch.eye(3) / 3
    even[3:6, 3:6] = torch.eye(3) * (1 / 5 - 1 / 15) + 1 / 15
    even[6:, 6:] = 2 * torch.eye(3) / 15
    rows = functions(directions)
    expected = torch.linalg.eigvals(torch.linalg.solve(even, rows.mT @ rows / 300)).real.min()
    assert coverage(directions).information == pytest.approx(float(expected), rel=2e-3)


@settings(derandomize=True, deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_coverage_does_not_depend_on_rotation_and_lengths(seed):
    directions = sample(seed, 40, 3) + torch.tensor([0.0, 0.0, 1.0])
    Q, _ = torch.linalg.qr(sample(seed + 1, 3, 3))
    first = coverage(directions)
    lengths = sample(seed + 2, 40, 1).exp()
    other = coverage((directions * lengths) @ Q.mT)
    assert other.information == pytest.approx(first.information, rel=1e-2, abs=1e-6)
    assert other.fraction == pytest.approx(first.fraction, abs=0.03)
    assert 0.0 <= first.fraction <= 1.0
    assert all(g.degrees > GAP_DEGREES for g in first.gaps)
    assert [g.degrees for g in first.gaps] == sorted((g.degrees for g in first.gaps), reverse=True)
    unit = torch.nn.functional.normalize(directions, dim=-1)
    for gap in first.gaps:
        nearest = (unit @ torch.tensor(gap.direction, dtype=torch.float64)).max().clamp(-1, 1)
        assert math.degrees(math.acos(float(nearest))) == pytest.approx(gap.degrees, abs=1e-6)


@pytest.mark.parametrize(
    ("direction", "name"),
    [
        ((0.0, 0.0, 1.0), "+z"),
        ((-1.0, 0.1, 0.0), "-x"),
        ((0.7, -0.7, 0.0), "+x-y"),
        ((-0.58, 0.58, -0.58), "-x+y-z"),
        ((0.0, 1.0, 0.5), "+y"),
    ],
)
def test_directions_are_named_after_their_axes(direction, name):
    assert nearest_axis(direction) == name


def test_a_gap_is_described_by_a_sentence():
    assert str(Gap((0.0, -0.6, 0.8), 57.4)) == "-y+z (+0.00, -0.60, +0.80): no sample within 57°"


def test_many_float32_vectors_are_accepted():
    assert coverage(sample(0, 10_000, 3).float()).fraction == 1.0


@pytest.mark.parametrize("length", [1e-300, 1e-13, 1e300])
def test_coverage_does_not_depend_on_the_length_of_directions(length):
    assert coverage(length * fibonacci_sphere(500)).fraction == coverage(fibonacci_sphere(500)).fraction


def test_no_directions_are_refused():
    with pytest.raises(ValueError, match="at least one direction"):
        coverage(torch.zeros(0, 3))
