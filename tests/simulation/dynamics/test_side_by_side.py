"""A filter in stretches side by side is the filter in one stretch."""

from dataclasses import replace

import numpy as np
import pytest

from mkc_torch.simulation.dynamics import parallel_filter
from mkc_torch.simulation.dynamics.kalman import filtered
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from tests.simulation.dynamics.oscillating import answering, course, flow, pushed
from tests.simulation.dynamics.test_kalman import BOTH, MODELS, model, together


@pytest.fixture(autouse=True)
def without_machine_code(monkeypatch):
    """Stretches side by side serve where Numba is absent."""
    monkeypatch.setattr(side_by_side, "machine_code", lambda _: None)


def recorded(along, outliers=0.05, seed=0):
    """A flow whose speed was pushed, with outliers among its samples, some of which do not count."""
    random = np.random.default_rng(seed)
    noise = 0.1 * random.standard_normal(along.new.shape)
    noise[random.random(along.new.shape) < outliers] += 5.0
    along = answering(along, pushed(along, course(random, along, 0.3, 2.0)), noise)
    along.counts[random.random(along.new.shape) < 0.1] = 0.0
    return replace(along, shift=0.01 * random.standard_normal(along.shift.shape))


def alike(one, other):
    for name in ("standard", "log_spread", "prior", "state", "after", "posterior"):
        expected = getattr(other, name)
        if not expected.size:
            assert not getattr(one, name).size
            continue
        np.testing.assert_allclose(getattr(one, name), expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max(initial=0))


@pytest.mark.parametrize("name", [*MODELS, "several"])
@pytest.mark.parametrize(("count", "runs"), [(1500, 1), (457, 3), (301, 1), (20, 80)])
def test_it_is_the_filter_in_one_stretch(name, count, runs, monkeypatch):
    models = together(MODELS["white push"], model(white=4.0)) if name == "several" else MODELS[name]
    along = recorded(flow(count, runs=runs))
    expected = filtered(along.whole, models, keep=True)
    if count * runs > 1200:
        # in stretches, not by falling back to one
        monkeypatch.setattr(side_by_side, "filtered", None)
    alike(filtered_whole(along, models, keep=True), expected)


def test_several_outputs_and_a_state_that_no_push_reaches(monkeypatch):
    along = recorded(flow(1400, BOTH))
    # the second state moves by itself, seen and never pushed
    carried = along.carried.copy()
    carried[:, 1, 0] = 0.0
    along = replace(along, carried=carried, pushed=along.pushed[:, ::-1].copy() * [[1.0], [0.0]])
    models = model(white=2.0, sensor=(0.1, 0.1))
    expected = filtered(along.whole, models, keep=True)
    assert not expected.prior[..., 1, 1].any()
    assert np.abs(expected.state[..., 1]).max() > 0.01
    monkeypatch.setattr(side_by_side, "filtered", None)
    alike(filtered_whole(along, models, keep=True), expected)


def unseen(count):
    """A flow of which nothing is seen: what a push does to its states lasts for ever."""
    along = recorded(flow(count))
    return replace(along, counts=np.zeros_like(along.counts), carried=along.carried * 0.0 + np.eye(2))


def test_what_is_never_forgotten_is_passed_on(monkeypatch):
    along = unseen(1400)
    expected = filtered(along.whole, MODELS["white push"], keep=True)
    monkeypatch.setattr(side_by_side, "filtered", None)
    alike(filtered_whole(along, MODELS["white push"], keep=True), expected)


def test_it_is_run_in_one_stretch_where_the_beginnings_are_not_found(monkeypatch):
    along, calls = unseen(1400), []
    monkeypatch.setattr(side_by_side, "_ROUNDS", 1)
    monkeypatch.setattr(side_by_side, "filtered", lambda *args, **kwargs: calls.append(1) or filtered(*args, **kwargs))
    alike(filtered_whole(along, MODELS["white push"]), filtered(along.whole, MODELS["white push"]))
    assert calls == [1]


def test_what_is_not_kept_is_not_there():
    found = filtered_whole(recorded(flow(1400)), MODELS["white push"])
    assert found.standard.shape == (1400, 1, 1, 1)
    assert not found.prior.size


@pytest.mark.parametrize("name", [*MODELS, "several"])
def test_runs_are_filtered_side_by_side(name, monkeypatch):
    models = together(MODELS["white push"], model(white=4.0)) if name == "several" else MODELS[name]
    along, cut = recorded(flow(150, runs=4)), 40
    between = ("carried", "pushed", "shift", "step")
    along = replace(along, shift=np.where(along.step[:, None] > 0, along.shift, 0.0))
    # the first one is shorter
    along = replace(along, **{one: getattr(along, one)[cut:] for one in (*between, "seen", "new", "counts")})
    expected, steps = filtered(along.whole, models, keep=True), []

    def counted(parts, *args, **kwargs):
        steps.append(parts.new.shape[:2])
        return filtered(parts, *args, **kwargs)

    monkeypatch.setattr(side_by_side, "filtered", counted)
    alike(filtered_whole(along, models, keep=True), expected)
    assert steps == [(150, 4)] or not (models.white.any() or models.place.shape[1])


def test_runs_that_hang_together_are_not_taken_apart():
    along = recorded(flow(150, runs=3))
    assert along.shift[149].any()
    assert along.step[149] == 0
    assert len(parallel_filter._runs(along)[0]) == 1
