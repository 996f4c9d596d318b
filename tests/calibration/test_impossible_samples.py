"""Samples that no magnetic field explains are left out with a warning; all other samples are kept."""

import numpy as np
import pytest
import torch

from mkc_torch.calibration.calibrate import calibrate, prepared
from mkc_torch.calibration.impossible_samples import without_impossible
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import OFFSET, changed, resting, tumbling

AXES = ("mag_x", "mag_y", "mag_z")
N = 1500


def with_values(recording, value, places, column="mag_x"):
    values = recording[column].clone()
    values[places] = value
    return changed(recording, **{column: values})


@pytest.mark.e2e
@pytest.mark.parametrize("value", [1e4, 32767.0, -65535.0, 1e6, 1e9, 1e12, 1e30, 1e300])
def test_two_impossible_samples_change_nothing_and_are_reported(value):
    good = tumbling(N, noise=0.3)
    found = calibrate(with_values(good, value, [55, 900]))
    assert found.center == pytest.approx(OFFSET.tolist(), abs=0.1)
    assert found.samples == N - 2
    assert found.after.rms == pytest.approx(calibrate(good).after.rms, rel=0.01)
    assert f"Left out 2 of 1500 samples that no field explains: `mag_x` is {value:.6g} 2 times, first at 1.1 s." in (
        found.warnings
    )


def test_a_diagnosis_leaves_impossible_samples_out():
    view = Magnetometer("norm").prepare(with_values(tumbling(N, noise=0.3), 1e9, [55, 900]))
    assert len(view.measured) == N - 2
    assert any("`mag_x` is 1e+09" in warning for warning in view.recording.warnings)


def test_a_code_for_every_fifth_value_is_left_out():
    random = np.random.default_rng(0)
    bad = torch.from_numpy(random.random(N) < 0.2)
    left = without_impossible(with_values(tumbling(N, noise=0.3), 32767.0, bad), *AXES)
    assert len(left) == int((~bad).sum())
    assert f"`mag_x` is 32767 {int(bad.sum())} times" in left.warnings[0]


def test_at_most_a_few_columns_and_values_are_listed():
    recording = with_values(tumbling(N, noise=0.3), 1e5, [7])
    recording = with_values(recording, -2e5, [8], "mag_z")
    assert (
        without_impossible(recording, *AXES)
        .warnings[0]
        .endswith("`mag_x` is 100000 at 0.14 s; `mag_z` is -200000 at 0.16 s.")
    )
    many = with_values(recording, torch.linspace(1e5, 2e5, 10).double(), range(20, 30))
    assert "; and 7 more values." in without_impossible(many, *AXES).warnings[0]


def test_without_a_time_the_sample_is_reported_by_its_number():
    recording = changed(with_values(tumbling(N, noise=0.3), 1e5, [7]), time=None)
    assert "`mag_x` is 100000 at sample 8." in without_impossible(recording, *AXES).warnings[0]


@pytest.mark.parametrize("first", [0, 200])
@pytest.mark.parametrize("rate", [1.0, 50.0])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_sensor_that_mostly_rests_loses_no_samples(first, rate, noise):
    recording = tumbling(N, noise=noise, rate=rate, moments=resting(N, first, first + 1400, rate))
    assert without_impossible(recording, *AXES) is recording


def test_samples_near_a_passing_magnet_are_kept():
    time = np.arange(N) / 50.0
    sensor = np.outer(5e3 / (1.0 + (20.0 * (time - 15.0)) ** 2) ** 1.5, [1.0, -0.5, 0.3])
    recording = tumbling(N, noise=0.3, sensor=sensor)
    assert len(prepared(recording)) == N


def test_outliers_of_any_usual_size_are_left_to_the_fit():
    random = np.random.default_rng(1)
    sensor = np.where(random.random((N, 1)) < 0.1, 50.0 * random.standard_cauchy((N, 3)).clip(-10, 10), 0.0)
    assert len(prepared(tumbling(N, noise=0.3, sensor=sensor))) == N


def test_a_recording_of_error_codes_alone_is_unchanged():
    recording = Recording({name: torch.full((50,), 32767.0) for name in AXES})
    assert without_impossible(recording, *AXES) is recording
