"""Residuals about a drift: bursts are rejected, excursions of the drift are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.noise.outliers import out_of_bursts, rejected_in_all, without_one_sided
from mkc_torch.diagnosis.search.estimate import drift_residuals
from mkc_torch.diagnosis.search.linearise import linearise
from mkc_torch.diagnosis.search.tangents import tangents_of
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.simulation import Magnetometer
from tests.diagnosis.line import Line
from tests.simulation.tumbling import RATE, tumbling, turns

N = 2000
BURSTS = [(300, 12), (900, 15), (1500, 10)]


def walk(steps, seed=5):
    """Return a random walk on each axis, less its mean, in µT."""
    course = np.cumsum(np.random.default_rng(seed).standard_normal((N, 3)), 0) * np.asarray(steps)
    return course - course.mean(0)


def local_of(sensor, use, noise=0.3):
    prepared = Magnetometer(use).prepare(tumbling(N, noise=noise, sensor=sensor, attitude=True, gyro=True))
    model = JointModel(prepared)
    fit = fitted(model, prepared.start())
    tangents = tangents_of(model, fit.parameters, NoiseSettings())
    return fit, tangents, drift_residuals(fit, model, fit.parameters, tangents, NoiseSettings())


@pytest.mark.parametrize("use", ["norm", "attitude"])
def test_excursions_of_a_drift_count(use):
    _, _, local = local_of(walk([0.05, 0.05, 0.05]), use)
    assert float(local.counts.mean()) > 0.98


@pytest.mark.e2e
def test_bursts_in_a_drift_are_rejected():
    """The bursts are smaller than the drift's excursions, so the plain fit does not reject most of them."""
    burst = np.zeros((N, 3))
    for start, length in BURSTS:
        burst[start : start + length] = [3.5, 3.5, 3.5]
    fit, _, local = local_of(walk([0.05, 0.05, 0.05]) + burst, "attitude")
    hit = torch.zeros(N, dtype=torch.bool)
    for start, length in BURSTS:
        hit[start : start + length] = True

    def rejected(counts):
        return float((counts[hit] == 0).any(-1).double().mean())

    assert rejected(fit.pseudo(NoiseSettings())[1]) < 0.3
    assert rejected(local.counts) > 0.7
    assert float(local.counts[~hit].mean()) > 0.95


def bursts_of_one_sign(seed, share=0.15):
    """Return outliers of 5 to 20 times the noise in a direction, in bursts of 15 to 60 samples, and their mask."""
    draws = np.random.default_rng(seed)
    added, hit = np.zeros((N, 3)), np.zeros(N, dtype=bool)
    while hit.mean() < share:
        length = int(draws.integers(15, 60))
        start = int(draws.integers(0, N - length))
        hit[start : start + length] = True
        size = np.exp(draws.uniform(np.log(1.5), np.log(6.0), (length, 1)))
        added[start : start + length] = size * [[0.7, 0.5, 0.5]]
    return added, torch.from_numpy(hit)


@pytest.mark.e2e
def test_small_outliers_of_many_bursts_are_rejected():
    """Many bursts make the most likely density wide, and smaller outliers would count."""
    kept = []
    for seed in (1, 2, 3):
        added, hit = bursts_of_one_sign(seed)
        _, _, local = local_of(added, "norm")
        kept.append(float(local.counts[hit].mean()))
        assert float(local.counts[~hit].mean()) > 0.93
    assert sum(kept) / 3 < 0.35


@pytest.mark.e2e
@pytest.mark.parametrize(("step", "size"), [(0.0, 0.7), (0.05, 1.5)])
def test_mild_samples_of_bursts_are_rejected(step, size):
    """Most are within three scales of the noise, and in a drift the fit's own parameters hide them."""
    burst, hit = np.zeros((N, 3)), torch.zeros(N, dtype=torch.bool)
    for start, length in [(300, 25), (900, 30), (1500, 25)]:
        burst[start : start + length] = size
        hit[start : start + length] = True
    kept = []
    for seed in range(3):
        _, _, local = local_of(walk([step] * 3, seed) + burst, "norm")
        kept.append((float(local.counts[hit].mean()), float(local.counts[~hit].mean())))
    of_bursts, of_others = np.mean(kept, axis=0)
    assert of_bursts < 0.2
    assert of_others > 0.945


def test_one_sided_neighbourhoods_are_rejected():
    draws = torch.from_numpy(np.random.default_rng(2).standard_normal((3000, 2)))
    slow = draws.clone()
    for n in range(1, 3000):
        slow[n] += 0.98 * slow[n - 1]
    every = torch.ones_like(draws)
    assert float(without_one_sided(draws, every, NoiseSettings()).mean()) == 1.0
    assert float(without_one_sided(slow, every, NoiseSettings()).mean()) > 0.99
    draws[1000:1030, 1] += 1.5
    draws[2000:2600, 0] *= 1.5
    found = without_one_sided(draws, every, NoiseSettings())
    assert float(found[1002:1028, 1].sum()) == 0.0
    assert float(found[:, 0].min()) == 1.0 == float(found[:970, 1].min()) == float(found[1060:, 1].min())
    rejected = every.clone()
    rejected[1000:1030, 1] = 0.0
    assert float(without_one_sided(draws, rejected, NoiseSettings())[:, 1].min()) == 1.0


