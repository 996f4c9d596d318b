"""The surrogate p-value of a search: refined shapes have no advantage over the surrogates."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.diagnosis.search import significance as module
from mkc_torch.diagnosis.search.linear_search import SearchGains, log_survival
from mkc_torch.diagnosis.search.significance import best_rank_p_value
from mkc_torch.diagnosis.settings import NoiseSettings

DRAWS = 99
DOF = torch.tensor([3.0, 3.0]).double()


def gains(ratio):
    ratio = torch.as_tensor(ratio, dtype=torch.float64)
    return SearchGains(ratio, log_survival(ratio, DOF.unsqueeze(-1)), DOF)


@pytest.fixture(autouse=True)
def _zero_own_spectrum_gains(monkeypatch):
    """Replace the own-spectrum gains by zeros."""
    monkeypatch.setattr(module, "own_spectrum_gains", lambda _search, series, _possible: torch.zeros(series.shape[1]))


def p_value_of(own, tried, possible=None, *, gain=0.0, drifting=None):
    drawn = torch.distributions.Chi2(torch.tensor(3.0).double())
    torch.manual_seed(0)
    noise = drawn.sample((2, DRAWS))
    search = SimpleNamespace(
        white=lambda count, _: torch.zeros(1, count),
        drift=lambda count, _noise, _generator: torch.ones(1, count),
        gains=lambda series: gains(noise if drifting is None or not bool(series.any()) else drifting),
    )
    linearised = SimpleNamespace(entering=lambda _count, _generator: None, search=search, series=torch.zeros(1))
    possible = torch.ones(tried, dtype=torch.bool) if possible is None else torch.tensor(possible)
    return module.surrogate_p_value(
        linearised, SimpleNamespace(gain=gain), gains([[own[0]], [own[1]]]), possible, DRAWS, None, NoiseSettings()
    )


def test_a_gain_beyond_all_surrogates_has_the_smallest_p_value():
    p_value, beyond = p_value_of((100.0, 1.0), tried=2)
    assert p_value == pytest.approx(1.0 / (1 + DRAWS))
    assert beyond > 10.0


def test_a_size_of_an_impossible_sign_does_not_count():
    assert p_value_of((100.0, 1.0), 2, possible=(False, True))[0] > 0.3
    assert p_value_of((100.0, 1.0), 2, possible=(False, False))[0] == 1.0


def test_a_drift_is_drawn_only_if_it_gains_clearly():
    """Half of all white noise fits a small drift, and surrogates with it would be harder to exceed."""
    drifting = torch.full((2, DRAWS), 50.0, dtype=torch.float64)
    without, _ = p_value_of((20.0, 1.0), 2, gain=1.0, drifting=drifting)
    assert without == pytest.approx(1.0 / (1 + DRAWS))
    assert p_value_of((20.0, 1.0), 2, gain=5.0, drifting=drifting)[0] > 0.3


def test_refined_shapes_do_not_enter_the_p_value():
    with_it, _ = p_value_of((1.0, 100.0), tried=2)
    without, beyond = p_value_of((1.0, 100.0), tried=1)
    assert with_it == pytest.approx(1.0 / (1 + DRAWS))
    assert without > 0.3
    assert beyond < 0.0
    assert math.isfinite(beyond)


def test_own_spectrum_gains_can_lower_the_p_value(monkeypatch):
    masks = []

    def gains_of(_linearised, series, possible):
        masks.append(possible.tolist())
        return torch.linspace(1.0, 0.0, series.shape[1])

    monkeypatch.setattr(module, "own_spectrum_gains", gains_of)
    assert p_value_of((1.0, 1.0), 1)[0] <= 0.02
    assert masks == [[True, False]], "refined shapes are left out here too"
    assert p_value_of((100.0, 1.0), 2)[0] == pytest.approx(1.0 / (1 + DRAWS))
    assert len(masks) == 1


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(5, 60), st.floats(-1.0, 1.0), st.booleans())
def test_the_better_of_two_ranks_keeps_the_level(seed, count, common, ties):
    both = torch.randn(2, count, generator=torch.Generator().manual_seed(seed))
    both[1] += 3.0 * common * both[0]
    both = both.round() if ties else both
    p_values = torch.tensor([best_rank_p_value(*both.roll(-place, -1)) for place in range(count)])
    for level in p_values.unique().tolist():
        assert float((p_values <= level).double().mean()) <= level + 1e-6
