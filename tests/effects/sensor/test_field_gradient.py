"""The field of a room without sources."""

from dataclasses import replace

import pytest
import torch

from mkc_torch.effects import CATALOGUE
from tests.effects.contexts import make_context, size_of

GRADIENT = next(effect for effect in CATALOGUE if effect.id == "field_gradient")
ENU = ("east", "north", "up")


ONE_POINT = make_context(GRADIENT, N=1, channels=ENU)


def field(degree, point):
    """Return the basis at a point, (terms, 3)."""
    shape, context = {"degree": degree}, replace(ONE_POINT, drivers=point.unsqueeze(0))
    return torch.stack(
        [GRADIENT.change(row, shape, context)[0] for row in torch.eye(size_of(GRADIENT, shape, context)).double()]
    )


@pytest.mark.parametrize(("degree", "terms"), [(1.0, 5), (2.0, 12)])
def test_the_basis_has_neither_sources_nor_curl(degree, terms):
    generator = torch.Generator().manual_seed(0)
    for point in torch.randn(4, 3, generator=generator, dtype=torch.float64):
        slope = torch.func.jacfwd(lambda p: field(degree, p))(point)
        assert slope.shape == (terms, 3, 3)
        torch.testing.assert_close(slope.diagonal(dim1=-2, dim2=-1).sum(-1), torch.zeros(terms).double())
        torch.testing.assert_close(slope, slope.mT)


@pytest.mark.parametrize(("degree", "terms"), [(1.0, 5), (2.0, 12)])
def test_the_basis_is_complete(degree, terms):
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    table = torch.stack([field(degree, point).flatten() for point in points]).unflatten(1, (terms, 3))
    assert int(torch.linalg.matrix_rank(table.movedim(1, -1).reshape(-1, terms))) == terms


def test_the_basis_of_degree_two_starts_with_that_of_degree_one():
    point = torch.tensor([0.3, -0.7, 1.1], dtype=torch.float64)
    torch.testing.assert_close(field(2.0, point)[:5], field(1.0, point))
    torch.testing.assert_close(field(1.0, 2.0 * point), 2.0 * field(1.0, point))
    torch.testing.assert_close(field(2.0, 2.0 * point)[5:], 4.0 * field(2.0, point)[5:])


def test_the_basis_of_the_field_strength_has_all_polynomials():
    context = make_context(GRADIENT, channels=("strength",))
    p = context.drivers
    x, y, z = p.unbind(-1)
    linear = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    torch.testing.assert_close(GRADIENT.change(linear, {"degree": 1.0}, context).squeeze(-1), p @ linear)
    gamma = torch.arange(1.0, 10.0, dtype=torch.float64)
    expected = x + 2 * y + 3 * z + 4 * x * x + 5 * y * y + 6 * z * z + 7 * x * y + 8 * x * z + 9 * y * z
    torch.testing.assert_close(GRADIENT.change(gamma, {"degree": 2.0}, context).squeeze(-1), expected)


@pytest.mark.parametrize(("channels", "sizes"), [(ENU, (5, 7)), (("strength",), (3, 6))])
def test_quantities_follow_the_port(channels, sizes):
    context = make_context(GRADIENT, channels=channels)
    gradient, curvature = ("gradient", sizes[0], "µT/m"), ("curvature", sizes[1], "µT/m²")
    assert [tuple(q) for q in GRADIENT.quantities({"degree": 1.0}, context)] == [gradient]
    assert [tuple(q) for q in GRADIENT.quantities({"degree": 2.0}, context)] == [gradient, curvature]


def test_quantities_of_positions_without_a_unit_have_the_unit_of_the_field():
    context = replace(make_context(GRADIENT, channels=("strength",)), units=("", "", ""))
    assert [q.unit for q in GRADIENT.quantities({"degree": 2.0}, context)] == ["µT", "µT"]


def test_both_degrees_are_searched():
    assert [dict(s) for s in GRADIENT.shapes(torch.arange(9.0))] == [{"degree": 1.0}, {"degree": 2.0}]
