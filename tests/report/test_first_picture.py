"""The first figure of a report: recording, simulation as it was, corrected simulation, and their residuals."""

import dataclasses
import re

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from matplotlib.backends.backend_agg import FigureCanvasAgg

from mkc_torch.diagnosis.parts import Courses
from mkc_torch.report.diagnosis import first_picture
from mkc_torch.report.diagnosis.first_picture import largest_change
from mkc_torch.report.diagnosis.page import diagnosis_report
from tests.diagnosis.factory import make_diagnosis, make_environment, make_goodness_of_fit, make_unfit, with_courses
from tests.report.test_calibration_report import _texts, parse_page, text_of

ENLARGED = "enlarged the stretch"


def figures_of(diagnosis, monkeypatch):
    """Return the figures of the first picture."""
    figures = []
    monkeypatch.setattr(first_picture, "svg", lambda figure, *_: figures.append(figure) or "")
    first_picture.of_outputs(diagnosis)
    return figures


def courses_of(recorded, before, corrected, run=None):
    count = len(recorded)
    numbers = torch.zeros(count, dtype=torch.long) if run is None else run
    series = (torch.as_tensor(values, dtype=torch.float64) for values in (recorded, before, corrected))
    return Courses(*series, torch.zeros(count, dtype=torch.bool), numbers)


@pytest.mark.parametrize("findings", [0, 1, 3])
def test_it_is_the_first_picture_and_the_numbers_follow_it(findings):
    page = diagnosis_report(with_courses(make_diagnosis(findings, samples=500, environment=make_environment())))
    parse_page(page)
    first = page.index("<svg")
    assert page.index("<h1") < first < page.index('<table class="facts">')
    assert "Recording and simulation: norm" in page[first : first + 400]
    order = [page.index(text) for text in ("Recording and simulation", "Disturbance over time", "Residual over time")]
    assert order == sorted(order)
    if findings:
        assert page.index("How large" if findings == 1 else "1 · Hard-iron step") < page.index("Disturbance over time")


def test_each_output_has_a_panel_of_the_whole_and_one_of_a_stretch(monkeypatch):
    figures = figures_of(with_courses(make_diagnosis(1, channels=4, samples=500)), monkeypatch)
    assert len(figures) == 8
    for whole, part in zip(figures[::2], figures[1::2], strict=True):
        assert whole.axes[0].get_ylabel() == "residual"
        assert whole.axes[0].get_xlim()[1] - whole.axes[0].get_xlim()[0] > 5.0 * np.ptp(part.axes[0].get_xlim())


def test_a_corrected_simulation_is_drawn_only_if_a_finding_counts(monkeypatch):
    made = with_courses(make_diagnosis(1, samples=500))
    (refused,) = (dataclasses.replace(f, grade="unconfirmed") for f in made.findings)
    unconfirmed = dataclasses.replace(made, findings=(refused,))
    lines = [len(figures_of(d, monkeypatch)[0].axes[1].lines) for d in (made, unconfirmed)]
    assert lines[0] == lines[1] + 1
    assert "simulation corrected by the findings" in text_of(diagnosis_report(made))
    assert "simulation corrected by the findings" not in text_of(diagnosis_report(unconfirmed))
    assert "with the largest residual" in text_of(diagnosis_report(unconfirmed))


def test_held_out_parts_are_shaded_and_explained_if_there_are_any(monkeypatch):
    made = make_diagnosis(1, samples=500)
    shaded, bare = (with_courses(made, held_out=held) for held in (True, False))
    assert len(figures_of(shaded, monkeypatch)[0].axes[1].patches) == 5
    assert len(figures_of(bare, monkeypatch)[0].axes[1].patches) == 0
    assert "held-out parts" in text_of(diagnosis_report(shaded))
    assert "held-out parts" not in text_of(diagnosis_report(bare))


def test_predictions_of_one_step_are_stated():
    sentence = "No open-loop simulation follows the recording"
    for one_step in (False, True):
        page = diagnosis_report(with_courses(make_diagnosis(1, samples=500), one_step=one_step))
        assert (sentence in text_of(page)) == one_step


def test_the_stretch_is_where_the_correction_changes_most():
    count = 600
    recorded = torch.sin(torch.arange(count) / 20.0).unsqueeze(-1)
    before = recorded.clone()
    before[300:330] += 0.5
    window = largest_change(courses_of(recorded, before, recorded), corrected=True)
    assert window.first <= 300 < 330 <= window.end
    assert window.end - window.first == 60
    # without a correction it is that of the largest residual
    before[500:530] += 0.8
    window = largest_change(courses_of(recorded, before, before), corrected=False)
    assert window.first <= 500 < 530 <= window.end


def test_the_stretch_is_within_a_run_and_a_divergence_is_not_all_of_the_change():
    count = 400
    recorded = torch.sin(torch.arange(count) / 20.0).unsqueeze(-1)
    before, run = recorded.clone(), (torch.arange(count) >= 200).long()
    before[195:205] += 0.6
    window = largest_change(courses_of(recorded, before, recorded, run), corrected=True)
    assert run[window.first] == run[window.end - 1]
    lost = recorded.clone()
    lost[10] = 1e9
    lost[300:340] += 0.6
    window = largest_change(courses_of(recorded, lost, recorded), corrected=True)
    assert window.first <= 300 < 340 <= window.end


