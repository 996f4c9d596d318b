"""The benchmark of model selection: its criterion, the results of its peers, and the search."""

import importlib
import math
from pathlib import Path

import pytest
import torch

pytest.importorskip("petab_select", reason="petab-select is not installed")

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "concealed_physics" / "histone"


@pytest.fixture
def load_module(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


@pytest.fixture
def calibration(load_module):
    logs = load_module("acetylation").measured(FOLDER / "data" / "measurements.tsv")
    return load_module("calibration").Calibration(logs)


def test_the_published_model_has_the_published_criterion_and_rates(load_module, calibration):
    best, criterion = load_module("petab_select_0009").published()
    direct, effects = calibration.fitted([best])[best], calibration.by_effects(best)
    assert direct.aicc == pytest.approx(criterion, abs=1e-6)
    assert effects.aicc == pytest.approx(criterion, abs=1e-6)
    number = load_module("acetylation").REACTIONS.index("a_k08k12k16_4ac")
    assert math.exp(direct.parameters[number]) == pytest.approx(53.80, abs=0.01)
    assert math.exp(effects.parameters[-1]) == pytest.approx(0.06676, abs=1e-5)


def test_slopes_of_the_steady_state_agree_with_autograd(load_module):
    module = load_module("acetylation")
    rates = torch.randn(32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    logs, slopes = module.with_slopes(rates)
    torch.testing.assert_close(logs, module.steady_state(rates).log())
    torch.testing.assert_close(slopes, torch.func.jacrev(lambda r: module.steady_state(r).log())(rates))


def test_stepwise_selection_ends_at_the_criteria_of_the_peers(load_module, calibration):
    search = load_module("selection").Search
    forward, backward = search(calibration, frozenset()), search(calibration, frozenset(range(32)))
    ends = forward.fits[forward.step(True, False)], backward.fits[backward.step(False, True)]
    assert [round(end.aicc, 2) for end in ends] == [-1704.70, -1707.51]


@pytest.mark.slow
def test_the_search_reaches_the_published_optimum(load_module, calibration):
    best, criterion = load_module("petab_select_0009").published()
    found = load_module("selection").Search(calibration, frozenset()).best_first()
    assert found.best == best
    assert found.good[best].aicc == pytest.approx(criterion, abs=1e-6)
    assert all(fit.aicc < criterion + 2.0 for fit in found.good.values())


def test_good_models_of_several_searches_are_counted_once(load_module):
    fit, found = load_module("calibration").Fit, load_module("selection").Found
    a, b, c = frozenset({0, 1}), frozenset({1}), frozenset({2})
    first = found(fit(0.0, {}), a, {a: fit(-5.0, {}), b: fit(-4.0, {})}, 9, 2)
    other = found(fit(0.0, {}), b, {b: fit(-4.5, {}), c: fit(-2.5, {})}, 9, 2)
    module = load_module("petab_select_0009")
    good = module.pooled([first, other])
    assert {selection: fit.aicc for selection, fit in good.items()} == {a: -5.0, b: -4.5}
    assert module.shares(good) == [(module.REACTIONS[1], 1.0), (module.REACTIONS[0], 0.5)]


@pytest.mark.e2e
def test_the_diagnosis_claims_the_rate_common_to_all_good_models(load_module):
    logs = load_module("acetylation").measured(FOLDER / "data" / "measurements.tsv")
    assert load_module("petab_select_0009").claimed(logs) == {"a_k05_k05k12": pytest.approx(27.8, abs=0.5)}
