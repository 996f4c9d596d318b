"""The collocation by machine code agrees with NumPy: each operation, solutions, and derivatives."""

import itertools

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.simulation.dynamics.compiled.arrays import ArraySystem
from mkc_torch.simulation.dynamics.compiled.expressions import FUNCTIONS, Expressions
from mkc_torch.simulation.dynamics.compiled.machine import MachineSystem
from mkc_torch.simulation.dynamics.compiled.program import Program
from mkc_torch.simulation.dynamics.loops.machine_code import machine_code
from mkc_torch.simulation.dynamics.loops.programs import CODES, loaded, registers, run
from tests.simulation.dynamics.compiled.test_residual import Driven, Single, recorded
from tests.simulation.dynamics.compiled.test_residual import observed as with_observer

SPECIAL = [0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.0, 1e-300, 1e300, np.inf, -np.inf, np.nan]
LOGICAL = ("logical_and", "logical_or", "logical_not")


def outputs_of(program, states, way):
    """Return the outputs of a program at states (w, L), by ``way`` of compiling."""
    at = program.at([])
    rows = registers(at, len(states))
    loaded(at, rows, states, 0, 0, 0, states.shape[1])
    way(at, rows, states.shape[1])
    return rows[at[3], : states.shape[1]]


def arguments_of(operation):
    values = [0.0, 1.0] if operation in LOGICAL else SPECIAL
    for count in (3,) if operation == "where" else (1, 2):
        try:
            FUNCTIONS[operation](*[np.array([0.5])] * count)
        except (TypeError, ValueError):
            continue
        return np.array(list(itertools.product(values[: 5 if count == 3 else None], repeat=count))).T.copy()
    raise AssertionError(operation)


@pytest.mark.parametrize("operation", FUNCTIONS)
def test_an_operation_agrees_with_numpy(operation):
    states = arguments_of(operation)
    e = Expressions()
    leaves = [e.leaf("state", k) for k in range(len(states))]
    program = Program(e, [e.apply(operation, *leaves)], leaves, (1, states.shape[1]), CODES)
    with np.errstate(all="ignore"):
        given = states.astype(bool) if operation in LOGICAL else states
        expected = FUNCTIONS[operation](*given) if operation != "where" else np.where(states[0] != 0.0, *states[1:])
        for first in range(0, states.shape[1], 100):
            part = slice(first, first + 100)
            found = outputs_of(program, states[:, part].copy(), machine_code(run))
            np.testing.assert_allclose(found[0], expected[part].astype(float), rtol=1e-14)


def test_numbers_columns_and_parameters_are_rows_of_a_program():
    e = Expressions()
    x, p = e.leaf("state", 0), e.leaf("parameter", 0)
    column = e.column(np.arange(6.0))
    scaled = e.apply("mul", e.apply("add", column, p), e.number(2.0))
    program = Program(e, [e.apply("add", x, scaled), e.apply("mul", p, p), x], [x], (3, 2), CODES)
    at = program.at([10.0])
    for arrangement in range(3):
        rows = registers(at, 1)
        loaded(at, rows, np.array([[0.5, 0.25]]), 0, arrangement, 0, 2)
        run(at, rows, 2)
        own = 2.0 * (np.arange(6.0).reshape(2, 3)[:, arrangement] + 10.0)
        np.testing.assert_array_equal(rows[at[3], :2], [own + np.array([0.5, 0.25]), [100.0, 100.0], [0.5, 0.25]])


@pytest.fixture(params=[(Driven, 1, False), (Driven, 2, True), (Single, 2, False), (Single, 1, True)], ids=str)
def collocations(request):
    """Return the compiled residual, its start, and the collocation there by NumPy and by machine code."""
    system, runs, observed = request.param
    prepared = system().prepare(recorded(runs))
    compiled = JointModel(with_observer(prepared, 0.7) if observed else prepared)._compiled
    theta = prepared.given
    parts = compiled._traced, compiled._grid, compiled._rows, compiled._observed
    assert isinstance(compiled._equations, MachineSystem)
    return compiled, theta, ArraySystem(*parts).at(theta.tolist()), MachineSystem(*parts).at(theta.tolist())


def assert_alike(found, expected):
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * max(np.abs(expected).max(initial=0.0), 1e-300))


def test_solutions_by_numpy_and_machine_code_agree(collocations):
    compiled, theta, by_numpy, by_machine = collocations
    guess = compiled._with_first_states(compiled._system.guess, compiled._first(theta.tolist()))
    with np.errstate(all="ignore"):
        expected, found = by_numpy.solved(guess), by_machine.solved(guess)
        assert_alike(found.states, expected.states)
        assert_alike(found.factor.inverse, expected.factor.inverse)
        assert_alike(found.factor.affine.carries[0], expected.factor.affine.carries[0])
        given = found.factor.inverse.copy()
        again = by_machine.solved(1.0001 * guess, found.factor)
        assert_alike(again.states, by_numpy.solved(1.0001 * guess, expected.factor).states)
        np.testing.assert_array_equal(found.factor.inverse, given)  # the factor of a neighbour is not overwritten


def test_rough_solutions_by_numpy_and_machine_code_agree(collocations):
    compiled, theta, by_numpy, by_machine = collocations
    guess = compiled._with_first_states(0.0 * compiled._system.guess, compiled._first(theta.tolist()))
    inside = np.arange(guess.shape[1]) % 60 <= 40
    with np.errstate(all="ignore"):
        (expected, settled), (found, same) = by_numpy.solved_to(guess, inside), by_machine.solved_to(guess, inside)
    assert settled == same
    assert_alike(found, expected)


def test_source_terms_by_numpy_and_machine_code_agree(collocations):
    compiled, theta, by_numpy, by_machine = collocations
    guess = compiled._with_first_states(compiled._system.guess, compiled._first(theta.tolist()))
    with np.errstate(all="ignore"):
        states = by_numpy.solved(guess).states
        expected, found = by_numpy.sources(states), by_machine.sources(states)
    assert found.parameters == expected.parameters
    assert_alike(found.source, expected.source)
    assert_alike(found.factor.inverse, expected.factor.inverse)


def test_a_guess_that_is_not_finite_has_no_solution(collocations):
    compiled, theta, _, by_machine = collocations
    guess = compiled._with_first_states(compiled._system.guess, compiled._first(theta.tolist()))
    guess[:, 5] = np.nan
    assert by_machine.solved(guess) is None
    assert by_machine.solved_to(guess, np.ones(guess.shape[1], dtype=bool))[0] is None


def test_numpy_is_the_fallback_without_numba(monkeypatch):
    monkeypatch.setattr("mkc_torch.simulation.dynamics.compiled.machine.machine_code", lambda _: None)
    prepared = Driven().prepare(recorded())
    model = JointModel(prepared)
    assert isinstance(model._compiled._equations, ArraySystem)
    assert bool(torch.isfinite(model.residual(prepared.start())).all())
