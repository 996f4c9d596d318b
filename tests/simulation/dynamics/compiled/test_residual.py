"""Compiled residuals and their tangents agree with torch."""

import math

import pytest
import torch

from mkc_torch._support.forward_mode import forward_tangents
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import ShapedModel
from mkc_torch.diagnosis.model.term import Driver, Term
from mkc_torch.effects.base import Effect, GainEffect
from mkc_torch.effects.context import Quantity
from mkc_torch.effects.dynamics import DYNAMICS
from mkc_torch.nonlinear import fit
from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics, Parameter
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.dynamics.compiled.collocation import marched
from mkc_torch.simulation.dynamics.first_fit import floor_of
from mkc_torch.simulation.dynamics.flow import flow_along
from mkc_torch.simulation.dynamics.noise_selection import observer_of
from mkc_torch.simulation.dynamics.observer import Disturbance
from mkc_torch.simulation.dynamics.trajectory import marched as torch_marched

TIME = torch.linspace(0.0, 4.0, 81, dtype=torch.float64)


class Driven(Dynamics):
    """A pendulum with a torque, a coupled temperature, and functions of all kinds."""

    states = ("angle", "speed", "warmth")
    inputs = ("torque",)
    outputs = ("angle", "warmth")
    units = {"angle": "rad", "speed": "rad/s"}
    parameters = {"stiffness": 4.0, "damping": Parameter(0.2, lower=0.0), "gain": 1.0, "loss": 0.3}

    def derivative(self, time, x, u, p):
        torque = torch.where(u.torque > 0, p.gain * u.torque, 0.5 * p.gain * torch.tanh(u.torque))
        return {
            "angle": x.speed,
            "speed": torque - p.stiffness * torch.sin(x.angle) - p.damping * x.speed * (1.0 + x.speed.abs()),
            "warmth": p.damping * x.speed**2 - p.loss * x.warmth.clamp(min=-1.0) + 0.1 * torch.exp(-time),
        }

    def output(self, time, x, u, p):
        return {"angle": x.angle + 0.05 * p.gain * u.torque, "warmth": x.warmth}


class Turned(Driven):
    """The same, with an actuator and a sensor."""

    def actuator(self, time, u, p, run):
        return {"torque": p.gain * u.torque}

    def sensor(self, time, y, p, run):
        return {**y, "warmth": p.loss * y["warmth"]}


class Single(Dynamics):
    states = ("level",)
    parameters = {"rate": 0.7}

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}


class Branching(Single):
    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level if p.rate > 0.0 else 0.0 * x.level}


