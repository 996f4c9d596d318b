"""An FMU as a torch function: its values and derivatives equal those of its equations by SymPy."""

import numpy as np
import pytest
import sympy
import torch

pytest.importorskip("fmpy")


from mkc_torch._support.forward_mode import _trusted, twice_reverse_tangents
from mkc_torch.simulation import load_fmu
from mkc_torch.simulation.foreign.evaluation import EvaluationPoints
from mkc_torch.simulation.foreign.function import evaluated
from tests.simulation.fmu.made import COMPILER, PENDULUM, Model, make_fmu

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no compiler of C (cc, gcc or clang)")

MOTOR = Model(
    "Motor",
    {
        "angle": "speed",
        "speed": "torque*current - damping*speed",
        "current": "drive*voltage - resistance*current - emf*speed",
    },
    {"torque": (12.0, None, None, ""), "damping": (0.6, 0.0, None, "1/s"), "drive": (7.0, None, None, ""),
     "resistance": (12.0, 0.0, 100.0, ""), "emf": (0.6, None, None, "")},
    ("voltage",),
    {"power": "voltage*current"},
    variability="fixed",
)  # fmt: skip
TANKS = Model(
    "Tanks",
    {"upper": "gain*pump - outlet*sqrt(upper)", "lower": "outlet*sqrt(upper) - second*sqrt(lower)"},
    {"gain": (0.1, None, None, ""), "outlet": (0.2, 0.0, None, ""), "second": (0.3, 0.0, None, "")},
    ("pump",),
    start={"upper": 0.5, "lower": 0.4},
)
HEATER = Model(
    "Heater", {"warmth": "gain*power - loss*(warmth - room)*(1 + time/100)"},
    {"gain": (0.5, None, None, "K/J"), "loss": (0.1, 0.0, None, "1/s")}, ("power", "room"),
)  # fmt: skip
CART = Model(
    "Cart",
    {
        "place": "speed", "speed": "force - drag*speed", "angle": "turn",
        "turn": "-((force - drag*speed)*cos(angle) + 9.81*sin(angle))/length",
    },
    {"drag": (0.5, 0.0, None, ""), "length": (1.0, 0.1, None, "m")},
    ("force",),
)  # fmt: skip

MODELS = (PENDULUM, MOTOR, TANKS, HEATER, CART)
KINDS = ((2, True), (2, False), (3, True), (3, False))


def sample_points(model, rows=6):
    g = torch.Generator().manual_seed(3)
    time, states, inputs = (
        torch.rand(rows, count, generator=g, dtype=torch.float64) + 0.2
        for count in (1, len(model.states), len(model.inputs))
    )
    parameters = torch.tensor([start for start, *_ in model.parameters.values()], dtype=torch.float64) * 1.1
    return time[:, 0], states, inputs, parameters


def by_sympy(model, texts, at):
    """Values (S, k), and derivatives by states, inputs and parameters, each (S, k, size)."""
    names = ["time", *model.states, *model.inputs, *model.parameters]
    symbols = {name: sympy.Symbol(name, real=True) for name in names}
    whole = [sympy.sympify(text, locals=symbols) for text in texts]
    time, states, inputs, parameters = (part.numpy() for part in at)
    given = [time, *states.T, *inputs.T, *(np.full_like(time, value) for value in parameters)]

    def numbers(expressions):
        function = sympy.lambdify(list(symbols.values()), expressions, "numpy")
        return torch.tensor(np.stack([np.broadcast_to(value, time.shape) for value in function(*given)], -1)).double()

    slopes = []
    for group in (model.states, model.inputs, model.parameters):
        flat = [sympy.diff(expression, symbols[name]) for expression in whole for name in group]
        slopes.append(numbers(flat).unflatten(-1, (len(whole), len(group))))
    return numbers(whole), slopes


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: f"FMI {kind[0]}{'' if kind[1] else ', differences'}")
def fmus(request, tmp_path_factory):
    version, derivatives = request.param
    folder = tmp_path_factory.mktemp("fmus")
    return {
        model.name: load_fmu(make_fmu(folder / f"{model.name}.fmu", model, version, derivatives=derivatives)).evaluation
        for model in MODELS
    }


