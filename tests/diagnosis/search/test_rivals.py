"""Rivals that follow the trajectory an effect has made are fitted before they count as not told apart."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.search import rivals
from mkc_torch.diagnosis.search.model_prior import ModelPrior
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.search.rivals import by_joint_fits
from mkc_torch.diagnosis.settings import Settings

BENT, POINTWISE = "rate", "sensor"


class Indifferent(ModelPrior):
    """No handicaps; in coloured noise a fit gains so much more than one that is not named."""

    def __init__(self, **new):
        self.new = new

    def penalty(self, _term, _gain):
        return 0.0

    def by_innovations(self, one, other, _price=1.0):
        return self.new.get(other.model.terms[-1].key, 0.0) - self.new.get(one.model.terms[-1].key, 0.0)


def term(key, port=BENT):
    return SimpleNamespace(key=key, port=port)


def fit_of(own, gain, size=1):
    """A fit that is so much likelier than that without an effect, after the price of its size."""
    model = SimpleNamespace(terms=[own], sizes=[size], residual=lambda _: torch.zeros(1), prepared=None)
    return SimpleNamespace(model=model, log_likelihood=gain, residual=torch.ones(1), parameters=None)


FRICTION, MASS, DRY, DRAG, OFFSET = term("friction"), term("mass"), term("dry"), term("drag"), term("o", POINTWISE)
TERMS = (FRICTION, MASS, DRY, DRAG, OFFSET)


@pytest.fixture
def judged(monkeypatch):
    """``judged(ranking, fits)``: best and ranking, where joint fits of rivals come out so."""

    def run(ranking, fits, size=2, known=(), **new):
        asked = []

        def tried(_best, one, _look, _number):
            asked.append(one.key)
            return fits[one.key]

        monkeypatch.setattr(rivals, "_tried", tried)
        monkeypatch.setattr(rivals, "at_once", lambda works, *_: [work() for work in works])
        best = fit_of(FRICTION, 100.0, size)
        scene = SimpleNamespace(base=fit_of(None, 0.0), terms=TERMS, is_nonlinear=lambda term: term.port == BENT)
        found, told = by_joint_fits(
            best, ranking, SimpleNamespace(scene=scene, settings=Settings()), Indifferent(**new), known
        )
        return found.model.terms[-1].key, {TERMS[one.number].key: one.gap for one in told}, asked

    return run


def test_a_rival_that_makes_no_such_trajectory_is_as_far_behind_as_its_fit(judged):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7), Ranked(3, 20.0, 30.0))
    found, gaps, asked = judged(ranking, {"mass": fit_of(MASS, 40.0)})
    assert found == "friction"
    assert gaps == {"friction": 0.0, "drag": 30.0, "mass": 60.0}
    assert list(gaps) == ["friction", "drag", "mass"]
    assert asked == ["mass"]


def test_one_whose_fit_keeps_the_gain_is_not_told_apart(judged):
    _, gaps, _ = judged((Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7)), {"mass": fit_of(MASS, 95.0)})
    assert gaps == {"friction": 0.0, "mass": 0.7}


def test_gaps_are_those_to_the_first_that_is_left(judged):
    ranking = (Ranked(1, 60.0, 0.0), Ranked(0, 52.0, 7.5), Ranked(2, 52.0, 8.0), Ranked(3, 20.0, 40.0))
    found, gaps, asked = judged(ranking, {"mass": fit_of(MASS, -5.0), "dry": fit_of(DRY, 99.0, 2)})
    assert found == "friction"
    assert asked == ["mass", "dry"], "as near as the effect itself is to the first"
    assert gaps == pytest.approx({"friction": 0.0, "dry": 0.5, "drag": 32.5, "mass": 97.5})


@pytest.mark.parametrize(("size", "gain", "found"), [(1, 100.0, "dry"), (1, 99.0, "friction"), (2, 105.0, "friction")])
def test_a_simpler_one_that_is_no_worse_is_taken(judged, size, gain, found):
    assert judged((Ranked(0, 50.0, 0.0), Ranked(2, 50.0, 0.0)), {"dry": fit_of(DRY, gain, size)})[0] == found


def test_where_a_port_is_pointwise_the_search_is_exact(judged):
    _, gaps, asked = judged((Ranked(0, 50.0, 0.0), Ranked(4, 50.0, 0.5)), {})
    assert asked == []
    assert gaps == {"friction": 0.0, "o": 0.5}


def test_what_was_fitted_before_and_keeps_the_gain_is_not_fitted_again(judged):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7))
    _, gaps, asked = judged(ranking, {}, known=[fit_of(MASS, 95.0), fit_of(MASS, 90.0)])
    assert (asked, gaps["mass"]) == ([], 0.7)
    _, gaps, asked = judged(ranking, {"mass": fit_of(MASS, 40.0)}, known=[fit_of(MASS, 30.0)])
    assert (asked, gaps["mass"]) == (["mass"], 60.0)


def test_in_coloured_noise_the_rival_that_leaves_less_that_is_new_is_named(judged):
    """However much likelier the other one is with its noise taken for white."""
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7), Ranked(3, 30.0, 22.0))
    found, gaps, _ = judged(ranking, {"mass": fit_of(MASS, 85.0)}, mass=6.0)
    assert (found, gaps) == ("mass", {"mass": 0.0, "friction": 6.0, "drag": 22.0})


def test_a_few_nats_do_not_change_the_name(judged):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7))
    found, gaps, _ = judged(ranking, {"mass": fit_of(MASS, 85.0)}, mass=4.0)
    assert (found, gaps) == ("friction", {"friction": 0.0, "mass": 0.7})


def test_one_that_leaves_more_is_told_apart(judged):
    ranking = (Ranked(1, 51.0, 0.0), Ranked(0, 50.0, 0.7))
    _, gaps, _ = judged(ranking, {"mass": fit_of(MASS, 100.0)}, friction=9.0)
    assert gaps == {"friction": 0.0, "mass": 9.0}


def test_a_simpler_one_that_leaves_more_is_not_taken(judged):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(2, 50.0, 0.0))
    assert judged(ranking, {"dry": fit_of(DRY, 130.0, 1)}, friction=9.0)[0] == "friction"


def test_what_was_fitted_before_is_compared_though_the_search_has_it_far_behind(judged):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(3, 20.0, 30.0), Ranked(4, 20.0, 30.0))
    known = [fit_of(DRAG, 90.0), fit_of(OFFSET, 90.0)]
    found, gaps, _ = judged(ranking, {}, known=known, drag=7.0, o=50.0)
    assert (found, gaps["o"]) == ("drag", 30.0), "where a port is pointwise the search says it"
