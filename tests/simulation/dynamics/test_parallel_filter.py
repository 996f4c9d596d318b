"""Filters in parallel stretches equal the filter in a single stretch."""

from dataclasses import replace

import numpy as np
import pytest

from mkc_torch.simulation.dynamics import parallel_filter
from mkc_torch.simulation.dynamics.kalman import filtered
from mkc_torch.simulation.dynamics.parallel_filter import filtered_whole
from tests.simulation.dynamics.oscillating import course, disturbed_states, flow, with_residual
from tests.simulation.dynamics.test_kalman import MODELS, TWO_OUTPUTS, batch, model


@pytest.fixture(autouse=True)
def without_machine_code(monkeypatch):
    """Parallel stretches are used without Numba only."""
    monkeypatch.setattr(parallel_filter, "machine_code", lambda _: None)


def recorded(along, outliers=0.05, seed=0):
    """Return a flow with process noise of its speed, outliers, and masked samples."""
    random = np.random.default_rng(seed)
    noise = 0.1 * random.standard_normal(along.new.shape)
    noise[random.random(along.new.shape) < outliers] += 5.0
    along = with_residual(along, disturbed_states(along, course(random, along, 0.3, 2.0)), noise)
    along.counts[random.random(along.new.shape) < 0.1] = 0.0
    return replace(along, shift=0.01 * random.standard_normal(along.shift.shape))


def assert_alike(found, reference):
    for name in ("standard", "log_spread", "prior", "state", "after", "posterior"):
        expected = getattr(reference, name)
        if not expected.size:
            assert not getattr(found, name).size
            continue
        np.testing.assert_allclose(
            getattr(found, name), expected, rtol=1e-6, atol=1e-7 * np.abs(expected).max(initial=0)
        )


@pytest.mark.parametrize("name", [*MODELS, "several"])
@pytest.mark.parametrize(("count", "runs"), [(1500, 1), (457, 3), (301, 1), (20, 80)])
def test_parallel_stretches_equal_a_single_stretch(name, count, runs, monkeypatch):
    models = batch(MODELS["white process"], model(white=4.0)) if name == "several" else MODELS[name]
    along = recorded(flow(count, runs=runs))
    expected = filtered(along.whole, models, keep=True)
    if count * runs > 1200:
        # in stretches, without the fallback to a single stretch
        monkeypatch.setattr(parallel_filter, "filtered", None)
    assert_alike(filtered_whole(along, models, keep=True), expected)


def test_several_outputs_and_an_undisturbed_state(monkeypatch):
    along = recorded(flow(1400, TWO_OUTPUTS))
    # the second state is observed and undisturbed
    transition = along.transition.copy()
    transition[:, 1, 0] = 0.0
    along = replace(along, transition=transition, noise_input=along.noise_input[:, ::-1].copy() * [[1.0], [0.0]])
    models = model(white=2.0, sensor=(0.1, 0.1))
    expected = filtered(along.whole, models, keep=True)
    assert not expected.prior[..., 1, 1].any()
    assert np.abs(expected.state[..., 1]).max() > 0.01
    monkeypatch.setattr(parallel_filter, "filtered", None)
    assert_alike(filtered_whole(along, models, keep=True), expected)


def unobserved_flow(count):
    """Return a flow without unmasked samples; its states never decay."""
    along = recorded(flow(count))
    return replace(along, counts=np.zeros_like(along.counts), transition=along.transition * 0.0 + np.eye(2))


def test_unobserved_states_are_passed_from_stretch_to_stretch(monkeypatch):
    along = unobserved_flow(1400)
    expected = filtered(along.whole, MODELS["white process"], keep=True)
    monkeypatch.setattr(parallel_filter, "filtered", None)
    assert_alike(filtered_whole(along, MODELS["white process"], keep=True), expected)


def test_a_single_stretch_is_the_fallback_without_convergence(monkeypatch):
    along, calls = unobserved_flow(1400), []
    monkeypatch.setattr(parallel_filter, "_MOST_ROUNDS", 1)
    monkeypatch.setattr(
        parallel_filter, "filtered", lambda *args, **kwargs: calls.append(1) or filtered(*args, **kwargs)
    )
    assert_alike(filtered_whole(along, MODELS["white process"]), filtered(along.whole, MODELS["white process"]))
    assert calls == [1]


def test_states_are_empty_unless_kept():
    found = filtered_whole(recorded(flow(1400)), MODELS["white process"])
    assert found.standard.shape == (1400, 1, 1, 1)
    assert not found.prior.size


@pytest.mark.parametrize("name", [*MODELS, "several"])
def test_runs_are_filtered_in_parallel(name, monkeypatch):
    models = batch(MODELS["white process"], model(white=4.0)) if name == "several" else MODELS[name]
    along, cut = recorded(flow(150, runs=4)), 40
    between = ("transition", "noise_input", "shift", "step")
    along = replace(along, shift=np.where(along.step[:, None] > 0, along.shift, 0.0))
    # the first run is shorter
    along = replace(along, **{name: getattr(along, name)[cut:] for name in (*between, "seen", "new", "counts")})
    expected, steps = filtered(along.whole, models, keep=True), []

    def counted(parts, *args, **kwargs):
        steps.append(parts.new.shape[:2])
        return filtered(parts, *args, **kwargs)

    monkeypatch.setattr(parallel_filter, "filtered", counted)
    assert_alike(filtered_whole(along, models, keep=True), expected)
    assert steps == [(150, 4)] or not (models.white.any() or models.place.shape[1])


def test_runs_with_a_shift_between_them_are_not_separated():
    along = recorded(flow(150, runs=3))
    assert along.shift[149].any()
    assert along.step[149] == 0
    assert len(parallel_filter._runs(along)[0]) == 1
