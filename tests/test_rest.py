"""A sensor that rests for a while: a place where it stays is one direction, however long it stays there."""

import numpy as np
import pytest
import torch

from mkc_torch import diagnose
from mkc_torch.calibration import calibrate
from mkc_torch.ellipsoid import NotIdentifiableError
from mkc_torch.rest import thin_at_rest, turning
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import OFFSET, resting, tumbling

N = 2000


def outliers(share, seed=0):
    random = np.random.default_rng(seed)
    return np.where(random.random((N, 1)) < share, 15.0 * random.standard_normal((N, 3)), 0.0)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_rest_is_told_from_turning_whatever_the_outliers(share):
    found = turning(tumbling(N, noise=0.3, moments=resting(N, 600, 1400), sensor=outliers(share)).magnetometer())
    assert float(found[:570].double().mean()) > 0.9
    assert not bool(found[630:1370].any())
    assert float(found[1430:].double().mean()) > 0.9


def test_samples_in_no_order_are_neither():
    points = tumbling(N, noise=0.3).magnetometer()
    assert turning(points[torch.randperm(N, generator=torch.Generator().manual_seed(0))]) is None
    assert bool(thin_at_rest(points[torch.randperm(N, generator=torch.Generator().manual_seed(0))]).all())
    assert turning(points[:10]) is None


def test_of_a_rest_as_many_samples_are_taken_as_of_a_window_and_evenly():
    taken = thin_at_rest(tumbling(N, noise=0.3, moments=resting(N, 500, 1500)).magnetometer())
    inside = torch.nonzero(taken[550:1450]).flatten()
    assert 10 <= len(inside) <= 30
    assert int(inside.diff().max() - inside.diff().min()) == 0
    assert float(taken[:450].double().mean()) > 0.97


@pytest.mark.parametrize("share", [0.0, 0.15])
@pytest.mark.parametrize("first", [0, 300])
def test_a_sensor_that_mostly_rests_is_calibrated(first, share):
    recording = tumbling(N, noise=0.3, moments=resting(N, first, first + 1400), sensor=outliers(share))
    found = calibrate(recording)
    assert torch.tensor(found.center).tolist() == pytest.approx(OFFSET.tolist(), abs=0.15)
    assert found.after.robust == pytest.approx(0.3, rel=0.25)  # of all samples, those at rest too
    assert found.rejected / N == pytest.approx(0.9 * share, abs=0.06)


@pytest.mark.parametrize("seed", [0, 2])
def test_a_step_while_the_sensor_rests_could_be_of_any_size_and_is_none(seed):
    """It shows in one direction alone, and tangents where it is large say nothing about none."""
    result = diagnose(Magnetometer("norm"), tumbling(N, noise=0.3, seed=seed, moments=resting(N, 0, 900)))
    assert result.verdict == "adequate"
    assert not result.warnings


def test_a_sensor_that_rests_for_most_of_the_time_is_diagnosed_and_told_of():
    sensor = np.where(np.arange(N)[:, None] >= 1700, [3.0, -2.0, 1.0], 0.0)
    recording = tumbling(N, noise=0.3, moments=resting(N, 100, 1300), sensor=sensor)
    result = diagnose(Magnetometer("norm"), recording, surrogates=19)
    assert [finding.effect for finding in result.findings] == ["hard_iron_step"]
    assert any("rests for 5" in warning for warning in result.warnings)


def test_a_sensor_that_never_turns_is_refused():
    for share in (0.0, 0.2):
        recording = tumbling(N, noise=0.3, moments=np.zeros(N), sensor=outliers(share))
        with pytest.raises(NotIdentifiableError, match="at rest"):
            Magnetometer("norm").prepare(recording)
