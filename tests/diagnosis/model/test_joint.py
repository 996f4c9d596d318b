"""A simulation with effects at its ports."""

import pytest
import torch

from mkc_torch.diagnosis.model.joint import JointModel, directions, port_jacobian, through_port
from mkc_torch.diagnosis.model.term import Driver, Term
from mkc_torch.effects import CATALOGUE, GainEffect
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line, diagonal_prior, full_prior
from tests.simulation.tumbling import tumbling

EFFECTS = {effect.id: effect for effect in CATALOGUE}


class Mixed(GainEffect):
    id = "mixed_offset"
    port = "mixed"
    roles = ("any",)

    def waveform(self, shape, context):
        return context.drivers[:, 0] + shape.get("more", 0.0)


class Cubic(GainEffect):
    id = "cubic"
    port = "mixed"

    def change(self, gamma, shape, context):
        return gamma * context.signal.pow(3)


class Summed(GainEffect):
    id = "leak"
    port = "summed"

    def waveform(self, shape, context):
        return context.time


@pytest.fixture
def line():
    return Line()


@pytest.fixture
def driver(line):
    return Driver(("load",), "any", torch.sin(3.0 * line.time).unsqueeze(-1), torch.tensor([7.0]).double(), ("kg",))


@pytest.fixture
def model(line, driver):
    return JointModel(line, (Term(Mixed(), driver, {}), Term(Cubic(), None, {}), Term(Summed(), None, {})))


PARAMETERS = torch.tensor([0.9, 0.6, 0.1, -0.2, 0.3, 0.01, 0.02, -0.03, 0.5], dtype=torch.float64)


def test_terms_have_columns_and_keys(driver):
    term = Term(Mixed(), driver, {"more": 1.0})
    assert term.columns == ("load",)
    assert term.key == ("mixed_offset", ("load",), "mixed") == Term(Mixed(), driver, {"more": 2.0}).key
    assert Term(Cubic(), None, {}).columns == ()


def test_an_effect_has_time_drivers_signal_and_units_of_its_port(line, driver):
    signal = line.signals(line.start(), {})["mixed"]
    context = Term(Mixed(), driver, {}).context(line, signal)
    assert torch.equal(context.time, line.time)
    assert torch.equal(context.drivers, driver.values)
    assert torch.equal(context.signal, signal)
    assert (context.units, context.signal_unit, context.channels) == (("kg",), "mV", ("a", "b", "c"))
    alone = Term(Summed(), None, {}).context(line, None)
    assert alone.drivers.shape == (100, 0)
    assert alone.signal.shape == (100, 1)
    assert (alone.units, alone.signal_unit) == ((), "l/s")


def test_simulation_parameters_precede_effect_parameters(model):
    assert (model.base, model.sizes, model.size) == (2, (3, 3, 1), 9)
    assert [g.tolist() for g in model.gammas(PARAMETERS)] == [[0.1, -0.2, 0.3], [0.01, 0.02, -0.03], [0.5]]
    assert JointModel(model.prepared).gammas(PARAMETERS[:2]) == ()


def test_changes_at_one_port_add_up(model, line, driver):
    changes = model.changes(PARAMETERS)
    level = 0.9 + 0.6 * line.time
    signal = torch.stack([level, 2.0 * level, level.square()], -1)
    first = driver.values * torch.tensor([0.1, -0.2, 0.3]).double()
    second = signal.pow(3) * torch.tensor([0.01, 0.02, -0.03]).double()
    torch.testing.assert_close(changes["mixed"](signal), first + second)
    torch.testing.assert_close(changes["summed"](line.time.new_zeros(100, 1)), 0.5 * line.time.unsqueeze(-1))
    assert JointModel(line).changes(PARAMETERS[:2]) == {}


def test_the_residual_includes_the_changes_of_effects(model, line):
    expected = line.residual(PARAMETERS[:2], model.changes(PARAMETERS))
    assert torch.equal(model.residual(PARAMETERS), expected)
    still = torch.cat([PARAMETERS[:2], torch.zeros(7).double()])
    torch.testing.assert_close(model.residual(still), line.residual(PARAMETERS[:2], {}))


