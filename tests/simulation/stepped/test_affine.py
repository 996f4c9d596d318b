"""Steps that are affine at a trajectory: exact there, with the right derivatives, and of second order nearby."""

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.functional import mkc_nll
from mkc_torch.nonlinear import fit as nonlinear_fit
from mkc_torch.simulation import affine_rounds
from mkc_torch.simulation.continuation import Continuation
from mkc_torch.simulation.dynamics.compiled import machine
from mkc_torch.simulation.dynamics.first_fit import with_strong_observer
from tests.simulation.stepped.models import Equations
from tests.simulation.stepped.test_compiled import cases
from tests.simulation.stepped.test_constants import Pendulum, swinging
from tests.simulation.stepped.test_stepper import recording_of

NAMES = ["force", "rate", "derivative", "input", "constant", "joint", "followed"]


def continuation_of(prepared, changes):
    """The residual of a case as a function of its own parameters and the size of its change, and its first values."""
    count = len(prepared.given)
    start = torch.cat([prepared.start(), prepared.given.new_tensor([0.02])])
    return Continuation(prepared, lambda values: (values[:count], changes(values))), start


@pytest.mark.parametrize("observed", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_affine_steps_have_the_values_and_derivatives_of_the_simulation_at_their_parameters(name, observed, tmp_path):
    prepared, changes = cases(tmp_path)[name]
    prepared = with_strong_observer(prepared, prepared.start(), 0.1) if observed else prepared
    own, start = continuation_of(prepared, changes)
    affine = own.affine(start)
    size = float(prepared.measured.abs().max())
    torch.testing.assert_close(affine(start), own(start), rtol=0, atol=1e-7 * size)
    # along an observer the tangents are of its whole course, and nearly 0 where it corrects a pendulum at rest
    share, least = (3e-4, 1e-6) if observed else (1e-4, 1e-9)
    for ours, theirs in zip(affine.tangents(start), own.tangents(start), strict=True):
        assert float((ours - theirs).abs().max()) <= share * float(theirs.abs().max()) + least


@pytest.mark.parametrize("name", ["force", "joint", "followed"])
def test_the_error_of_affine_steps_is_of_second_order(name, tmp_path):
    prepared, changes = cases(tmp_path)[name]
    own, start = continuation_of(prepared, changes)
    affine, errors, moves = own.affine(start), [], []
    for share in (0.02, 0.01):
        moved = start * (1.0 + share)
        errors.append(float((affine(moved) - own(moved)).abs().max()))
        moves.append(float((own(start) - own(moved)).abs().max()))
    assert errors[0] < 0.1 * moves[0]
    assert 3.0 < errors[0] / errors[1] < 5.0


@pytest.mark.parametrize("observed", [False, True])
def test_machine_code_and_python_take_the_same_affine_steps(observed, tmp_path, monkeypatch):
    prepared, changes = cases(tmp_path)["joint"]
    prepared = with_strong_observer(prepared, prepared.start(), 0.1) if observed else prepared
    own, start = continuation_of(prepared, changes)
    real, loops, moved = machine.machine_code, [], 1.01 * start
    monkeypatch.setattr(machine, "machine_code", lambda loop: loops.append(loop.__name__) or real(loop))
    by_machine_code = own.affine(start)(moved)
    assert "step_through" in loops
    monkeypatch.setattr(machine, "machine_code", lambda _: None)
    by_python = own.affine(start)(moved)
    torch.testing.assert_close(by_python, by_machine_code, rtol=0, atol=1e-11)
    assert float((by_python - own(start)).abs().max()) > 1e-6


def test_a_simulation_of_equations_has_no_affine_steps():
    own, start = continuation_of(Equations().prepare(recording_of()), lambda values: {})
    assert own.affine(start) is None


def test_rounds_of_affine_steps_end_at_the_fit_by_the_simulation_s_own_steps(tmp_path):
    prepared, changes = Pendulum().prepare(swinging(1.3, noise=0.002)), cases(tmp_path)["constant"][1]
    own, start = continuation_of(prepared, changes)
    lower, upper = (torch.cat([bound, start[:1]]) for bound in prepared.bounds)
    lower[-1], upper[-1] = -0.9, 9.0

    def by(way, at):
        return nonlinear_fit(way, at, lower=lower, upper=upper, covariance=None, max_iter=60, tol=1e-7)

    expected = by(own, start)
    rollouts, answered = [], own._answer
    own._answer = lambda *given: (rollouts.append(given), answered(*given))[1]
    found = affine_rounds.fitted_in_rounds(own, start, by, None, 1e-7, 8)
    assert found is not None
    residual, best = own(found.theta), own(expected.theta)
    assert abs(float(found.log_likelihood - expected.log_likelihood)) < 1e-5
    torch.testing.assert_close(residual, best, rtol=0, atol=1e-4 * float(best.abs().max()))
    assert len(rollouts) < expected.n_iter


def test_a_residual_of_steps_is_computed_once_at_its_parameters(tmp_path):
    prepared, changes = cases(tmp_path)["followed"]
    own, start = continuation_of(prepared, changes)
    answers, answered = [], own._answer
    own._answer = lambda *given: (answers.append(given), answered(*given))[1]
    first = own(start)
    assert own.affine(start) is not None
    assert own(start) is first
    assert len(answers) == 1
    assert not torch.equal(own(1.01 * start), first)


def test_the_likelihood_of_a_fit_with_left_out_samples_is_that_of_the_others():
    model = JointModel(Pendulum().prepare(swinging(0.9, noise=0.002)))
    start = model.prepared.start()
    rows = torch.ones(len(model.prepared.measured), dtype=torch.float64)
    rows[50:90] = 0.0
    found = fitted(model, start, rows=rows)
    seen = -float(mkc_nll(found.residual[rows > 0], found.sigma, found.d, found.bound).sum())
    assert found.log_likelihood == pytest.approx(seen * len(rows) / float(rows.sum()), rel=1e-9)
