"""Reported texts of effects: equations of their forms, labels of components, and moments."""

from dataclasses import replace

import pytest
import torch

from mkc_torch.effects import Context
from mkc_torch.effects.sensor.cubic_nonlinearity import CubicNonlinearity
from mkc_torch.effects.sensor.field_gradient import FieldGradient
from mkc_torch.effects.sensor.heading_reset import HeadingReset
from mkc_torch.effects.sensor.offset_drift import OffsetDrift
from mkc_torch.effects.sensor.temperature_offset import TemperatureOffset
from tests.effects.contexts import make_context

GRADIENT = FieldGradient()
VECTOR, STRENGTH = ("east", "north", "up"), ("strength",)


def test_equations_of_forms_differ():
    context = make_context(OffsetDrift())
    found = [OffsetDrift().equation_of(s, context).partition("s(t) = ")[2].partition(",  t from")[0] for s in (
        {}, {"power": 0.5}, {"time_constant": 9.0},
    )]  # fmt: skip
    assert found == ["t / T", "√(t / T)", "(1 − exp(−t/τ)) / (1 − exp(−T/τ))"]
    length = float(context.time[-1] - context.time[0])
    assert f"T = {length:.4g} s" in OffsetDrift().equation_of({}, context)
    cubic = make_context(CubicNonlinearity())
    assert "β" not in CubicNonlinearity().equation_of({}, cubic)
    assert "+ β_i B_i²" in CubicNonlinearity().equation_of({"terms": 2.0}, cubic)
    warm = make_context(TemperatureOffset())
    assert TemperatureOffset().equation_of({}, warm) == "δB = k (T − T̄)"
    assert "T_τ" in TemperatureOffset().equation_of({"lag": 5.0}, warm)
    assert TemperatureOffset().unit_of_shape("curvature", warm) == "1/K"
    assert TemperatureOffset().unit_of_shape("lag", warm) == "s"


def first_and_second_derivatives(gamma, degree, context):
    """First and second derivatives of the change by the position, at its mean."""
    sample = replace(context, time=context.time[:1], signal=context.signal[:1])

    def field(point):
        return GRADIENT.change(gamma, {"degree": degree}, replace(sample, drivers=point.unsqueeze(0))).squeeze(0)

    here = torch.zeros(3, dtype=torch.float64)
    first = torch.func.jacfwd(field)
    return first(here), torch.func.jacfwd(first)(here)


def evaluated(label, first, second):
    """Return the value of a component's label, a formula in derivatives of the field."""
    axes = {axis: k for k, axis in enumerate("xyz")}

    def derivative(of, by):
        row = axes[of[2:]] if of.startswith("B_") else 0
        order = [axes[axis] for axis in by]
        return float(first[row, order[0]] if len(order) == 1 else second[row, order[0], order[1]])

    values = []
    for side in label.split(" = "):
        code = side.replace("−", "-").replace("½ ", "0.5 * ").replace("3 ", "3 * ")
        for of in ("B_x", "B_y", "B_z") if len(first) == 3 else ("B",):
            for by in ("x", "y", "z"):
                code = code.replace(f"∂²{of}/∂{by}²", repr(derivative(of, by * 2)))
                for other in ("x", "y", "z"):
                    code = code.replace(f"∂²{of}/∂{by}∂{other}", repr(derivative(of, by + other)))
                code = code.replace(f"∂{of}/∂{by}", repr(derivative(of, by)))
        assert "∂" not in code
        values.append(eval(code))
    return values


@pytest.mark.parametrize("channels", [VECTOR, STRENGTH], ids=len)
@pytest.mark.parametrize("degree", [1.0, 2.0])
def test_components_of_a_gradient_equal_their_labels(channels, degree):
    shape, context = {"degree": degree}, make_context(GRADIENT, channels=channels)
    quantities = GRADIENT.quantities(shape, context)
    generator = torch.Generator().manual_seed(5)
    gamma = torch.randn(sum(q.size for q in quantities), generator=generator, dtype=torch.float64)
    first, second = first_and_second_derivatives(gamma, degree, context)
    labels = [label for q in quantities for label in GRADIENT.components(q.name, shape, context)]
    assert len(labels) == len(gamma)
    for label, value in zip(labels, gamma.tolist(), strict=True):
        assert evaluated(label, first, second) == pytest.approx([value] * len(label.split(" = ")), abs=1e-12)


def test_heading_reset_lists_its_moments():
    time = torch.arange(6.0, dtype=torch.float64)
    since = torch.stack([time >= 2.0, time >= 5.0], -1).double()
    none = torch.zeros(6, 0, dtype=torch.float64)
    context = Context(time, none, (), since, "°", ("heading",), ("since_1", "since_2"))
    effect = HeadingReset()
    assert effect.moments(context) == (1.0, 4.0)
    assert effect.components("heading_change", {}, context) == ("jump at 1.0 s", "jump at 4.0 s")