class OwnSlope(torch.autograd.Function):
    """Twice the value, with a slope of 3."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value):
        return 2.0 * value

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, grad):
        return 3.0 * grad

    @staticmethod
    def jvp(ctx, tangent):
        return 3.0 * tangent


class Declared(Single):
    def derivative(self, time, x, u, p):
        return {"level": -p.rate * OwnSlope.apply(x.level)}


def recorded(runs=1, **columns):
    generator = torch.Generator().manual_seed(3)
    time = torch.cat([TIME + 10.0 * k for k in range(runs)])
    run = torch.arange(runs).repeat_interleave(len(TIME)).double()
    since = time - 10.0 * run
    known = {
        "time": time,
        "torque": torch.sin(2.0 * since + run),
        "angle": 0.5 * torch.cos(1.7 * since) + 0.01 * torch.randn(len(time), generator=generator, dtype=time.dtype),
        "warmth": 0.2 * torch.exp(-0.3 * since) + 0.01 * torch.randn(len(time), generator=generator, dtype=time.dtype),
        "level": torch.exp(-0.7 * since) + 0.01 * torch.randn(len(time), generator=generator, dtype=time.dtype),
    }
    if runs > 1:
        known["experiment"] = run
    return Recording({**known, **columns})


def assert_close(computed, expected, share):
    """Assert equality up to a share of the largest value."""
    torch.testing.assert_close(computed, expected, rtol=0, atol=share * float(expected.abs().max()) + 1e-14)


def assert_like_torch(model, parameters, *, rtol=1e-9, further=True):
    """Assert that a compiled residual exists, and agrees with torch in values and tangents."""
    prepared = model.prepared
    compiled = model._compiled
    assert compiled is not None

    def generic(p):
        return prepared.answer(p[: model.base], model.changes(p), nearby).residual

    nearby = None
    for _ in range(2):  # the second solution is converged to all digits
        theirs = prepared.answer(parameters[: model.base], model.changes(parameters), nearby)
        nearby = theirs.nearby.bare
    neighbour = compiled.answer(0.999 * parameters, nearby).nearby
    assert neighbour is not None
    for near in (neighbour, neighbour.bare, nearby, None):
        ours = compiled.answer(parameters, near)
        torch.testing.assert_close(
            ours.residual, theirs.residual, rtol=0, atol=rtol * float(theirs.residual.abs().max())
        )
        torch.testing.assert_close(
            ours.nearby.states, nearby.states, rtol=0, atol=rtol * float(nearby.states.abs().max())
        )
    rows = forward_tangents(generic)(parameters)
    own = compiled.tangents(parameters, compiled.answer(parameters, nearby).nearby)
    assert own.rows.shape == rows.shape
    for ours_row, their_row in zip(own.rows, rows, strict=True):
        assert_close(ours_row, their_row, rtol)
    if not further:
        return
    # torch can start from the compiled trajectory too
    again = prepared.answer(parameters[: model.base], model.changes(parameters), own.nearby).residual
    assert_close(again, theirs.residual, rtol)
    slopes = torch.func.jacfwd(lambda p: prepared.answer(p[: model.base], model.changes(p), own.nearby).residual)
    assert_close(slopes(parameters).movedim(-1, 0), rows, 1e-8)


def observed(prepared, lasting=0.0):
    theta = prepared.given
    flow = flow_along(prepared, theta, prepared.guess)
    process_noise = tuple(Disturbance(name, True, lasting, 0.5) for name in prepared.disturbable)
    more = (Disturbance(prepared.channels[0], False, 1.0, 0.1),) if lasting else ()
    observer = observer_of(flow, (*process_noise, *more), floor_of(prepared), prepared.disturbable, prepared.channels)
    assert observer is not None
    return prepared.observed(observer)


@pytest.mark.parametrize("system", [Driven(), Turned(), Single()])
@pytest.mark.parametrize("runs", [1, 3])
def test_open_loop_residuals_match_torch(system, runs):
    prepared = system.prepare(recorded(runs))
    assert_like_torch(JointModel(prepared), prepared.given)


@pytest.mark.parametrize("system", [Driven(), Turned(), Single()])
@pytest.mark.parametrize("lasting", [0.0, 2.0])
def test_residuals_with_an_observer_match_torch(system, lasting):
    prepared = observed(system.prepare(recorded(2)), lasting)
    assert_like_torch(JointModel(prepared), prepared.given)


class Quadratic(Effect):
    """A quadratic output error."""

    id = "quadratic"
    port = "output"
    follows_signal = True

    def quantities(self, shape, context):
        return (Quantity("curvature", 1, ""),)

    def change(self, gamma, shape, context):
        return gamma * context.signal.square()


class Warming(GainEffect):
    """An offset of every output that grows with time."""

    id = "warming"
    port = "output"

    def waveform(self, shape, context):
        return 0.1 * context.time


def candidates(prepared):
    """Each effect at each of its ports, alone or with a driver."""
    column = torch.sin(prepared.time)
    for effect in (*DYNAMICS, Quadratic(), Warming()):
        for name, port in prepared.ports.items():
            if (port.kind or name) != effect.port or not set(effect.needs) <= set(port.parts):
                continue
            driver = (
                Driver(("column",), "any", column.unsqueeze(-1), column[:1] + 2.0, ("A",)) if effect.roles else None
            )
            yield Term(effect, driver, sized(effect, port, effect.shapes(prepared.time)[0]), name)


def sized(effect, port, shape):
    """Return a shape whose shares of a part are in the part's unit."""
    found = dict(shape)
    for key, (part, size) in effect.relative.items():
        if key in found and part in port.sizes:
            found[key] *= getattr(port.sizes[part], size)
    return found


@pytest.mark.parametrize("corrected", [False, True])
def test_residuals_with_each_effect_match_torch(corrected):
    prepared = Driven().prepare(recorded(2))
    prepared = observed(prepared) if corrected else prepared
    seen = set()
    for term in candidates(prepared):
        if corrected and term.effect.open_loop_only:
            continue
        model = JointModel(prepared, (term,))
        gamma = 0.02 * torch.ones(model.size - model.base, dtype=torch.float64)
        parameters = torch.cat([prepared.given, gamma])
        assert model._compiled is not None, term.effect.id
        # torch computes effects that link outputs of different samples
        assert (model._compiled._traced.outputs is None) == (term.effect.id in ("sensor_lag", "sensor_clock_drift"))
        seen.add((term.effect.id, prepared.ports[term.port].kind or "output"))
        if prepared.answer(parameters[: model.base], model.changes(parameters)).nearby is not None:
            assert_like_torch(model, parameters, further=False)
    kinds = {kind for _, kind in seen}
    assert {"rate", "input", "output", "resonant rate", "lagged rate", "hysteretic rate"} <= kinds


