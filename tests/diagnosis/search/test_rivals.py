"""Rivals that act through a trajectory are fitted before they are reported as inseparable."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.search import joint_refits
from mkc_torch.diagnosis.search.joint_refits import by_joint_fits
from mkc_torch.diagnosis.search.ranking import ModelPrior, Ranked
from mkc_torch.diagnosis.settings import Settings

NONLINEAR, POINTWISE = "rate", "sensor"


class PriorWithoutPenalties(ModelPrior):
    """No penalties; ``new`` are the gains of fits in coloured noise, by key."""

    def __init__(self, **new):
        self.new = new

    def penalty(self, _term, _gain):
        return 0.0

    def by_innovations(self, first, other, _price=1.0):
        return self.new.get(other.model.terms[-1].key, 0.0) - self.new.get(first.model.terms[-1].key, 0.0)


def term(key, port=NONLINEAR):
    return SimpleNamespace(key=key, port=port)


def fit_of(own, gain, size=1):
    """Return a fit with this gain over the fit without an effect."""
    model = SimpleNamespace(terms=[own], sizes=[size], residual=lambda _: torch.zeros(1), prepared=None)
    return SimpleNamespace(model=model, log_likelihood=gain, residual=torch.ones(1), parameters=None)


FRICTION, MASS, DRY, DRAG, OFFSET = term("friction"), term("mass"), term("dry"), term("drag"), term("o", POINTWISE)
TERMS = (FRICTION, MASS, DRY, DRAG, OFFSET)


@pytest.fixture
def rank(monkeypatch):
    """Return ``judged(ranking, fits)``: the best key, the gaps and the fitted keys, for given joint fits of rivals."""

    def run(ranking, fits, size=2, known=(), **new):
        fitted_keys = []

        def tried(_best, term, _look, _number):
            fitted_keys.append(term.key)
            return fits[term.key]

        monkeypatch.setattr(joint_refits, "refitted_rival", tried)
        monkeypatch.setattr(joint_refits, "run_parallel", lambda works, *_: [work() for work in works])
        best = fit_of(FRICTION, 100.0, size)
        scene = SimpleNamespace(
            base=fit_of(None, 0.0),
            around=SimpleNamespace(model=SimpleNamespace(terms=())),
            terms=TERMS,
            is_nonlinear=lambda term: term.port == NONLINEAR,
        )
        found, new_ranking = by_joint_fits(
            best, ranking, SimpleNamespace(scene=scene, settings=Settings()), PriorWithoutPenalties(**new), known
        )
        return found.model.terms[-1].key, {TERMS[rival.number].key: rival.gap for rival in new_ranking}, fitted_keys

    return run


def test_a_rival_that_loses_its_gain_is_moved_back(rank):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7), Ranked(3, 20.0, 30.0))
    found, gaps, fitted_keys = rank(ranking, {"mass": fit_of(MASS, 40.0)})
    assert found == "friction"
    assert gaps == {"friction": 0.0, "drag": 30.0, "mass": 60.0}
    assert list(gaps) == ["friction", "drag", "mass"]
    assert fitted_keys == ["mass"]


def test_a_rival_that_keeps_its_gain_stays_inseparable(rank):
    _, gaps, _ = rank((Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7)), {"mass": fit_of(MASS, 95.0)})
    assert gaps == {"friction": 0.0, "mass": 0.7}


def test_gaps_are_relative_to_the_best_remaining_rival(rank):
    ranking = (Ranked(1, 60.0, 0.0), Ranked(0, 52.0, 7.5), Ranked(2, 52.0, 8.0), Ranked(3, 20.0, 40.0))
    found, gaps, fitted_keys = rank(ranking, {"mass": fit_of(MASS, -5.0), "dry": fit_of(DRY, 99.0, 2)})
    assert found == "friction"
    assert fitted_keys == ["mass", "dry"], "rivals as near as the effect are fitted"
    assert gaps == pytest.approx({"friction": 0.0, "dry": 0.5, "drag": 32.5, "mass": 97.5})


@pytest.mark.parametrize(("size", "gain", "found"), [(1, 100.0, "dry"), (1, 99.0, "friction"), (2, 105.0, "friction")])
def test_an_equally_likely_simpler_rival_is_named(rank, size, gain, found):
    assert rank((Ranked(0, 50.0, 0.0), Ranked(2, 50.0, 0.0)), {"dry": fit_of(DRY, gain, size)})[0] == found


def test_rivals_at_pointwise_ports_are_not_fitted(rank):
    _, gaps, fitted_keys = rank((Ranked(0, 50.0, 0.0), Ranked(4, 50.0, 0.5)), {})
    assert fitted_keys == []
    assert gaps == {"friction": 0.0, "o": 0.5}


def test_known_fits_that_keep_the_gain_are_not_repeated(rank):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7))
    _, gaps, fitted_keys = rank(ranking, {}, known=[fit_of(MASS, 95.0), fit_of(MASS, 90.0)])
    assert (fitted_keys, gaps["mass"]) == ([], 0.7)
    _, gaps, fitted_keys = rank(ranking, {"mass": fit_of(MASS, 40.0)}, known=[fit_of(MASS, 30.0)])
    assert (fitted_keys, gaps["mass"]) == (["mass"], 60.0)


def test_a_rival_with_better_innovations_is_named(rank):
    """Whatever the gain of the other fit in white noise."""
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7), Ranked(3, 30.0, 22.0))
    found, gaps, _ = rank(ranking, {"mass": fit_of(MASS, 85.0)}, mass=6.0)
    assert (found, gaps) == ("mass", {"mass": 0.0, "friction": 6.0, "drag": 22.0})


def test_a_lead_of_few_nats_in_innovations_does_not_change_the_name(rank):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(1, 49.0, 0.7))
    found, gaps, _ = rank(ranking, {"mass": fit_of(MASS, 85.0)}, mass=4.0)
    assert (found, gaps) == ("friction", {"friction": 0.0, "mass": 0.7})


def test_a_rival_with_worse_innovations_is_separable(rank):
    ranking = (Ranked(1, 51.0, 0.0), Ranked(0, 50.0, 0.7))
    _, gaps, _ = rank(ranking, {"mass": fit_of(MASS, 100.0)}, friction=9.0)
    assert gaps == {"friction": 0.0, "mass": 9.0}


def test_a_simpler_rival_with_worse_innovations_is_not_named(rank):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(2, 50.0, 0.0))
    assert rank(ranking, {"dry": fit_of(DRY, 130.0, 1)}, friction=9.0)[0] == "friction"


def test_known_fits_are_compared_even_far_behind_in_the_search(rank):
    ranking = (Ranked(0, 50.0, 0.0), Ranked(3, 20.0, 30.0), Ranked(4, 20.0, 30.0))
    known = [fit_of(DRAG, 90.0), fit_of(OFFSET, 90.0)]
    found, gaps, _ = rank(ranking, {}, known=known, drag=7.0, o=50.0)
    assert (found, gaps["o"]) == ("drag", 30.0), "at a pointwise port the linear search decides"


@pytest.mark.parametrize(("port", "follows", "expected"), [("y", True, True), ("x", True, False), ("y", False, False)])
def test_an_effect_is_in_series_if_the_last_effect_changes_the_signal_that_it_depends_on(port, follows, expected):
    def placed(port, follows):
        return SimpleNamespace(port=port, effect=SimpleNamespace(follows_signal=follows))

    prepared = SimpleNamespace(ports={name: SimpleNamespace(in_series=lambda _: True) for name in "xy"})
    model = SimpleNamespace(terms=(placed("y", True),), prepared=prepared)
    assert joint_refits._in_series(placed(port, follows), model) is expected
    assert not joint_refits._in_series(placed(port, follows), SimpleNamespace(terms=(), prepared=prepared))
