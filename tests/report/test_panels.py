"""Panels: an SVG element each, stacked on a telephone, readable in a dark theme, with no text cut at an edge."""

import dataclasses
import re

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg

from mkc_torch.diagnosis.parts import StateMap
from mkc_torch.report import panels
from mkc_torch.report.diagnosis.page import bars, diagnosis_report
from tests.diagnosis.factory import make_diagnosis, make_environment
from tests.report import test_phone_width as phone
from tests.report.test_calibration_report import _texts

in_a_browser = pytest.mark.skipif(phone.CHROMIUM is None, reason="no chromium on this machine")

MEASURE = """<!doctype html><body style="margin:0"><iframe id="page" src="page.html"
style="width:{width}px;height:900px;border:0"></iframe><p id="result"></p><script>
document.getElementById("page").onload = (event) => {{
  const inside = event.target.contentDocument, style = (item, name) => getComputedStyle(item)[name];
  const boxes = [...inside.querySelector(".in2").children].map((item) => item.getBoundingClientRect());
  document.getElementById("result").textContent = ["found", boxes[0].right > {width} ? "beyond" : "inside",
    boxes[1].top >= boxes[0].bottom ? "stacked" : "side by side", style(inside.body, "backgroundColor"),
    style(inside.querySelector("svg text"), "fill"), style(inside.body, "color"), "end"].join(" | ");
}};</script>"""


@pytest.fixture(scope="module")
def diagnosis():
    return make_diagnosis(3, samples=300, channels=2, verdict="unexplained", environment=make_environment())


def measured(page, folder, *, width, dark=False):
    """Return the layout of the panels, and the colours of page, picture and text, in a browser."""
    (folder / "page.html").write_text(page, encoding="utf-8")
    (folder / "frame.html").write_text(MEASURE.format(width=width), encoding="utf-8")
    result = phone.dump_frame(folder, *(("--blink-settings=preferredColorScheme=0",) if dark else ()))
    found = re.search(r"found \| (.+?) \| end", result.stdout)
    assert found, result.stderr[-1000:]
    return found[1].split(" | ")


@in_a_browser
@pytest.mark.process
def test_panels_are_side_by_side_on_a_wide_page_and_stacked_on_a_telephone(diagnosis, tmp_path):
    page = diagnosis_report(diagnosis)
    assert measured(page, tmp_path, width=1280)[:2] == ["inside", "side by side"]
    assert measured(page, tmp_path, width=phone.WIDTH)[:2] == ["inside", "stacked"]


@in_a_browser
@pytest.mark.process
def test_texts_of_pictures_follow_the_theme_of_the_page(diagnosis, tmp_path):
    page = diagnosis_report(diagnosis)
    light, dark = (measured(page, tmp_path, width=800, dark=dark)[2:] for dark in (False, True))
    for ground, drawn, text in (light, dark):
        assert drawn == text != ground
    assert light[0] == "rgb(255, 255, 255)"
    assert max(map(int, re.findall(r"\d+", dark[0]))) < 50
    assert min(map(int, re.findall(r"\d+", dark[1]))) > 200


def test_colours_of_pictures_are_variables_of_the_theme(diagnosis):
    drawn = "".join(re.findall(r"<svg.*?</svg>", diagnosis_report(diagnosis), re.DOTALL))
    assert "var(--ink, #222222)" in drawn
    assert re.findall(r": #(?:222222|9a4300|ffffff|0072b2|d55e00)\b", drawn) == []


def test_texts_of_a_diagnosis_are_inside_their_panels(diagnosis, monkeypatch):
    figures = []
    monkeypatch.setattr(panels, "svg", lambda figure, *_: figures.append(figure) or "")
    monkeypatch.setattr("mkc_torch.report.diagnosis.page.shared", lambda works: [work() for work in works])
    diagnosis_report(diagnosis)
    assert len(figures) > 10
    for figure in figures:
        FigureCanvasAgg(figure).draw()
        for ax in figure.axes:
            assert ax.get_ylabel()
            for box in _texts(ax):
                assert box.x0 >= -2.0
                assert box.y0 >= -2.0
                assert box.x1 <= figure.bbox.width + 2.0
                assert box.y1 <= figure.bbox.height + 2.0


def test_the_table_of_candidates_has_the_order_of_the_matrix(diagnosis):
    """Both are in the order of the search, by penalised gain."""
    reversed_ = diagnosis.candidates[::-1]
    assert [bar.candidate for bar in bars(reversed_)] == list(reversed_[:12])


def test_channels_of_several_units_have_separate_axes_with_their_units(diagnosis):
    traces = dataclasses.replace(diagnosis.traces, channels=("angle", "turn_x"), unit="")
    made = dataclasses.replace(diagnosis, traces=traces)
    drawn = re.findall(r"<svg.*?</svg>", diagnosis_report(made), re.DOTALL)
    assert sum("residual (rad)" in picture and "After, angle" in picture for picture in drawn) == 1
    assert made.plot.residual("angle").get_ylabel() == "residual (rad)"
    assert made.plot.residual("turn_x").get_ylabel() == "residual"
    pyplot.close("all")


def test_a_state_without_a_unit_has_the_unit_of_the_output_of_its_name(diagnosis):
    edges = tuple(torch.linspace(-1.0, 1.0, 5, dtype=torch.float64) for _ in range(2))
    nats = 400.0 * torch.arange(-3.0, 13.0, dtype=torch.float64).reshape(4, 4)
    found = StateMap(("angle", "rate"), ("", "rad/s"), edges, nats)
    first, *rest = diagnosis.findings
    made = dataclasses.replace(diagnosis, findings=(dataclasses.replace(first, map=found), *rest))
    page = diagnosis_report(made)
    (picture,) = (p for p in re.findall(r"<svg.*?</svg>", page, re.DOTALL) if "Gain over the states" in p)
    assert "angle (rad)" in picture
    assert "e+03" not in picture
