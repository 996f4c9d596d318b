"""Restricted log-likelihoods with and without candidates, compared with explicit regressions."""

from dataclasses import replace

import numpy as np
import pytest

from mkc_torch.diagnosis.search import likelihoods
from mkc_torch.diagnosis.search.likelihoods import PRICE, Columns, Limits, log_likelihoods
from mkc_torch.simulation.dynamics import whitening
from mkc_torch.simulation.dynamics.noise_model import NoiseModel
from mkc_torch.simulation.dynamics.whitening import SeriesAlong
from tests.simulation.dynamics.test_whitening import oscillator

WHITE = NoiseModel((0.5,), (), (False,))


def series(values):
    return SeriesAlong(values[:, None, :], np.zeros((len(values) - 1, 2, values.shape[1])))


def scene(sizes=(1, 2), one_sided=(False, False), seed=0):
    random = np.random.default_rng(seed)
    flow = oscillator(N=80, seed=seed)
    own, candidates = random.normal(size=(80, 2)), random.normal(size=(80, sum(sizes)))
    y = random.normal(size=(80, 3))
    return flow, y, own, candidates, Columns(series(np.concatenate([own, candidates], 1)), 2, sizes, one_sided)


def test_log_likelihoods_in_white_noise_equal_restricted_least_squares():
    flow, y, own, candidates, columns = scene()
    found = log_likelihoods(flow, [WHITE], series(y), columns)
    used = flow.counts[:, 0] > 0
    n = used.sum() - 2

    def left(columns):
        solved = np.linalg.lstsq(columns[used], y[used], rcond=None)[0]
        return np.square(y[used] - columns[used] @ solved).sum(0) / 0.25

    level = -used.sum() * np.log(0.5) - 0.5 * np.linalg.slogdet(own[used].T @ own[used] / 0.25)[1]
    np.testing.assert_allclose(found.without[0], level - 0.5 * n * np.log(left(own) / n))
    for number, place in enumerate((slice(0, 1), slice(1, 3))):
        both = np.concatenate([own, candidates[:, place]], 1)
        np.testing.assert_allclose(found.with_candidate[0, number], level - 0.5 * n * np.log(left(both) / n))
    np.testing.assert_array_equal(found.rank, [1, 2])


def test_sizes_are_minus_the_slopes_of_the_first_series():
    flow, y, own, candidates, columns = scene()
    used = flow.counts[:, 0] > 0
    both = np.concatenate([own, candidates[:, 1:]], 1)[used]
    solved = np.linalg.lstsq(both, y[used, 0], rcond=None)[0]
    found = log_likelihoods(flow, [WHITE], series(y), columns)
    np.testing.assert_allclose(found.sizes[0, 1:], -solved[2:])


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_one_sided_candidate_gains_only_with_its_sign(sign):
    flow, _, own, candidates, columns = scene(sizes=(1,), one_sided=(True,))
    y = sign * 5.0 * candidates[:, :1] + 0.1 * own[:, :1]
    found = log_likelihoods(flow, [WHITE], series(y), columns)
    gain = found.with_candidate[0, 0, 0] - found.without[0, 0]
    assert (gain > 10.0) == (sign < 0)
    assert sign < 0 or gain == 0.0