@pytest.mark.parametrize("samples", [1, 2, 9, 41])
def test_short_recordings_have_a_picture(samples):
    made = with_courses(make_diagnosis(1, samples=samples))
    window = largest_change(made.traces.courses, corrected=True)
    assert window.end - window.first == min(samples, 40)
    parse_page(diagnosis_report(made))


def test_a_diverging_simulation_does_not_set_the_scale(monkeypatch):
    made = with_courses(make_unfit())
    courses = made.traces.courses
    lost = courses.before.clone()
    lost[-50:] = torch.linspace(0.0, 1e12, 50).double().unsqueeze(-1)
    traces = dataclasses.replace(made.traces, courses=dataclasses.replace(courses, before=lost))
    (whole, _) = figures_of(dataclasses.replace(made, traces=traces), monkeypatch)
    low, high = whole.axes[1].get_ylim()
    assert high - low < 3.0 * float(courses.recorded.max() - courses.recorded.min())
    lost[:] = torch.nan
    assert len(figures_of(dataclasses.replace(made, traces=traces), monkeypatch)) == 2


def test_runs_are_drawn_one_after_another_and_the_stretch_has_its_own_time():
    made = with_courses(make_diagnosis(1, samples=400), runs=2)
    time = torch.cat([torch.arange(200), torch.arange(200)]).double()
    made = dataclasses.replace(made, traces=dataclasses.replace(made.traces, time=time))
    shown = first_picture.time_of_all_runs(made)
    assert bool((np.diff(shown) > 0.0).all())
    text = text_of(diagnosis_report(made))
    assert "one run after another" in text
    assert re.search(r"enlarged the stretch .*? s of run [12]", text)


def test_missing_outputs_interrupt_no_line(monkeypatch):
    made = with_courses(make_diagnosis(1, samples=400))
    recorded = made.traces.courses.recorded.clone()
    recorded[torch.arange(400) % 4 != 0] = torch.nan
    courses = dataclasses.replace(made.traces.courses, recorded=recorded)
    whole, _ = figures_of(
        dataclasses.replace(made, traces=dataclasses.replace(made.traces, courses=courses)), monkeypatch
    )
    drawn = next(line for line in whole.axes[1].lines if len(line.get_xdata()) > 2)
    assert np.isfinite(drawn.get_ydata()).all()


def test_texts_are_inside_the_figure_whatever_their_length(monkeypatch):
    long = "a_column_with_a_name_that_is_longer_than_a_figure"
    made = make_diagnosis(1, samples=300, channels=2)
    fits = tuple(make_goodness_of_fit(name, "kilogram metre per second squared") for name in (long, "b"))
    made = dataclasses.replace(
        made,
        environment=make_environment(goodness_of_fit=fits),
        traces=dataclasses.replace(made.traces, channels=(long, "b"), unit=""),
    )
    made = with_courses(made)
    courses = made.traces.courses
    small = dataclasses.replace(courses, recorded=1e-7 * courses.recorded + 123456.0)
    for item in (made, dataclasses.replace(made, traces=dataclasses.replace(made.traces, courses=small))):
        for figure in figures_of(item, monkeypatch):
            FigureCanvasAgg(figure).draw()
            for ax in figure.axes:
                for box in _texts(ax):
                    assert box.x0 >= -0.5
                    assert box.y0 >= -0.5
                    assert box.y1 <= figure.bbox.height + 0.5
                    assert box.x1 <= figure.bbox.width + 0.5


def test_a_magnetometer_has_the_residual_over_time_first():
    page = diagnosis_report(make_diagnosis(1, samples=300))
    assert ENLARGED not in page
    assert "Residual over time" in page[page.index("<svg") : page.index("<svg") + 400]


def test_the_headline_has_the_colour_of_the_answer():
    made = make_diagnosis(1, samples=100)
    doubted = dataclasses.replace(made, verdict="unexplained")
    for diagnosis, word in ((made, "usable"), (doubted, "look"), (make_unfit(), "unusable")):
        page = diagnosis_report(diagnosis)
        assert f'<h1 class="{word}">' in page
        assert f"<strong>{word.capitalize()}" in page
    styles = dict(re.findall(r"h1\.(\w+), \.\1 \.answer \{ color: var\(--(\w+)\)", page))
    assert len(set(styles.values())) == 3
    assert set(styles) == {"usable", "look", "unusable"}


def test_of_a_curve_values_within_the_samples_are_stated_and_no_coefficient():
    made = make_diagnosis(3, samples=300)
    curve = made.findings[2].curve
    value, band = curve.value.clone(), curve.band.clone()
    value[:10], band[:10] = torch.nan, torch.nan
    gap = dataclasses.replace(made.findings[2], curve=dataclasses.replace(curve, value=value, band=band))
    made = dataclasses.replace(made, findings=(*made.findings[:2], gap))
    text = text_of(diagnosis_report(made))
    assert "knots" not in text
    assert "nan" not in text.lower()
    first = float(curve.x[10])
    assert f"at temperature {first:.1f} °C: " in text
    assert f"at temperature {float(curve.x[0]):.1f} °C: " not in text
