"""The remaining time is a range from the durations of this run; it is unknown until some are measured."""

import random

import pytest

pytest.importorskip("typer")

from mkc_torch.cli.diagnosis_files import StageProgress
from mkc_torch.cli.remaining import Durations, range_text
from mkc_torch.cli.steps import Steps


def test_no_time_is_given_before_three_durations_are_known():
    durations = Durations(0.0)
    durations.reached(2, 4.0)
    assert durations.left(10, 10, now=4.0) is None
    durations.reached(3, 6.0)
    assert durations.left(10, 10, now=6.0) == (20.0, 20.0)
    assert durations.left(10, 10, now=7.5) == (18.5, 18.5)


def test_the_pause_between_two_series_is_no_duration():
    durations = Durations(0.0)
    durations.reached(2, 4.0)
    durations.begin(100.0)
    durations.reached(1, 102.0)
    assert durations.left(1, 4, now=102.0) == (2.0, 8.0)


@pytest.mark.parametrize("spread", [0.1, 1.0])
def test_the_range_contains_the_time_that_random_items_take(spread):
    generator, inside = random.Random(0), 0
    for _ in range(400):
        seconds = [generator.lognormvariate(0.0, spread) for _ in range(40)]
        durations, now = Durations(0.0), 0.0
        for done, each in enumerate(seconds[:15], start=1):
            now += each
            durations.reached(done, now)
        low, high = durations.left(25, 25, now)
        inside += low <= sum(seconds[15:]) <= high
    assert inside >= 0.9 * 400  # the distribution is skewed, and its spread is estimated from 15 durations


def test_ranges_are_rounded_outwards():
    assert range_text(31.0, 44.0) == "30 to 45 s"
    assert range_text(3.4, 7.2) == "3 to 8 s"
    assert range_text(0.9, 200.0) == "up to 4 min"
    assert range_text(59.0, 119.0) == "55 to 120 s"
    assert range_text(119.0, 255.0) == "115 s to 5 min"


def test_a_stage_with_a_largest_number_of_parts_has_a_range_up_to_that_number():
    clock = [0.0]
    steps = Steps(None, 1, clock=lambda: clock[0])
    stages = StageProgress(steps, "diagnosing a.csv")
    stages("comparing models")
    stages.bound("model", 1, 60)
    for done in range(12):
        stages.count("model", done, 12)
        clock[0] += 2.0
    assert steps.part_done == "model 13 of at most 60, up to 95 s left in this stage"
    # the next series continues the count, and keeps the durations
    stages.bound("model", 13, 60)
    stages.count("model", 0, 4)
    assert steps.part_done == "model 14 of at most 60, 8 to 95 s left in this stage"
    # a series without a bound has a time of its own
    stages.count("model", 0, 3)
    assert steps.part_done == "model 1 of 3"


def test_stages_that_are_done_and_findings_so_far_are_listed():
    clock = [0.0]
    steps = Steps(None, 2, clock=lambda: clock[0])
    stages = StageProgress(steps, "diagnosing a.csv")
    for stage, seconds in (
        ("reading the recording", 0.2),
        ("fitting the simulation alone", 7.4),
        ("trying 80 effects", 3),
    ):
        stages(stage)
        clock[0] += seconds
    assert steps.name == "diagnosing a.csv: trying 80 effects"
    stages.found("quadratic drag on the rate of speed scores highest, not yet tested")
    stages("checking what was found")
    assert steps.lines == [
        "so far: quadratic drag on the rate of speed scores highest, not yet tested",
        "done: fitting the simulation alone 7 s, trying 80 effects 3 s",
    ]
    # another recording has no finished stages yet
    steps(None)
    StageProgress(steps, "diagnosing b.csv")("reading the recording")
    assert steps.lines == []