@pytest.mark.parametrize("first", ["dead_zone", "input_delay"])
@pytest.mark.parametrize("corrected", [False, True])
def test_residuals_with_fitted_shapes_of_input_effects_match_torch(corrected, first):
    prepared = Driven().prepare(recorded(2))
    prepared = observed(prepared) if corrected else prepared
    terms = [term for term in candidates(prepared) if term.port == "input torque"]
    before = next(term for term in terms if term.effect.id == first)
    for term in terms:
        model = ShapedModel.of(JointModel(prepared, (before, term)))
        gamma = 0.02 * torch.ones(model.joint - model.base, dtype=torch.float64)
        parameters = model.start(torch.cat([prepared.given, gamma]))
        assert model._compiled is not None, term.effect.id
        assert_like_torch(model, parameters, further=False)


@pytest.mark.parametrize("system", [Branching(), Declared()])
def test_untraceable_systems_fall_back_to_torch(system):
    prepared = system.prepare(recorded())
    assert prepared.compiled(lambda p: (p, {}), len(prepared.given)) is None
    way = Continuation(prepared, lambda p: (p, {}))
    assert way.tangents(prepared.given) is None
    found = fit(way, prepared.given, jacobian="reverse twice")
    assert bool(found.theta.isfinite().all())


def test_fits_with_compiled_and_torch_residuals_agree():
    prepared = observed(Driven().prepare(recorded(2)))
    start = prepared.given * 1.05

    def plain(theta):
        return prepared.answer(theta, {}).residual

    way = Continuation(prepared, lambda p: (p, {}))
    ours, theirs = (fit(residual, start, jacobian="reverse twice", tol=1e-12) for residual in (way, plain))
    assert ours.log_likelihood == pytest.approx(float(theirs.log_likelihood), rel=1e-10)
    torch.testing.assert_close(ours.theta, theirs.theta, rtol=1e-6, atol=1e-8)
    assert way.tangents(ours.theta) is not None


def test_a_fit_uses_the_compiled_residual():
    prepared = Single().prepare(recorded())
    way = Continuation(prepared, lambda p: (p, {}))
    way(prepared.given)
    prepared.answer = prepared.rate = None  # the torch implementation
    assert bool(fit(way, prepared.given, jacobian="reverse twice").converged)


def test_growing_horizons_of_numpy_and_torch_end_near_the_trajectory():
    prepared = Driven().prepare(recorded(2))
    theta = prepared.given
    compiled = prepared.compiled(lambda p: (p, {}), len(theta))
    far = torch.where(prepared.grid.begins.unsqueeze(-1), prepared.guess, -2.0 * prepared.guess + 1.0)
    theirs = torch_marched(prepared.rate(theta, {}), prepared.grid, prepared.first_states(theta, {})[0], far)
    ours = marched(compiled._collocation(theta.tolist()), compiled._grid, far.numpy().T)
    solved = compiled.answer(theta).nearby.states
    assert_close(torch.from_numpy(ours.T.copy()), solved, 1e-3)
    assert_close(theirs, solved, 1e-3)
    assert (far - solved).abs().max() > 0.5


def test_a_growing_horizon_finds_a_trajectory_from_a_bad_guess():
    prepared = Driven().prepare(recorded(2))
    theta = prepared.given
    expected = prepared.answer(theta, {}).residual
    compiled = prepared.compiled(lambda p: (p, {}), len(theta))
    prepared.guess = torch.where(prepared.grid.begins.unsqueeze(-1), prepared.guess, 1e3 * prepared.guess)
    assert_close(compiled.answer(theta).residual, expected, 1e-8)


def test_the_residual_is_nan_without_a_trajectory():
    class Exploding(Single):
        def derivative(self, time, x, u, p):
            return {"level": p.rate * torch.exp(x.level * x.level)}

    prepared = Exploding().prepare(recorded())
    compiled = prepared.compiled(lambda p: (p, {}), 2)
    near = compiled.answer(torch.tensor([-0.1, 1.0], dtype=torch.float64)).nearby
    lost = torch.tensor([1e3, 1.0], dtype=torch.float64)
    assert bool(compiled.answer(lost).residual.isnan().all())
    assert bool(compiled.answer(lost, near).residual.isnan().all())
    assert math.isnan(float(prepared.answer(lost, {}, near).residual[0, 0]))