@pytest.mark.parametrize(("model", "outputs"), [*((model, False) for model in MODELS), (MOTOR, True)])
def test_values_and_derivatives_equal_the_equations(fmus, model, outputs):
    texts = list((model.outputs if outputs else model.rates).values())
    evaluation, at = fmus[model.name], sample_points(model)
    values, slopes = by_sympy(model, texts, at)

    def function(*parts):
        return evaluated(evaluation, outputs, at[0], *parts)

    torch.testing.assert_close(function(*at[1:]), values, rtol=1e-13, atol=1e-13)
    rows = torch.arange(len(values))
    for transform in (torch.func.jacrev, torch.func.jacfwd):
        states, inputs, parameters = transform(function, argnums=(0, 1, 2))(*at[1:])
        found = [states[rows, :, rows], inputs[rows, :, rows], parameters]
        for derivative, expected in zip(found, slopes, strict=True):
            torch.testing.assert_close(derivative, expected, rtol=1e-8, atol=1e-8)


def test_batches_equal_single_evaluations(fmus):
    evaluation, (time, states, inputs, parameters) = fmus["Pendulum"], sample_points(PENDULUM)

    def function(states, parameters):
        return evaluated(evaluation, False, time, states, inputs, parameters)

    many = torch.stack([states, 2.0 * states, -states])
    expected = torch.stack([function(rows, parameters) for rows in many])
    assert torch.equal(torch.func.vmap(function, (0, None))(many, parameters), expected)
    other = torch.stack([parameters, 1.5 * parameters, 0.5 * parameters])
    expected = torch.stack([function(*problem) for problem in zip(many, other, strict=True)])
    assert torch.equal(torch.func.vmap(function)(many, other), expected)
    slopes = torch.func.vmap(torch.func.jacfwd(function), (0, None))(many, parameters)
    torch.testing.assert_close(slopes[1], torch.func.jacrev(function)(many[1], parameters))


def test_reverse_mode_applied_twice_is_used_and_second_derivatives_are_refused(fmus):
    evaluation, (time, states, inputs, parameters) = fmus["Cart"], sample_points(CART)

    def function(parameters):
        return evaluated(evaluation, False, time, states, inputs, parameters)

    rows = twice_reverse_tangents(function)(parameters)
    assert _trusted[function] is True
    torch.testing.assert_close(rows.movedim(0, -1), torch.func.jacfwd(function)(parameters))
    at = parameters.clone().requires_grad_()
    (slope,) = torch.autograd.grad(function(at).sum(), at, create_graph=True)
    with pytest.raises(RuntimeError, match="first derivatives only"):
        torch.autograd.grad(slope.sum(), at)


def test_a_wrong_derivative_of_the_fmu_is_not_used(tmp_path):
    """As of tools that omit algebraic loops: differences are used instead."""
    wrong = tmp_path / "wrong.fmu"
    make_fmu(wrong, PENDULUM)
    evaluation = load_fmu(wrong).evaluation
    plain = evaluation.binary.slopes
    evaluation.binary.slopes = lambda *how: 1.01 * plain(*how)
    at = sample_points(PENDULUM)
    _, (expected, _, _) = by_sympy(PENDULUM, list(PENDULUM.rates.values()), at)
    found = evaluation.slopes(False, EvaluationPoints(*(part.numpy() for part in at)), "states")
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    assert not any(evaluation._trusted.values())


def test_repeated_points_are_computed_once(fmus, monkeypatch):
    evaluation, (time, states, inputs, parameters) = fmus["Motor"], sample_points(MOTOR)
    computed = []
    plain = evaluation.binary.values
    monkeypatch.setattr(evaluation.binary, "values", lambda *how: computed.append(len(how[1])) or plain(*how))
    twice = torch.arange(len(time)).repeat_interleave(2)
    parts = (time[twice], states[twice] + 0.123, inputs[twice])
    first = evaluated(evaluation, False, *parts, parameters)
    assert torch.equal(first[::2], first[1::2])
    first.zero_()  # the cached values are a copy
    assert float(evaluated(evaluation, False, *parts, parameters).abs().sum()) > 0
    assert computed == [len(time)]
