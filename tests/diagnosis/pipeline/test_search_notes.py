"""Warnings about candidates that are no findings, with their reasons."""

from dataclasses import replace
from types import SimpleNamespace

from mkc_torch.diagnosis.pipeline.search_notes import with_search_notes
from mkc_torch.diagnosis.pipeline.steps import StepwiseSearch
from tests.diagnosis.cart import first_term, free_fit
from tests.diagnosis.factory import make_diagnosis


def located(effect="quadratic_drag", **fields):
    return SimpleNamespace(term=first_term(free_fit(), effect), fit=None, p_value=0.01, **fields)


def warnings_of(diagnosis, **fields):
    """Return the warnings that a search adds to a diagnosis."""
    search = StepwiseSearch(
        **{"first": None, "found": (), "unconfirmed": None, "blocks": None} | fields, evidence=(), left=()
    )
    return with_search_notes(diagnosis, search).warnings[len(diagnosis.warnings) :]


def test_a_refused_candidate_is_reported_with_its_reason():
    (warning,) = warnings_of(make_diagnosis(), refused=(located(),))
    assert "quadratic_drag" in warning
    assert "at the rate" not in warning
    assert "p = 0.01 after the whole search" in warning
    assert "changes its length" in warning


def test_an_unconfirmed_candidate_with_the_name_of_a_finding_has_its_port():
    diagnosis = make_diagnosis()
    known = replace(diagnosis.findings[0], effect="quadratic_drag")
    (warning,) = warnings_of(replace(diagnosis, findings=(known,)), unconfirmed=located())
    assert "quadratic_drag at the rate of speed: p = 0.01" in warning
    assert "does not predict held-out blocks better" in warning


def test_effects_as_good_as_a_disturbance_are_named_with_the_remedy():
    terms = [first_term(free_fit(), name) for name in ("linear_drag", "quadratic_drag")]
    follow = tuple(SimpleNamespace(model=SimpleNamespace(terms=(term,))) for term in terms)
    first = SimpleNamespace(term=terms[0], p_value=0.2, follow=follow, longer=float("inf"))
    diagnosis = make_diagnosis(0, verdict="unexplained")
    (warning,) = warnings_of(diagnosis, first=first)
    assert "linear_drag or quadratic_drag would explain" in warning
    assert "p = 0.2" in warning
    assert "--together" in warning
    assert warnings_of(diagnosis, first=SimpleNamespace(**{**vars(first), "follow": ()})) == ()


def test_a_search_that_ended_early_names_the_last_finding():
    (warning,) = warnings_of(make_diagnosis(), found=(located(),), given_up="No finite trajectory.")
    assert "ended early: with quadratic_drag in the model" in warning
