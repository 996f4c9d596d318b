"""The p-value of a search: a shape that was closed in on has no advantage over the draws that it is judged against."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mkc_torch.diagnosis.linearised.linear_search import SearchGains, log_survival
from mkc_torch.diagnosis.search import p_value as judge
from mkc_torch.diagnosis.search.p_value import best_rank_p_value
from mkc_torch.diagnosis.settings import NoiseSettings

DRAWS = 99
DOF = torch.tensor([3.0, 3.0]).double()


def gains(ratio):
    ratio = torch.as_tensor(ratio, dtype=torch.float64)
    return SearchGains(ratio, log_survival(ratio, DOF.unsqueeze(-1)), DOF)


@pytest.fixture(autouse=True)
def alike(monkeypatch):
    """Noise of its own colour tells no series from another."""
    monkeypatch.setattr(judge, "own_colour_gains", lambda _linearised, series, _possible: torch.zeros(series.shape[1]))


def judged(own, tried, possible=None, *, gain=0.0, wandering=None):
    drawn = torch.distributions.Chi2(torch.tensor(3.0).double())
    torch.manual_seed(0)
    noise = drawn.sample((2, DRAWS))
    search = SimpleNamespace(
        white=lambda count, _: torch.zeros(1, count),
        drift=lambda count, _noise, _generator: torch.ones(1, count),
        gains=lambda series: gains(noise if wandering is None or not bool(series.any()) else wandering),
    )
    linearised = SimpleNamespace(entering=lambda _count, _generator: None, search=search, series=torch.zeros(1))
    possible = torch.ones(tried, dtype=torch.bool) if possible is None else torch.tensor(possible)
    return judge.surrogate_p_value(
        linearised, SimpleNamespace(gain=gain), gains([[own[0]], [own[1]]]), possible, DRAWS, None, NoiseSettings()
    )


def test_what_exceeds_all_draws_has_the_smallest_p_value_and_says_by_how_much():
    p_value, beyond = judged((100.0, 1.0), tried=2)
    assert p_value == pytest.approx(1.0 / (1 + DRAWS))
    assert beyond > 10.0


def test_an_amplitude_of_an_impossible_sign_does_not_count():
    assert judged((100.0, 1.0), 2, possible=(False, True))[0] > 0.3
    assert judged((100.0, 1.0), 2, possible=(False, False))[0] == 1.0


def test_a_wander_is_drawn_where_it_is_more_than_chance():
    """Half of all white noise fits one; draws with it would be harder to exceed."""
    wandering = torch.full((2, DRAWS), 50.0, dtype=torch.float64)
    without, _ = judged((20.0, 1.0), 2, gain=1.0, wandering=wandering)
    assert without == pytest.approx(1.0 / (1 + DRAWS))
    assert judged((20.0, 1.0), 2, gain=5.0, wandering=wandering)[0] > 0.3


def test_a_shape_closed_in_on_is_left_out():
    with_it, _ = judged((1.0, 100.0), tried=2)
    without, beyond = judged((1.0, 100.0), tried=1)
    assert with_it == pytest.approx(1.0 / (1 + DRAWS))
    assert without > 0.3
    assert beyond < 0.0
    assert math.isfinite(beyond)


def test_what_stands_out_by_its_own_colour_is_seen_where_the_search_sees_nothing(monkeypatch):
    asked = []

    def gains_of(_linearised, series, possible):
        asked.append(possible.tolist())
        return torch.linspace(1.0, 0.0, series.shape[1])

    monkeypatch.setattr(judge, "own_colour_gains", gains_of)
    assert judged((1.0, 1.0), 1)[0] <= 0.02
    assert asked == [[True, False]], "a shape that was closed in on has no say here either"
    assert judged((100.0, 1.0), 2)[0] == pytest.approx(1.0 / (1 + DRAWS))
    assert len(asked) == 1


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(5, 60), st.floats(-1.0, 1.0), st.booleans())
def test_either_statistic_may_speak_and_the_p_value_keeps_its_level(seed, count, common, ties):
    both = torch.randn(2, count, generator=torch.Generator().manual_seed(seed))
    both[1] += 3.0 * common * both[0]
    both = both.round() if ties else both
    p_values = torch.tensor([best_rank_p_value(*both.roll(-place, -1)) for place in range(count)])
    for level in p_values.unique().tolist():
        assert float((p_values <= level).double().mean()) <= level + 1e-6
