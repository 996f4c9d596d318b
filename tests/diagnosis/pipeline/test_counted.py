"""The exported model has the findings that count, fitted without the others."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.evidence.base import EvidenceContext
from mkc_torch.diagnosis.evidence.held_out import blocks_of, held_out, on_all
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.pipeline.counted import corrected_model, counted_fit, left_out_note, scores_of
from mkc_torch.diagnosis.search.estimate import rough_estimate
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.diagnosis.vetoes import counts
from tests.diagnosis.cart import DRAG, cart_terms, free_fit
from tests.diagnosis.factory import make_diagnosis


@pytest.fixture(scope="module")
def fits():
    """The cart alone, with its drag, and with a constant force and a needless damping around the drag."""
    alone = free_fit(DRAG)
    prepared = alone.model.prepared
    terms = {term.effect.id: term for term in cart_terms(alone, "quadratic_drag", "constant_force", "linear_drag")}
    drag, force, damping = (terms[name] for name in ("quadratic_drag", "constant_force", "linear_drag"))

    def fit(*terms):
        model = JointModel(prepared, terms)
        return fitted(model, torch.cat([alone.parameters, alone.parameters.new_zeros(len(terms))]), alone.bound)

    return alone, fit(drag), fit(force, drag, damping)


@pytest.mark.e2e
def test_findings_that_do_not_count_are_left_out_and_the_rest_is_fitted_again(fits):
    alone, drag, final = fits
    kept = counted_fit(final, alone, [1])
    assert [term.effect.id for term in kept.model.terms] == ["quadratic_drag"]
    torch.testing.assert_close(kept.parameters, drag.parameters, rtol=1e-3, atol=1e-4)
    # the drag was another next to a constant force and a damping
    assert float((final.parameters[-2] - drag.parameters[-1]).abs()) > 1e-3
    assert counted_fit(final, alone, [0, 1, 2]) is final
    assert counted_fit(final, alone, []) is alone


class Located:
    """A search result that has a fit only."""

    def __init__(self, fit):
        self.fit = fit


@pytest.fixture(scope="module")
def case(fits):
    """The fits without effects, with the force, with the drag, and with the damping, and their scores."""
    alone, _, final = fits
    terms, prepared = final.model.terms, alone.model.prepared
    blocks = blocks_of(len(alone.residual), 1, Settings().confirmation)

    def fit(count):
        model = JointModel(prepared, terms[:count])
        zeros = alone.parameters.new_zeros(model.size - alone.model.size)
        return fitted(model, torch.cat([alone.parameters, zeros]), alone.bound)

    steps = [alone, fit(1), fit(2), final]
    scores = tuple(held_out(step, blocks) for step in steps)
    found = tuple(Located(step) for step in steps[1:])
    estimate = rough_estimate(final, scores[-1].jackknife)
    return EvidenceContext(alone, None, found, scores, blocks, (), 0, Settings(), estimate=estimate)


@pytest.mark.e2e
def test_the_corrected_scores_are_those_of_the_findings_that_count(fits, case):
    alone, drag, final = fits
    whole = corrected_model(alone, case, [0, 1, 2])
    assert whole.exported is whole.fit is final
    assert whole.evidence is case.held_out[-1]
    nothing = corrected_model(alone, case, [])
    assert (nothing.exported, nothing.fit, nothing.evidence) == (alone, alone, case.held_out[0])
    assert scores_of(case, nothing)[0] == scores_of(case, nothing)[1]
    leading = corrected_model(alone, case, [0])
    assert leading.evidence is case.held_out[1]
    some = corrected_model(alone, case, [1])
    assert [term.effect.id for term in some.exported.model.terms] == ["quadratic_drag"]
    # as if the drag had been the only finding
    expected = held_out(drag, case.blocks)
    torch.testing.assert_close(some.evidence.residual, expected.residual, rtol=0.0, atol=2e-3)
    baseline, corrected = scores_of(case, some)
    assert corrected.outputs["speed"].rmse < 0.5 * baseline.outputs["speed"].rmse
    assert corrected.outputs["speed"].unit == baseline.outputs["speed"].unit


@pytest.mark.e2e
def test_without_time_the_corrected_scores_are_those_before_the_first_finding_that_does_not_count(fits, case):
    alone, *_ = fits
    stopped = corrected_model(alone, case, [1, 2], limit_s=0.0)
    assert stopped.evidence is case.held_out[0]
    # in a quick look nothing is held out, neither for the corrected model
    quick = dataclasses.replace(case, held_out=tuple(on_all(fit) for fit in case.fits))
    assert len(corrected_model(alone, quick, [1]).evidence.parameters) == 1


def test_an_unconfirmed_finding_does_not_count_and_is_named_and_an_untested_one_counts():
    (found,) = make_diagnosis(1).findings
    assert counts(found)
    unconfirmed = dataclasses.replace(found, grade="unconfirmed")
    assert not counts(unconfirmed)
    assert left_out_note([found, unconfirmed]) == (f"The exported model leaves out `{found.effect}`: not confirmed.",)
    assert counts(dataclasses.replace(unconfirmed, evidence=()))
    assert not counts(dataclasses.replace(unconfirmed, evidence=(), cannot_be=True))
