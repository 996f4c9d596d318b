"""A drift replaces an effect of a column with uninformative timing if it is nearly as likely."""

import dataclasses
import types
from typing import Any

import pytest

from mkc_torch.diagnosis.pipeline import simpler_form as doubted_driver
from mkc_torch.diagnosis.pipeline.simpler_form import TIME_REACH, with_driver_or_time
from mkc_torch.diagnosis.result import DriverShift
from mkc_torch.diagnosis.search.ranking import Ranked
from mkc_torch.diagnosis.settings import Settings
from mkc_torch.nonlinear import NoFitError

SETTINGS = Settings()
NEAR, FAR = 0.9 * TIME_REACH * SETTINGS.naming.separable, 1.1 * TIME_REACH * SETTINGS.naming.separable
DOUBTED, TIMED = DriverShift(38, 7, 22.5), DriverShift(38, 2, 22.5)


def term(name, *, driver=None, curve=False, port="offset"):
    effect = types.SimpleNamespace(id=name, is_curve=curve)
    return types.SimpleNamespace(effect=effect, driver=driver, port=port)


def fit(of):
    return types.SimpleNamespace(model=types.SimpleNamespace(terms=[of]))


@dataclasses.dataclass(frozen=True)
class SearchResultStub:
    """The attributes of a search result that are used."""

    term: Any
    fit: Any
    ranking: Any
    scene: Any
    look: Any = None


def selected(rival, gap, monkeypatch, *, shift=DOUBTED, refit=lambda _, of, *__: fit(of)):
    """Return the selection between a leading effect of temperature and a rival."""
    warmed = term("temperature_offset", driver="temperature")
    monkeypatch.setattr(doubted_driver, "shifted", lambda *_: shift)
    monkeypatch.setattr(doubted_driver, "refitted", refit)
    ranking = (Ranked(0, 90.0, 0.0), Ranked(1, 80.0, gap))
    found = SearchResultStub(warmed, fit(warmed), ranking, types.SimpleNamespace(terms=[warmed, rival]))
    return with_driver_or_time(types.SimpleNamespace(model=None), found, SETTINGS)


def test_a_drift_replaces_a_column_whose_shifted_copies_gain_as_much(monkeypatch):
    found = selected(term("offset_drift"), NEAR, monkeypatch)
    assert found.term.effect.id == found.fit.model.terms[-1].effect.id == "offset_drift"
    # the column's effect stays an alternative that the recording does not distinguish
    assert [(rival.number, rival.gap) for rival in found.ranking] == [(1, 0.0), (0, 0.0)]


@pytest.mark.parametrize("shift", [TIMED, None], ids=["timed", "not shifted"])
def test_a_column_with_informative_timing_stays_first(shift, monkeypatch):
    assert selected(term("offset_drift"), NEAR, monkeypatch, shift=shift).term.effect.id == "temperature_offset"


@pytest.mark.parametrize(
    ("rival", "gap"),
    [
        (term("offset_drift"), FAR),
        (term("driver_offset", driver="aux_1"), NEAR),
        (term("unknown", curve=True), NEAR),
        (term("gain_drift", port="gain"), NEAR),
    ],
    ids=["far behind", "another column", "a curve", "another port"],
)
def test_a_rival_that_is_distant_or_not_a_drift_does_not_replace_the_column(rival, gap, monkeypatch):
    assert selected(rival, gap, monkeypatch).term.effect.id == "temperature_offset"


def test_a_drift_without_a_fit_changes_nothing(monkeypatch):
    def failing(*_):
        raise NoFitError("no finite trajectory")

    assert selected(term("offset_drift"), NEAR, monkeypatch, refit=failing).term.effect.id == "temperature_offset"
