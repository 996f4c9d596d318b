import dataclasses

import pytest

from mkc_torch import Recording
from mkc_torch.calibration import Calibration, calibrate
from mkc_torch.calibration.plain_values import ResidualSpread
from mkc_torch.calibration.quality import disturbances, doubts
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.disturbance import RejectedInterval
from mkc_torch.report.words.verdict import calibration_verdict


@pytest.fixture(scope="module")
def calibration():
    return calibrate(simulated_recording()[0])


def test_a_correction_that_reduces_no_scatter_is_doubtful(calibration):
    worse = dataclasses.replace(calibration, before=ResidualSpread(2.77, 11.3), after=ResidualSpread(3.25, 7.8))
    assert doubts(worse) == ("not_better",)
    assert doubts(calibration) == ()


@pytest.mark.parametrize(("share", "found"), [(0.34, ("much_rejected",)), (0.32, ())])
def test_a_third_of_the_samples_rejected_is_doubtful(calibration, share, found):
    assert doubts(dataclasses.replace(calibration, rejected=round(share * calibration.samples))) == found


def test_bursts_shorter_than_half_a_second_do_not_count_as_disturbance(calibration):
    intervals = (RejectedInterval(3.0, 3.3), RejectedInterval(48.8, 51.8))
    assert disturbances(dataclasses.replace(calibration, disturbed=intervals)) == intervals[1:]
    rows = (RejectedInterval(10.0, 30.0), RejectedInterval(100.0, 140.0))
    changed = dataclasses.replace(calibration, disturbed=rows, disturbed_unit="row")
    assert disturbances(changed) == rows[1:]


def test_the_headline_counts_long_disturbances_and_states_their_length(calibration):
    long = tuple(RejectedInterval(10.0 * k, 10.0 * k + 2.0) for k in range(5))
    short = RejectedInterval(70.0, 70.2)
    verdicts = [
        calibration_verdict(dataclasses.replace(calibration, disturbed=each)) for each in (long, (*long, short))
    ]
    assert "Disturbed in 5 intervals, the longest" in verdicts[0]
    assert "Disturbed in 5 intervals of at least 0.5 s, the longest" in verdicts[1]


def test_notes_of_the_recording_are_kept_apart_from_warnings_in_the_file():
    recording, _ = simulated_recording()
    noted = Recording(recording.columns, notes=("Decimal commas were read as points.",), warnings=("A part is lost.",))
    found = Calibration.from_json(calibrate(noted).to_json())
    assert found.notes == ("Decimal commas were read as points.",)
    assert "A part is lost." in found.warnings
    assert not set(found.notes) & set(found.warnings)
