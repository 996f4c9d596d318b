"""The page of a check: the verdict, the reasons, the residuals and the overlay."""

import dataclasses
import math

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

import torch

from mkc_torch import check
from mkc_torch.diagnosis.validation.blocks import Ratio
from mkc_torch.report import check_report
from mkc_torch.report.check import sentences
from tests.diagnosis.validation.tank import tank_recording, two_runs, usual_model


@pytest.fixture(scope="module")
def held():
    return check(usual_model(), tank_recording(1, name="<new> & odd"))


def test_the_page_has_the_numbers_of_the_check(held):
    page = check_report(held)
    assert "The findings in Tank hold on this recording." in page
    level = held.outputs[0]
    for value in (level.baseline, level.corrected, level.training):
        assert sentences.rmse(value) in page
    assert sentences.ratio(level.ratio) in page
    assert page.count("<svg") == 2
    assert "&lt;new&gt; &amp; odd" in page
    assert "<new>" not in page


def test_the_verdict_is_in_the_heading(held):
    failed = dataclasses.replace(held.outputs[0], failure="level: it fails.")
    other = dataclasses.replace(held, outputs=(failed,))
    assert "The findings in Tank do not hold on this recording." in check_report(other)
    assert "level: it fails." in check_report(other)
    assert "This recording was used in the fit." in check_report(dataclasses.replace(held, used_in_fit=True))
    assert "Tank holds on this recording." in check_report(dataclasses.replace(held, findings=()))


def test_the_first_part_and_the_segments_are_stated(held):
    assert sentences.how(held).startswith("initial states from the first 1.49 s of each run; the other 135 of 150")
    segments = dataclasses.replace(held, segment_seconds=5.0)
    assert "segment of 5 s, in which the model was fitted too" in sentences.how(segments)
    static = dataclasses.replace(held, start_seconds=None)
    assert sentences.how(static) == "all 150 samples are predicted; the model has no initial states"


def test_unknown_numbers_are_dashes(held):
    nan = Ratio(math.nan, math.nan, math.nan)
    output = dataclasses.replace(held.outputs[0], ratio=nan, training=math.nan)
    page = check_report(dataclasses.replace(held, outputs=(output,)))
    assert "nan" not in page.split("<svg")[0].split("<h2>Residuals")[1]
    assert page.count("—") >= 2


@pytest.mark.e2e
def test_runs_follow_one_another_in_the_picture():
    found = check(usual_model(), two_runs(tank_recording(1), tank_recording(2)))
    assert check_report(found).count("<svg") == 2
    missing = found.traces.measured.clone()
    missing[::2] = torch.nan
    traces = dataclasses.replace(found.traces, measured=missing)
    assert check_report(dataclasses.replace(found, traces=traces)).count("<svg") == 2