def test_blocks_of_samples_and_of_models_change_nothing(monkeypatch):
    disturbed = NoiseModel((0.5,), ((0, 0.7, 1.0),), (False,))
    flow, y, _, _, columns = scene(sizes=(1, 3, 1, 2), one_sided=(False, False, True, False))
    whole = log_likelihoods(flow, [WHITE, disturbed], series(y), columns)
    monkeypatch.setattr(likelihoods, "CELLS", 1)  # the smallest block, 16 samples
    monkeypatch.setattr(likelihoods, "COVARIANCES", 1)  # one model per block
    blocks = log_likelihoods(flow, [WHITE, disturbed], series(y), columns)
    for name in ("without", "with_candidate", "sizes", "rank", "scale"):
        np.testing.assert_allclose(getattr(blocks, name), getattr(whole, name), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("compiled", [True, False])
def test_known_products_of_the_tangents_change_nothing(compiled, monkeypatch):
    disturbed = NoiseModel((0.5,), ((0, 0.7, 1.0), (1, 0.3, 2.0)), (False,))
    flow, y, _, _, columns = scene(sizes=(1, 3, 1, 2), one_sided=(False, False, True, False))
    random = np.random.default_rng(5)
    columns = replace(columns, series=replace(columns.series, shift=0.1 * random.normal(size=(79, 2, 9))))
    models = [WHITE, disturbed]
    first = log_likelihoods(flow, models, series(y[:, :1]), columns)
    whole = log_likelihoods(flow, models, series(y), columns)
    if compiled:  # then no tangent is whitened again
        monkeypatch.setattr(likelihoods, "products_of", None)
    else:
        monkeypatch.setattr(whitening, "machine_code", lambda _: None)
    again = log_likelihoods(flow, models, series(y), columns, known=first.products)
    for name in ("without", "with_candidate", "sizes", "rank", "scale"):
        np.testing.assert_allclose(getattr(again, name), getattr(whole, name), rtol=1e-9, atol=1e-11)


def test_models_far_behind_without_and_with_every_candidate_are_left_out():
    flow, y, _, _, columns = scene()
    models = [WHITE, *(NoiseModel((0.5,), ((0, size, 1.0),), (False,)) for size in (0.5, 500.0))]
    found = log_likelihoods(flow, models, series(y), columns)
    values = np.concatenate([found.without[:, None], found.with_candidate], 1)
    gap = (values.max(0) - values).min((1, 2))
    assert gap[2] > gap[1] > 0.0 == gap[0]
    between = 0.5 * (gap[1] + gap[2])
    left = found.near_the_best(between)
    assert left.models == tuple(models[:2])
    for name in ("without", "with_candidate", "sizes", "scale"):
        np.testing.assert_array_equal(getattr(left, name), getattr(found, name)[:2])
    np.testing.assert_array_equal(left.rank, found.rank)
    assert len(found.near_the_best(gap[2] + 1.0).models) == 3
    # a candidate under which a model is best keeps the model
    better = found.with_candidate.copy()
    better[2, 1, 2] = better[:, 1, 2].max() + 1.0
    assert replace(found, with_candidate=better).near_the_best(0.0).models == (models[0], models[2])


def test_a_candidate_with_zero_tangents_gains_nothing():
    flow, y, own, candidates, _ = scene()
    columns = Columns(series(np.concatenate([own, 0.0 * candidates], 1)), 2, (1, 2), (False, False))
    found = log_likelihoods(flow, [WHITE], series(y), columns)
    np.testing.assert_array_equal(found.rank, [0, 0])
    np.testing.assert_allclose(found.with_candidate[0], found.without[0][None].repeat(2, 0))


def test_each_disturbance_has_its_penalty():
    flow, y, _, _, columns = scene()
    # a disturbance of size 0 changes only the penalty
    idle = NoiseModel((0.5,), ((1, 1e-200, 1.0),), (False,))
    found = log_likelihoods(flow, [WHITE, idle], series(y), columns)
    np.testing.assert_allclose(found.without[0] - found.without[1], PRICE)


def test_a_declared_noise_has_no_free_scale():
    flow, y, _, _, columns = scene()
    declared = NoiseModel((0.5,), (), (True,))
    original = log_likelihoods(flow, [declared], series(y), columns).without
    doubled = log_likelihoods(flow, [declared], series(2.0 * y), columns).without
    free = log_likelihoods(flow, [WHITE], series(y), columns).without
    assert ((original - doubled) > 20.0).all()
    assert (free > original).all()


def test_the_floor_of_the_noise_model_limits_the_scale():
    flow, y, _, _, columns = scene()
    free = log_likelihoods(flow, [WHITE], series(y), columns)
    held = log_likelihoods(flow, [replace(WHITE, floor=(2.0,))], series(y), columns)
    assert free.scale.max() < 4.0
    np.testing.assert_array_equal(held.scale, np.full_like(held.scale, 4.0))
    assert (held.without < free.without).all()
    loose = log_likelihoods(flow, [replace(WHITE, floor=(1e-6,))], series(y), columns)
    np.testing.assert_array_equal(loose.without, free.without)


def test_limits_are_priors_in_the_noise_of_the_first_series():
    flow, y, own, candidates, columns = scene(sizes=(1,))
    used = flow.counts[:, 0] > 0
    limits = Limits.of(np.array([0.9, 3.0]), np.array([0.5, 0.0]), np.array([12.0, 0.0]))
    found = log_likelihoods(flow, [WHITE], series(y), replace(columns, limits=limits))
    alone = own[used] @ np.linalg.lstsq(own[used], y[used, 0], rcond=None)[0]
    prior = np.sqrt(np.square(y[used, 0] - alone).sum() / (used.sum() - 2) * 12.0)

    def power(columns):
        pulled = np.zeros((1, columns.shape[1]))
        pulled[0, 0] = prior
        rows = np.concatenate([columns[used], pulled])
        values = np.concatenate([y[used], np.full((1, 3), 0.4 * prior)])
        return np.square(values - rows @ np.linalg.lstsq(rows, values, rcond=None)[0]).sum(0)

    n = used.sum() + 1 - 2
    gain = found.with_candidate[0, 0] - found.without[0]
    np.testing.assert_allclose(gain, 0.5 * n * np.log(power(own) / power(np.concatenate([own, candidates], 1))))
