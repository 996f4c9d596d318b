"""What was found under pushes is told by its free run; where one is lost, all stays as it is."""

import dataclasses
import functools
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence import open_loop as module
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out
from mkc_torch.diagnosis.evidence.open_loop import open_loop_evidence
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise, refit_open_loop
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import ConfirmationSettings
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from tests.diagnosis.line import Line
from tests.diagnosis.swing import at_the_truth, candidates

BLOCKS = blocks_of(500, 1, ConfirmationSettings())
KEPT = SimpleNamespace()
"""Evidence that only has to be the same."""


def located(fit):
    """Of a search, its fit alone."""
    return SearchResult(fit.model.terms[-1] if fit.model.terms else None, fit, 0.01, 9.0, (), None, None, None)


@functools.cache
def under_pushes():
    """A simulation alone and with a drag, both under pushes."""
    base = at_the_truth("white", 1)
    (term,) = [candidate for candidate in candidates(base, (QuadraticDrag(),)) if candidate.port == "rate of rate"]
    model = base.model.with_term(term)
    one = dataclasses.replace(base, model=model, parameters=torch.cat([base.parameters, base.parameters.new_zeros(1)]))
    return base, located(one)


def test_what_runs_freely_already_stays_the_same():
    line = Line(500)
    base = fitted(JointModel(line), line.start())
    found = (located(base),)
    again = open_loop_evidence(base, base, found, (KEPT,), BLOCKS)
    assert again.base is base
    assert again.found is found
    assert again.held_out == (KEPT,)


@pytest.mark.e2e
def test_fits_under_pushes_are_fitted_to_their_free_runs_and_judged_by_these():
    base, one = under_pushes()
    alone = refit_open_loop(base)
    again = open_loop_evidence(base, alone, (one,), (KEPT, KEPT), BLOCKS)
    assert again.base is alone
    (found,) = again.found
    assert has_process_noise(one.fit)
    assert not has_process_noise(found.fit)
    # all else that is known of it is kept
    assert (found.term, found.p_value, found.beyond) == (one.term, one.p_value, one.beyond)
    assert found.fit.log_likelihood >= alone.log_likelihood - 1.0
    before, after = again.held_out
    assert torch.equal(before.residual, held_out(alone, BLOCKS).residual)
    assert after.residual.shape == before.residual.shape
    assert not torch.equal(after.residual, before.residual)


def as_it_is(again, base, found):
    assert again.base is base
    assert again.found is found
    assert again.held_out == (KEPT, KEPT)


def test_where_the_simulation_alone_loses_the_recording_all_is_told_under_pushes():
    base, one = under_pushes()
    found = (one,)
    as_it_is(open_loop_evidence(base, None, found, (KEPT, KEPT), BLOCKS), base, found)


@pytest.mark.parametrize("lost", [("refit_open_loop", "_from_alone"), ("_judged",)])
def test_where_a_finding_loses_the_recording_or_an_unseen_block_all_is_told_under_pushes(monkeypatch, lost):
    base, one = under_pushes()
    alone, found = refit_open_loop(base), (one,)
    for name in lost:
        monkeypatch.setattr(module, name, lambda *_: None)
    as_it_is(open_loop_evidence(base, alone, found, (KEPT, KEPT), BLOCKS), base, found)
