"""A finding whose size is not determined alone gets the partner that gains most with it."""

import functools
import types

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted_with_effect
from mkc_torch.diagnosis.search.partner import _partners, is_undetermined, with_partner
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.settings import NoiseSettings, Settings
from tests.diagnosis.search.test_free_runs import DRAG, all_terms, free_fit


@functools.cache
def fit_of_drag(drag=DRAG):
    return free_fit(drag)


def found_effect(name, *rivals, drag=DRAG):
    """Return the result of a search that found an effect, with these rivals."""
    terms = all_terms(fit_of_drag(drag))
    numbers = [next(n for n, term in enumerate(terms) if term.effect.id == each) for each in (name, *rivals)]
    term = terms[numbers[0]]
    model = fit_of_drag(drag).model.with_term(term)
    zeros = torch.zeros(model.size - fit_of_drag(drag).model.size).double()
    fit = fitted_with_effect(fit_of_drag(drag), model, torch.cat([fit_of_drag(drag).parameters, zeros]), graduate=False)
    ranking = tuple(Ranked(number, 10.0, float(gap)) for gap, number in enumerate(numbers))
    return types.SimpleNamespace(term=term, fit=fit, ranking=ranking, scene=types.SimpleNamespace(terms=terms))


def test_a_size_is_undetermined_if_the_recording_lacks_the_effect():
    assert not is_undetermined(found_effect("quadratic_drag").fit, NoiseSettings())
    assert is_undetermined(found_effect("quadratic_drag", drag=0.0).fit, NoiseSettings())


def test_the_partner_of_a_finding_is_the_missing_effect():
    pair = with_partner(found_effect("dead_zone", "quadratic_drag"), fit_of_drag(), {}, Settings())
    assert [term.effect.id for term in pair.model.terms] == ["dead_zone", "quadratic_drag"]
    assert float(pair.parameters[-1]) == pytest.approx(DRAG, rel=0.1)


def test_a_partner_without_a_gain_above_its_penalty_is_not_added():
    assert with_partner(found_effect("dead_zone", "quadratic_drag", drag=0.0), fit_of_drag(0.0), {}, Settings()) is None


def test_partner_candidates_are_the_same_effect_at_other_ports_and_three_leading_rivals():
    def term(name, place, curve=False):
        return types.SimpleNamespace(key=(name, place), effect=types.SimpleNamespace(id=name, is_curve=curve))

    curve, own, *others = term("curve", 1, curve=True), term("overflow", 2), *(term(name, 1) for name in "abcd")
    terms = [curve, own, *others, term("overflow", 1)]
    ranking = [Ranked(number, 10.0, 0.0) for number in range(len(terms))]
    located = types.SimpleNamespace(term=own, ranking=ranking, scene=types.SimpleNamespace(terms=terms))
    assert _partners(located) == [terms[-1], *others[:3]]
