"""The exported model has the findings that count, fitted without the others."""

import dataclasses

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.pipeline.counted import counted_fit, counts, left_out_note
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


def test_an_unconfirmed_finding_does_not_count_and_is_named_and_an_untested_one_counts():
    (found,) = make_diagnosis(1).findings
    assert counts(found)
    unconfirmed = dataclasses.replace(found, grade="unconfirmed")
    assert not counts(unconfirmed)
    assert left_out_note([found, unconfirmed]) == (f"The exported model leaves out `{found.effect}`: not confirmed.",)
    assert counts(dataclasses.replace(unconfirmed, evidence=()))
    assert not counts(dataclasses.replace(unconfirmed, evidence=(), cannot_be=True))