def test_samples_amid_outliers_are_rejected():
    near = torch.ones(100, 2, dtype=torch.float64)
    near[40:60, 0] = 0.0
    near[45::4, 0] = 1.0  # a drift that follows the burst keeps some of it
    near[10::7, 1] = 0.0  # scattered outliers do not reject their neighbours
    found = out_of_bursts(near, NoiseSettings())
    assert float(found[43:57, 0].sum()) == 0.0
    assert float(found[:35, 0].min()) == float(found[66:, 0].min()) == 1.0
    assert torch.equal(found[:, 1], near[:, 1])


def test_coincident_outliers_are_rejected_in_all_channels():
    draws = torch.from_numpy(np.random.default_rng(4).random((2000, 3)))
    apart = (draws > 0.15).double()
    assert torch.equal(rejected_in_all(apart, NoiseSettings()), apart)
    coincident = apart.clone()
    coincident[:, 1] *= apart[:, 0]
    coincident[:, 2] *= (draws[:, 0] > 0.1).double()
    assert torch.equal(rejected_in_all(coincident, NoiseSettings()), coincident.amin(1, keepdim=True).expand(-1, 3))
    assert torch.equal(rejected_in_all(apart[:, :1], NoiseSettings()), apart[:, :1])
    assert torch.equal(rejected_in_all(torch.ones_like(apart), NoiseSettings()), torch.ones_like(apart))


def attitude_error(seed, keep=0.998, size=0.8):
    """Return the error in the body's axes of an attitude that drifts by about a degree, in µT."""
    drift = np.random.default_rng(seed).standard_normal((N, 3)) * size * np.sqrt(1.0 - keep**2)
    for n in range(1, N):
        drift[n] += keep * drift[n - 1]
    return turns(np.arange(N) / RATE).inv().apply(drift)


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_spectrum_without_the_drift_has_converged(seed):
    """A drift in the sensor's axes and slow noise in the Earth's are hard to separate."""
    fit, tangents, local = local_of(walk([0.05] * 3, seed) + attitude_error(seed), "attitude")
    found = local.noise
    bare = replace(tangents.bare, slow=local.slow)
    step = linearise(fit.model, fit.parameters, local.values, local.counts, bare, spectrum=found.stationary_spectrum())
    assert step.evidence < found.evidence + 10.0
    slow = found.spectrum.root.square()
    assert float((slow[2:6, 1:].mean(0) / slow[-200:, 1:].mean(0)).min()) > 30.0


@pytest.mark.e2e
def test_pseudo_residuals_keep_the_drift():
    fit, _, local = local_of(walk([0.05, 0.05, 0.05]), "attitude")
    counted = local.counts > 0
    # the pseudo-residual is the drift plus the white noise
    assert float((local.values - fit.residual)[counted].square().mean().sqrt()) < 0.1
    assert float(local.values[counted].std()) > 1.0


@pytest.mark.e2e
def test_each_axis_has_its_own_share_of_the_drift():
    steps = np.array([0.08, 0.02, 0.02])
    _, tangents, local = local_of(walk(steps), "attitude")
    share = (local.slow.scales / tangents.slow.scales).square()[:, :3]
    torch.testing.assert_close(share[0], share[1])
    # the truth is 2.67, 0.17, 0.17; the estimate includes a prior of equal axes
    assert float(share[0, 0]) == pytest.approx(2.67, rel=0.25)
    assert float(share[0, 1:].max()) < 0.55


def test_the_noise_is_that_of_the_pseudo_residuals():
    fit, tangents, local = local_of(walk([0.05, 0.05, 0.05]), "norm")
    noise = local.noise.search.noise_fit(local.noise.series)
    assert noise.size > 0
    again = linearise(
        fit.model, fit.parameters, local.values, local.counts, tangents.bare, spectrum=local.noise.spectrum
    )
    torch.testing.assert_close(again.series, local.noise.series)


def test_changing_the_spectrum_equals_a_search_with_it():
    """Except for the imputation of rejected samples, which keeps the previous spectrum."""
    prepared = Magnetometer("attitude").prepare(tumbling(N, noise=0.3, sensor=walk([0.05] * 3), attitude=True))
    model = JointModel(prepared)
    fit = fitted(model, prepared.start())
    tangents, values, counts = (
        tangents_of(model, fit.parameters, NoiseSettings()),
        fit.residual,
        torch.ones_like(fit.residual),
    )
    found = linearise(model, fit.parameters, values, counts, tangents, white=True)
    spectrum = found.stationary_spectrum()
    built = linearise(model, fit.parameters, values, counts, tangents, spectrum=spectrum)
    changed = found.under(spectrum)
    torch.testing.assert_close(changed.series, built.series)
    assert changed.evidence == pytest.approx(built.evidence)
    assert changed.evidence > found.evidence + 10.0


@pytest.mark.e2e
def test_white_noise_is_unchanged():
    fit, _, local = local_of(np.zeros((N, 3)), "attitude")
    values, counts = fit.pseudo(NoiseSettings())
    assert float((local.counts != counts).double().mean()) < 0.02
    both = (local.counts > 0) & (counts > 0)
    assert float((local.values - values)[both].square().mean().sqrt()) < 0.05


def test_a_simulation_of_two_channels_has_finite_residuals():
    line = Line(600)
    model = JointModel(line)
    fit = fitted(model, line.start())
    local = drift_residuals(
        fit, model, fit.parameters, tangents_of(model, fit.parameters, NoiseSettings()), NoiseSettings()
    )
    assert local.values.shape == (600, 2)
    assert bool(torch.isfinite(local.values).all())
