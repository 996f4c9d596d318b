"""Join several recordings to a table, whose column `experiment` numbers their runs."""

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.recording.formats.base import RecordingError
from mkc_torch.recording.join_recordings import join_recordings


def run_from(begin, name, count=4, step=0.1, **more):
    time = begin + step * torch.arange(count, dtype=torch.float64)
    return Recording({"time": time, "speed": time * 0.0 + begin, **more}, name=name)


def test_runs_are_named_by_recording_and_label():
    table = Recording(
        {
            "experiment": torch.tensor([0.0, 0.0, 1.0]),
            "time": torch.tensor([0.0, 0.1, 0.0]),
            "speed": torch.arange(3.0),
        },
        name="bench",
        labels={"experiment": ("slow", "fast")},
    )
    both = join_recordings([table, run_from(0.0, "road")])
    assert both.labels["experiment"] == ("bench/slow", "bench/fast", "road")
    assert both["experiment"].tolist() == [0, 0, 1, 2, 2, 2, 2]
    assert both["speed"].tolist() == [0, 1, 2, 0, 0, 0, 0]
    assert both.name == "bench, road"


def test_missing_and_equal_names_become_unique():
    both = join_recordings([run_from(0.0, ""), run_from(0.0, "a"), run_from(0.0, "a")])
    assert both.labels["experiment"] == ("recording 1", "a", "a (2)")


def test_a_single_recording_without_runs_is_unchanged():
    alone = run_from(5.0, "alone")
    assert join_recordings([alone]) is alone


@pytest.mark.parametrize(
    ("clock", "second", "begins", "warning"),
    [
        ("own", 7.0, 7.0, ""),
        ("restart", 7.0, 0.0, "b is counted 7 s earlier"),
        ("restart", 0.2, 0.2, ""),
        ("restart", 0.0, 0.0, ""),
        ("follow", 7.0, 7.0, ""),
        ("follow", 0.2, 10.3, "b is counted 10.1 s later"),
    ],
)
def test_a_clock_is_shifted_with_a_warning_if_runs_would_overlap(clock, second, begins, warning):
    both = join_recordings([run_from(0.0, "a"), run_from(second, "b")], clock)
    assert float(both["time"][4]) == pytest.approx(begins)
    assert warning in " ".join(both.warnings)
    assert bool(both.warnings) == bool(warning)
    if clock != "own":
        falls = bool(both["time"][4] < both["time"][3])
        assert falls == (clock == "restart")


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (run_from(0.0, "b", current=torch.zeros(4)), "b has `current`, which a has not"),
        (Recording({"time": torch.arange(4.0)}, name="b"), "a has `speed`, which b has not"),
        (
            Recording({"time": torch.arange(4.0), "speed": torch.zeros(4)}, name="b", units={"speed": "km/h"}),
            "`speed` is in km/h in b and in no unit in a",
        ),
    ],
)
def test_recordings_that_differ_are_refused_with_the_difference(other, words):
    with pytest.raises(RecordingError, match="cannot be diagnosed together") as error:
        join_recordings([run_from(0.0, "a"), other])
    assert words in str(error.value)


def test_no_recording_is_refused():
    with pytest.raises(RecordingError, match="no recording"):
        join_recordings([])