@pytest.mark.parametrize(
    "prior",
    [
        diagonal_prior(),
        full_prior(),
    ],
)
def test_effect_parameters_have_a_flat_prior(driver, prior):
    line = Line(prior=prior)
    assert JointModel(line).prior is prior
    known = JointModel(line, (Term(Mixed(), driver, {}),)).prior
    mean, precision = known.mean, known.precision
    if precision.dim() == 1:
        precision = torch.diag(precision)
    original = torch.diag(prior.precision) if prior.precision.dim() == 1 else prior.precision
    assert torch.equal(mean, torch.tensor([1.0, 0.5, 0.0, 0.0, 0.0]).double())
    assert torch.equal(precision[:2, :2], original)
    assert not bool(precision[2:].any() or precision[:, 2:].any())


def test_with_term_and_with_shape_return_new_models(line, driver):
    model = JointModel(line).with_term(Term(Mixed(), driver, {})).with_term(Term(Mixed(), driver, {"more": 1.0}))
    assert [t.shape for t in model.terms] == [{}, {"more": 1.0}]
    assert [t.shape for t in model.with_shape({"more": 2.0}).terms] == [{}, {"more": 2.0}]
    assert [t.shape for t in model.terms] == [{}, {"more": 1.0}]
    assert model.size == 8


def test_directions_are_derivatives_of_the_change(line, driver):
    context = Term(Mixed(), driver, {}).context(line, None)
    found = directions(Term(Mixed(), driver, {}), context)
    assert found.shape == (100, 3, 3)
    torch.testing.assert_close(found, driver.values.unsqueeze(-1) * torch.eye(3).double())


def tangents_by_differences(model, parameters, port, courses, step=1e-5):
    """Residual tangents of changes at a port, by central differences around what the effects add there."""
    columns = []
    for k in range(courses.shape[-1]):
        ends = [model.residual_with_change(parameters, port, sign * step * courses[..., k]) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return torch.stack(columns, -1)


def test_the_pointwise_jacobian_of_a_line_is_minus_its_mixing(model, line):
    torch.testing.assert_close(port_jacobian(model, PARAMETERS, "mixed"), -line.mixing)


@pytest.mark.parametrize("terms", [0, 3])
def test_tangents_through_ports_agree_with_finite_differences(model, line, terms):
    some = JointModel(line, model.terms[:terms])
    parameters = PARAMETERS[: some.size]
    generator = torch.Generator().manual_seed(2)
    mixed = torch.randn(100, 3, 4, generator=generator, dtype=torch.float64)
    pointwise = port_jacobian(some, parameters, "mixed")
    expected = tangents_by_differences(some, parameters, "mixed", mixed)
    torch.testing.assert_close(
        through_port(some, parameters, "mixed", mixed, pointwise), expected, rtol=1e-6, atol=1e-8
    )
    torch.testing.assert_close(through_port(some, parameters, "mixed", mixed, None), expected, rtol=1e-6, atol=1e-8)
    summed = torch.randn(100, 1, 3, generator=generator, dtype=torch.float64)
    expected = tangents_by_differences(some, parameters, "summed", summed)
    torch.testing.assert_close(through_port(some, parameters, "summed", summed, None), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("use", ["norm", "attitude", "gyro"])
def test_tangents_through_the_ports_of_a_magnetometer_agree_with_finite_differences(use):
    prepared = Magnetometer(use=use).prepare(tumbling(500, noise=0.3, gyro=True, attitude=True))
    model = JointModel(prepared, (Term(EFFECTS["cubic_nonlinearity"], None, {}),))
    parameters = torch.cat([prepared.start(), torch.tensor([1e-6, -2e-6, 1e-6]).double()])
    slow = torch.cos(torch.linspace(0.0, 3.0, 500).double().unsqueeze(-1) * torch.arange(1, 4))
    for port, known in prepared.ports.items():
        weight = torch.linspace(-1.0, 2.0, len(known.channels), dtype=torch.float64)
        courses = weight.unsqueeze(-1) * slow.unsqueeze(1)
        pointwise = port_jacobian(model, parameters, port) if known.pointwise else None
        found = through_port(model, parameters, port, courses, pointwise)
        expected = tangents_by_differences(model, parameters, port, courses)
        # a gyroscope's windows hold the weights of their mean fixed, which differences do not
        assert float((found - expected).abs().max()) < (0.1 if use == "gyro" else 1e-6) * float(expected.abs().max())
        torch.testing.assert_close(through_port(model, parameters, port, courses, None), found, rtol=1e-6, atol=1e-8)
