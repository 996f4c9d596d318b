"""Residuals are judged by their distance from the wander: bursts are rejected, excursions of the wander are not."""

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.linearise import linearise, tangents_of
from mkc_torch.diagnosis.local import _out_of_bursts, beside_wander
from mkc_torch.diagnosis.model import JointModel
from mkc_torch.diagnosis.refit import fitted
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line
from tests.simulation.tumbling import tumbling

N = 2000
BURSTS = [(300, 12), (900, 15), (1500, 10)]


def walk(steps, seed=5):
    """A random walk on each axis, less its mean, in µT."""
    course = np.cumsum(np.random.default_rng(seed).standard_normal((N, 3)), 0) * np.asarray(steps)
    return course - course.mean(0)


def local_of(sensor, use, noise=0.3):
    prepared = Magnetometer(use).prepare(tumbling(N, noise=noise, sensor=sensor, attitude=True, gyro=True))
    model = JointModel(prepared)
    fit = fitted(model, prepared.start())
    tangents = tangents_of(model, fit.parameters)
    return fit, tangents, beside_wander(fit, model, fit.parameters, tangents)


@pytest.mark.parametrize("use", ["norm", "attitude"])
def test_excursions_of_a_wander_count(use):
    _, _, local = local_of(walk([0.05, 0.05, 0.05]), use)
    assert float(local.counts.mean()) > 0.98


def test_bursts_beside_a_wander_do_not_count():
    """They are smaller than the wander's excursions: the plain fit lets most of them through."""
    burst = np.zeros((N, 3))
    for start, length in BURSTS:
        burst[start : start + length] = [3.5, 3.5, 3.5]
    fit, _, local = local_of(walk([0.05, 0.05, 0.05]) + burst, "attitude")
    hit = torch.zeros(N, dtype=torch.bool)
    for start, length in BURSTS:
        hit[start : start + length] = True

    def rejected(counts):
        return float((counts[hit] == 0).any(-1).double().mean())

    assert rejected(fit.pseudo[1]) < 0.3
    assert rejected(local.counts) > 0.7
    assert float(local.counts[~hit].mean()) > 0.95


def bursts_of_one_sign(seed, share=0.15):
    """Outliers of 5 to 20 times the noise along one direction, in bursts of 15 to 60 samples, in µT; and where."""
    draws = np.random.default_rng(seed)
    added, hit = np.zeros((N, 3)), np.zeros(N, dtype=bool)
    while hit.mean() < share:
        length = int(draws.integers(15, 60))
        start = int(draws.integers(0, N - length))
        hit[start : start + length] = True
        size = np.exp(draws.uniform(np.log(1.5), np.log(6.0), (length, 1)))
        added[start : start + length] = size * [[0.7, 0.5, 0.5]]
    return added, torch.from_numpy(hit)


def test_the_small_ones_of_many_bursts_do_not_count_for_a_wander():
    """Many bursts make the likeliest density a wide one, in which the smaller outliers count like samples."""
    kept = []
    for seed in (1, 2, 3):
        added, hit = bursts_of_one_sign(seed)
        _, _, local = local_of(added, "norm")
        kept.append(float(local.counts[hit].mean()))
        assert float(local.counts[~hit].mean()) > 0.98
    assert sum(kept) / 3 < 0.65


def test_what_is_in_the_midst_of_outliers_is_one():
    near = torch.ones(100, 2, dtype=torch.float64)
    near[40:60, 0] = 0.0
    near[45::4, 0] = 1.0  # a course that follows the burst lets some of it through
    near[10::7, 1] = 0.0  # single outliers, however many, take nothing with them
    found = _out_of_bursts(near)
    assert float(found[43:57, 0].sum()) == 0.0
    assert float(found[:35, 0].min()) == float(found[66:, 0].min()) == 1.0
    assert torch.equal(found[:, 1], near[:, 1])


def test_what_counts_keeps_its_wander():
    fit, _, local = local_of(walk([0.05, 0.05, 0.05]), "attitude")
    counted = local.counts > 0
    # the pseudo-residual is the wander, and beside it no more than the white noise
    assert float((local.values - fit.residual)[counted].square().mean().sqrt()) < 0.1
    assert float(local.values[counted].std()) > 1.0


def test_each_axis_has_its_own_share_of_the_wander():
    steps = np.array([0.08, 0.02, 0.02])
    _, tangents, local = local_of(walk(steps), "attitude")
    share = (local.slow.scales / tangents.slow.scales).square()[:, :3]
    torch.testing.assert_close(share[0], share[1])
    # the truth is 2.67, 0.17, 0.17; a few courses' worth of equal axes are in the estimate
    assert float(share[0, 0]) == pytest.approx(2.67, rel=0.25)
    assert float(share[0, 1:].max()) < 0.55


def test_the_noise_is_that_of_what_is_left():
    fit, tangents, local = local_of(walk([0.05, 0.05, 0.05]), "norm")
    noise = local.noise.search.noise_fit(local.noise.series)
    assert noise.size > 0
    again = linearise(fit.model, fit.parameters, local.values, local.counts, tangents.bare, colour=local.noise.colour)
    torch.testing.assert_close(again.series, local.noise.series)


def test_white_noise_is_left_as_it_is():
    fit, _, local = local_of(np.zeros((N, 3)), "attitude")
    values, counts = fit.pseudo
    assert float((local.counts != counts).double().mean()) < 0.02
    both = (local.counts > 0) & (counts > 0)
    assert float((local.values - values)[both].square().mean().sqrt()) < 0.05


def test_a_simulation_of_two_channels_is_served_alike():
    line = Line(600)
    model = JointModel(line)
    fit = fitted(model, line.start())
    local = beside_wander(fit, model, fit.parameters, tangents_of(model, fit.parameters))
    assert local.values.shape == (600, 2)
    assert bool(torch.isfinite(local.values).all())
