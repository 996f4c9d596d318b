"""Drift of all sensor axes along one direction is an unrecorded cause; independent drift of the axes is noise."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.diagnosis.evidence.common_cause import common_cause
from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json, validate
from mkc_torch.diagnosis.io.model import DiagnosedModel
from mkc_torch.diagnosis.noise.spectrum import cosines
from mkc_torch.diagnosis.search.linear_search import LinearSearch
from mkc_torch.diagnosis.search.tangents import SlowBasis
from mkc_torch.diagnosis.settings import NoiseSettings
from mkc_torch.effects.sensor.unrecorded import COURSE, Unrecorded
from mkc_torch.report.diagnosis.verdict import headline
from mkc_torch.simulation import Magnetometer
from tests.effects.contexts import make_context
from tests.simulation.tumbling import RATE, tumbling

N = 2500
TIME = np.arange(N) / RATE
DIRECTION = np.array([0.48, -0.6, 0.64])
K, C, SAMPLES = 30, 3, 400


def walks(seed, count=1):
    """Random walks of unit standard deviation over the recording."""
    steps = np.random.default_rng(seed).standard_normal((N, count)).cumsum(0)
    return (steps - steps.mean(0)) / steps.std(0)


def temperature(seed=4):
    """Return an oscillating temperature of a room, which is not of the form of a drift."""
    return np.sin(2 * np.pi * TIME / 23.0 + seed) + 0.6 * np.sin(2 * np.pi * TIME / 11.0)


def search_with_drift(covariance, seed, size=3.0):
    """Return a search with drift, its slow basis and the true drift, drawn with this covariance of the channels."""
    generator = torch.Generator().manual_seed(seed)
    k = torch.arange(1, K + 1, dtype=torch.float64).repeat_interleave(C)
    scales = (1.0 / k).unsqueeze(0)
    channels = torch.randn(SAMPLES, 1, C, generator=generator, dtype=torch.float64)
    slow = SlowBasis("sensor", C, channels, True, scales, NoiseSettings().walk_first)
    tangents = (cosines(K, SAMPLES)[:, :, None] * channels).reshape(SAMPLES, K * C)
    root = torch.linalg.cholesky(torch.as_tensor(covariance) + 1e-9 * torch.eye(C, dtype=torch.float64))
    drawn = size * (torch.randn(K, C, generator=generator, dtype=torch.float64) @ root.mT).flatten() / k
    series = tangents @ drawn + torch.randn(SAMPLES, generator=generator, dtype=torch.float64)
    search = LinearSearch(torch.ones(SAMPLES, 1, dtype=torch.float64), [], tangents, scales, NoiseSettings().walk_first)
    linearised = SimpleNamespace(search=search, series=series, has_drift=search.noise_fit(series).gain > 0)
    return linearised, slow, tangents @ drawn


def test_drift_along_one_direction_has_its_direction_and_course_estimated():
    linearised, slow, truth = search_with_drift(np.outer(DIRECTION, DIRECTION), 1)
    cause = common_cause(linearised, slow)
    assert cause.p_value < 1e-6
    cosine = cause.direction @ torch.as_tensor(DIRECTION) / cause.direction.norm()
    assert float(cosine.abs()) > 0.98
    amplitudes = torch.zeros(K, dtype=torch.float64)
    for name, value in cause.shape.items():
        amplitudes[int(name.removeprefix(COURSE)) - 1] = value / 2.0**0.5
    predicted = slow.waveform((amplitudes[:, None] * cause.direction).flatten()).squeeze(-1)
    assert float(torch.corrcoef(torch.stack([predicted, truth]))[0, 1]) > 0.95


@pytest.mark.e2e
@pytest.mark.parametrize("variances", [(1.0, 1.0, 1.0), (2.0, 0.5, 0.5), (1.0, 0.0, 0.0)])
def test_p_values_of_independently_drifting_channels_are_at_least_uniform(variances):
    p = torch.tensor([common_cause(*search_with_drift(np.diag(variances), seed)[:2]).p_value for seed in range(60)])
    assert float((p < 0.05).double().mean()) < 0.15
    assert float((p < 0.5).double().mean()) < 0.7


def test_a_single_channel_or_noise_without_drift_has_no_common_cause():
    linearised, slow, _ = search_with_drift(np.eye(3), 0)
    assert common_cause(linearised, None) is None
    assert common_cause(SimpleNamespace(has_drift=False), slow) is None


def test_the_sign_of_the_direction_can_be_flipped():
    linearised, slow, _ = search_with_drift(np.outer(DIRECTION, DIRECTION), 1)
    cause = common_cause(linearised, slow)
    other = cause.towards(-cause.direction)
    assert torch.equal(other.direction, -cause.direction)
    assert other.shape == {name: -value for name, value in cause.shape.items()}
    assert cause.towards(cause.direction) is cause


@pytest.fixture(scope="module")
def diagnosis():
    """Return the diagnosis of an offset that follows an unrecorded temperature, and the recording."""
    recording = tumbling(N, noise=0.5, sensor=1.2 * temperature()[:, None] * DIRECTION, aux=walks(8)[:, 0])
    return diagnose(Magnetometer("norm"), recording), recording


@pytest.mark.e2e
def test_an_unrecorded_cause_is_a_finding_without_a_driver(diagnosis):
    found, _ = diagnosis
    (finding,) = found.findings
    assert (finding.effect, finding.drivers, found.verdict) == ("unknown", (), "unexplained")
    assert found.p_value == finding.p_value == 0.01
    assert "unrecorded cause" in headline(found)


@pytest.mark.e2e
def test_size_and_course_of_an_unrecorded_cause_are_estimated(diagnosis):
    found, _ = diagnosis
    (finding,) = found.findings
    (size,) = finding.parameters
    span = 1.2 * np.ptp(temperature())
    gap = np.abs(np.array(size.value)) - np.abs(span * DIRECTION)
    assert np.abs(gap).max() < 4.0 * max(size.standard_error)
    assert np.abs(gap).max() < 0.15 * span
    at = np.interp(finding.curve.x, TIME, temperature())
    assert abs(np.corrcoef(at, finding.curve.value[:, 0])[0, 1]) > 0.97


@pytest.mark.e2e
def test_an_unrecorded_cause_is_scored_on_blocks_held_out_from_its_course(diagnosis):
    """The best correction leaves the noise of 0.5 µT; a course fitted to the held-out blocks would leave less."""
    held = diagnosis[0].findings[0].held_out
    assert held.log_likelihood_gain > 0.0
    assert 0.49 < held.rmse_after < held.rmse_before


@pytest.mark.e2e
def test_the_saved_model_of_an_unrecorded_cause_subtracts_its_final_offset(diagnosis):
    found, recording = diagnosis
    model = DiagnosedModel.from_json(found.model.to_json())
    (term,) = model.terms
    assert isinstance(term.effect, Unrecorded)
    assert term.shape == found.model.terms[0].shape
    columns, notes = model.correct(recording)
    (note,) = notes
    assert note.startswith("unknown depends on the time")
    assert "its final change applies to all samples" in note
    strength = torch.linalg.vector_norm(torch.stack([columns[f"field_{axis}"] for axis in "xyz"], -1), dim=-1)
    truth = float(strength.median())
    assert abs(float(strength[-100:].mean()) - truth) < 0.01 * truth
    validate(json.loads(diagnosis_to_json(found)))


@pytest.mark.e2e
@pytest.mark.parametrize("whole", [False, True])
def test_a_column_that_follows_the_cause_in_part_is_reported_as_a_proxy(whole):
    """A column equal to the cause is not reported. The names of the columns do not state their quantities."""
    column = temperature() if whole else np.sin(2 * np.pi * TIME / 23.0 + 4)
    recording = tumbling(N, noise=0.5, sensor=1.2 * temperature()[:, None] * DIRECTION, aux=column)
    found = diagnose(Magnetometer("norm"), recording)
    assert (found.findings[0].effect, found.findings[0].drivers) == ("driver_offset", ("aux",))
    sentences = [warning for warning in found.warnings if "may be a proxy" in warning]
    assert len(sentences) == (0 if whole else 1)
    assert all(warning.startswith("With aux as driver, the offset still drifts") for warning in sentences)


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [0, 1, 3])
def test_independently_drifting_axes_are_noise(seed):
    """At a tenth of the level, 1 draw in 200 would be taken for a common cause; these seeds are not."""
    found = diagnose(Magnetometer("norm"), tumbling(N, noise=0.5, sensor=0.8 * walks(seed, 3), seed=seed))
    assert "unknown" not in [finding.effect for finding in found.findings]


def test_the_course_of_an_unrecorded_cause_is_a_cosine_series_that_ends_at_zero():
    context = make_context(Unrecorded(), N=200)
    course = Unrecorded().waveform({f"{COURSE}1": 0.3, f"{COURSE}4": -0.2}, context)
    phase = torch.pi * (torch.arange(200, dtype=torch.float64) + 0.5) / 200
    known = 0.3 * torch.cos(phase) - 0.2 * torch.cos(4.0 * phase)
    torch.testing.assert_close(course, known - known[-1])
    assert float(Unrecorded().lasting(torch.ones(3, dtype=torch.float64), context).abs().max()) == 0.0
