"""A sensor that rests for a while: a rest of any duration counts as a single direction."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mkc_torch import diagnose
from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.calibration.recorded_ellipsoid import recorded_ellipsoid
from mkc_torch.calibration.turning import thin_at_rest, turning, way
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import FIELD, OFFSET, resting, tumbling

N = 2000


def outliers(share, seed=0):
    random = np.random.default_rng(seed)
    return np.where(random.random((N, 1)) < share, 15.0 * random.standard_normal((N, 3)), 0.0)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_rest_is_distinguished_from_turning_despite_outliers(share):
    found = turning(tumbling(N, noise=0.3, moments=resting(N, 600, 1400), sensor=outliers(share)).magnetometer())
    assert float(found[:570].double().mean()) > 0.9
    assert not bool(found[630:1370].any())
    assert float(found[1430:].double().mean()) > 0.9


def test_shuffled_samples_are_neither_resting_nor_turning():
    points = tumbling(N, noise=0.3).magnetometer()
    assert turning(points[torch.randperm(N, generator=torch.Generator().manual_seed(0))]) is None
    assert bool(thin_at_rest(points[torch.randperm(N, generator=torch.Generator().manual_seed(0))]).all())
    assert turning(points[:10]) is None


def test_a_rest_is_thinned_evenly_to_a_window():
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
    assert found.after.robust == pytest.approx(0.3, rel=0.25)  # of all samples, including a rest
    assert found.rejected / N == pytest.approx(0.9 * share, abs=0.06)


@pytest.mark.e2e
@pytest.mark.parametrize("seed", [0, 2])
def test_a_step_during_a_rest_is_not_identifiable_and_not_reported(seed):
    """It shows only in a single direction, and tangents at a large step do not describe zero."""
    result = diagnose(Magnetometer("norm"), tumbling(N, noise=0.3, seed=seed, moments=resting(N, 0, 900)))
    assert result.verdict == "adequate"
    assert not result.warnings


@pytest.mark.e2e
def test_a_sensor_that_mostly_rests_is_diagnosed_with_a_warning():
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


def test_calibration_reports_a_sensor_at_rest_despite_a_few_moving_samples():
    rest = tumbling(N, noise=0.3, moments=np.zeros(N))
    moved = tumbling(N, noise=0.3, moments=np.clip(np.arange(N), 0, 40) / 50.0)
    for recording in (rest, moved):
        with pytest.raises(NotIdentifiableError, match=r"at rest; half of its measurements are within 0\.\d+ µT"):
            calibrate(recording)


def test_ten_seconds_of_turning_in_ten_minutes_are_enough():
    recording = tumbling(30_000, noise=0.3, moments=resting(30_000, 300, 29_800))
    assert calibrate(recording).center == pytest.approx(OFFSET.tolist(), abs=0.3)


@pytest.mark.parametrize("timed", [True, False])
def test_a_sensor_that_rests_between_few_steps_of_its_digits_is_refused(timed):
    """An exact ellipsoid passes through the few points of a lattice that noise reaches."""
    generator = torch.Generator().manual_seed(2)
    for _ in range(10):
        steps = (0.1 / 0.15 * torch.randn(60, 3, generator=generator, dtype=torch.float64)).round()
        columns = dict(zip(("mag_x", "mag_y", "mag_z"), (0.15 * steps).unbind(-1), strict=True))
        columns |= {"time": torch.arange(60) / 50.0} if timed else {}
        with pytest.raises(NotIdentifiableError):
            calibrate(Recording(columns))


@pytest.mark.parametrize("size", [0.08, 0.2])
def test_a_sensor_that_is_turned_a_little_to_and_fro_is_refused(size):
    with pytest.raises(NotIdentifiableError):
        calibrate(tumbling(N, noise=0.3, size=(0.0, 0.0, 0.0), moments=size * np.sin(np.arange(N) / 50.0)))
    little = tumbling(N, noise=0.3, moments=0.5 * size * np.sin(np.arange(N) / 50.0))
    with pytest.raises(NotIdentifiableError):
        calibrate(little)


def tilting(seed, share, tilt=0.14, size=34.0):
    """A multicopter with small tilts; some samples are shifted along an axis in the same direction."""
    random = np.random.default_rng(seed)
    time = np.arange(4500) / 50.0
    angle = [tilt * np.sin(f * time + p) for f, p in ((1.3, 0.1), (1.7, 1.9))]
    yaw = np.cumsum(0.45 * np.sin(0.21 * time + seed)) / 50.0 * 1.5
    rotation = Rotation.from_euler("ZYX", np.stack([yaw, *angle], -1))
    field = rotation.inv().apply(FIELD) + OFFSET + 0.8 * random.standard_normal((4500, 3))
    field[:, 2] += np.where(random.random(4500) < share, random.uniform(0.0, size, 4500), 0.0)
    return Recording(
        {"time": torch.from_numpy(time)}
        | {f"mag_{a}": torch.from_numpy(c) for a, c in zip("xyz", field.T, strict=True)}
    )


@pytest.mark.e2e
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("tilt", [0.14, 0.3])
def test_one_sided_outliers_of_a_tilting_sensor_do_not_form_an_ellipsoid(seed, tilt):
    with pytest.raises(NotIdentifiableError, match=r"[Ss]ingle samples|too few directions|standard error"):
        calibrate(tilting(seed, 0.2, tilt))


def test_the_path_ignores_outliers_and_keeps_the_turns():
    slow = np.arange(N) / 200.0
    clean = tumbling(N, moments=slow).magnetometer()
    measured = tumbling(N, noise=0.3, moments=slow, sensor=outliers(0.2)).magnetometer()
    distance = torch.linalg.vector_norm(way(measured) - clean, dim=-1)
    assert float(distance.median()) < 0.5
    assert float((distance > 3.0).double().mean()) < 0.02
    assert float((torch.linalg.vector_norm(measured - clean, dim=-1) > 3.0).double().mean()) > 0.15


def test_samples_too_sparse_for_a_path_are_still_calibrated():
    rare = tumbling(300, noise=0.3, rate=3.0)
    assert way(rare.magnetometer()) is None
    assert calibrate(rare).center == pytest.approx(OFFSET.tolist(), abs=0.3)


def test_all_samples_are_used_if_too_few_would_remain():
    recording = tumbling(200, noise=4.0, rate=10.0, sensor=np.where(np.arange(200)[:, None] % 3 == 0, 30.0, 0.0))
    assert int(thin_at_rest(recording.magnetometer()).sum()) >= 20


def test_a_long_recording_is_confirmed_by_a_subsample_of_its_path(monkeypatch):
    lengths = []
    fit = EllipsoidFit.fit
    monkeypatch.setattr(EllipsoidFit, "fit", lambda self, X, *rest: lengths.append(len(X)) or fit(self, X, *rest))
    recorded_ellipsoid(tumbling(20_000, noise=0.3))
    assert lengths == [20_000, 5000]
