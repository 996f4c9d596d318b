"""Findings under process noise are evaluated by their open-loop fits; if any of these fails, nothing changes."""

import dataclasses
import functools
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence import prediction as module
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out
from mkc_torch.diagnosis.evidence.prediction import open_loop_evidence
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.process_noise import has_process_noise, refit_open_loop
from mkc_torch.diagnosis.search.run import SearchResult
from mkc_torch.diagnosis.settings import ConfirmationSettings
from mkc_torch.effects.dynamics.quadratic_drag import QuadraticDrag
from tests.diagnosis.line import Line
from tests.diagnosis.swing import candidates, pendulum_at_truth

BLOCKS = blocks_of(500, 1, ConfirmationSettings())
KEPT = SimpleNamespace()
"""Placeholder evidence, compared by identity."""


def located(fit):
    """Return a search result that holds this fit."""
    return SearchResult(fit.model.terms[-1] if fit.model.terms else None, fit, 0.01, 9.0, (), None, None, None)


@functools.cache
def under_process_noise():
    """Return fits without and with a drag, both under process noise."""
    base = pendulum_at_truth("white", 1)
    (term,) = [candidate for candidate in candidates(base, (QuadraticDrag(),)) if candidate.port == "rate of rate"]
    model = base.model.with_term(term)
    with_drag = dataclasses.replace(
        base, model=model, parameters=torch.cat([base.parameters, base.parameters.new_zeros(1)])
    )
    return base, located(with_drag)


def test_an_open_loop_fit_stays_unchanged():
    line = Line(500)
    base = fitted(JointModel(line), line.start())
    found = (located(base),)
    again = open_loop_evidence(base, base, found, (KEPT,), BLOCKS)
    assert again.base is base
    assert again.found is found
    assert again.held_out == (KEPT,)


@pytest.mark.e2e
def test_fits_under_process_noise_are_refitted_and_evaluated_open_loop():
    base, finding = under_process_noise()
    alone = refit_open_loop(base)
    again = open_loop_evidence(base, alone, (finding,), (KEPT, KEPT), BLOCKS)
    assert again.base is alone
    (found,) = again.found
    assert has_process_noise(finding.fit)
    assert not has_process_noise(found.fit)
    # the other fields of the search result are kept
    assert (found.term, found.p_value, found.beyond) == (finding.term, finding.p_value, finding.beyond)
    assert found.fit.log_likelihood >= alone.log_likelihood - 1.0
    before, after = again.held_out
    assert torch.equal(before.residual, held_out(alone, BLOCKS).residual)
    assert after.residual.shape == before.residual.shape
    assert not torch.equal(after.residual, before.residual)


def assert_unchanged(again, base, found):
    assert again.base is base
    assert again.found is found
    assert again.held_out == (KEPT, KEPT)


@pytest.mark.e2e
def test_process_noise_is_kept_if_the_simulation_alone_diverges_open_loop():
    base, finding = under_process_noise()
    found = (finding,)
    assert_unchanged(open_loop_evidence(base, None, found, (KEPT, KEPT), BLOCKS), base, found)


@pytest.mark.parametrize("lost", [("refit_open_loop", "_from_alone"), ("_judged",)])
def test_process_noise_is_kept_if_a_finding_diverges_open_loop_or_on_a_held_out_block(monkeypatch, lost):
    base, finding = under_process_noise()
    alone, found = refit_open_loop(base), (finding,)
    for name in lost:
        monkeypatch.setattr(module, name, lambda *_: None)
    assert_unchanged(open_loop_evidence(base, alone, found, (KEPT, KEPT), BLOCKS), base, found)
