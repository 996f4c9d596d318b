import dataclasses
import itertools
import math
import re
from html.parser import HTMLParser

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from matplotlib.backends.backend_agg import FigureCanvasAgg

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.density import ChannelTails
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.recording import Recording
from mkc_torch.report import Comparison, calibration_report, panels, refusal_report
from mkc_torch.report.words import numbers as wording
from tests.calibration.test_calibrate import noisy_ellipsoid, recorded

VOID = {"meta", "link", "br", "img", "input", "hr"}


class Tags(HTMLParser):
    """Checks that tags close in order, and collects ids and texts."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.display_name = [], [], []

    def handle_starttag(self, tag, attributes):
        self.ids += [value for name, value in attributes if name == "id"]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, _, attributes):
        self.ids += [value for name, value in attributes if name == "id"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.display_name.append(data)


def parse_page(page):
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    return tags


def text_of(page):
    return " ".join(" ".join(parse_page(page).display_name).split())


@pytest.fixture(scope="module")
def recording():
    return simulated_recording()[0]


@pytest.fixture(scope="module")
def calibration(recording):
    return calibrate(recording)


@pytest.fixture(scope="module")
def page(calibration, recording):
    row = Comparison("truth", (12.0, -7.5, 21.0), (44.98, 48.54, 51.45))
    return calibration_report(calibration, recording, note="SIMULATED data", comparison=[row])


def test_the_page_is_well_formed_with_pictures_and_unique_ids(page):
    tags = parse_page(page)
    assert page.count("<figure") == 4
    assert page.count("<svg ") == 6 + 2 + 2 + 1  # a panel each
    assert len(tags.ids) == len(set(tags.ids))


def test_the_page_loads_nothing(page):
    assert "<script" not in page
    assert "@import" not in page
    sources = re.findall(r'(?:href|src)="([^"]*)"', page) + re.findall(r"url\(([^)]*)\)", page)
    assert sources
    assert all(source.startswith(("#", "data:")) for source in sources)


def test_references_inside_the_pictures_resolve(page):
    ids = set(parse_page(page).ids)
    for target in re.findall(r'href="#([^"]*)"', page) + re.findall(r"url\(#([^)]*)\)", page):
        assert target in ids


def test_the_page_starts_with_result_note_and_comparison(page):
    text = text_of(page)
    assert "most samples were rejected there. Offset (11.9" in text
    assert "samples were rejected, mainly between 3" in text
    assert "SIMULATED data" in text
    assert "truth 12.00 −7.50 21.00 44.98 48.54 51.45" in text


@pytest.mark.e2e
def test_the_headline_marks_doubtful_results():
    points = noisy_ellipsoid()
    points[:120] += torch.tensor([0.0, 0.0, 60.0])
    doubtful = recorded(points)
    assert "Calibrated, but read the warnings." in text_of(calibration_report(calibrate(doubtful), doubtful))


def test_the_python_code_equals_the_calibration(calibration, recording):
    measured = recording.magnetometer().numpy()
    names = {"measured": measured}
    exec(wording.python_code(calibration), names)
    expected = calibration.corrected(recording.magnetometer())
    torch.testing.assert_close(torch.from_numpy(names["field"]), expected, rtol=1e-6, atol=1e-5)


def test_the_c_code_has_float_literals(calibration):
    whole = dataclasses.replace(calibration, center=(1.0, 2.5e-7, -3.0))
    assert "{1.0f, 2.5e-07f, -3.0f}" in wording.c_code(whole)


@pytest.mark.e2e
def test_names_and_warnings_are_escaped(calibration, recording):
    hostile = dataclasses.replace(calibration, recording="<b>x</b>", warnings=("a < b & c",))
    shown = calibration_report(hostile, recording)
    assert "<b>x</b>" not in shown
    assert "a &lt; b &amp; c" in shown


@pytest.mark.e2e
def test_a_page_has_the_units_of_the_recording():
    points = noisy_ellipsoid()
    columns = dict(zip(("mag_x", "mag_y", "mag_z"), (20 * points).unbind(-1), strict=True))
    counts = Recording(columns, units=dict.fromkeys(columns, "counts"))
    text = text_of(calibration_report(calibrate(counts), counts))
    assert "µT" not in text.replace("a field in µT", "")
    assert "residual (counts)" in text
    both = calibrate(counts, field_strength=48.0)
    assert "µT per counts" in text_of(calibration_report(both, counts))


@pytest.mark.e2e
@pytest.mark.parametrize("factor", [1e-30, 1e-6, 1e6, 1e30])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_recordings_of_extreme_scales_have_a_page_without_nan(factor, noise):
    huge = recorded(factor * noisy_ellipsoid(noise=noise))
    text = text_of(calibration_report(calibrate(huge), huge))
    assert "recorded units" in text
    assert "nan" not in text.casefold().split()


@pytest.mark.e2e
@pytest.mark.parametrize("count", [12, 30, 400])
def test_small_and_exact_recordings_have_a_page(count):
    exact = recorded(noisy_ellipsoid(count, noise=0.0))
    assert "Calibrated" in text_of(calibration_report(calibrate(exact), exact))


@pytest.mark.e2e
def test_a_recording_without_time_has_a_page():
    plain = recorded(noisy_ellipsoid(100))
    assert "Calibrated." in text_of(calibration_report(calibrate(plain), plain))


def test_the_refusal_page_names_the_missing_directions_and_the_motion():
    points = noisy_ellipsoid(600)
    cap = recorded(points[points[:, 2] < -10.0])
    with pytest.raises(NotIdentifiableError) as refused:
        calibrate(cap)
    shown = refusal_report(cap, refused.value)
    text = text_of(shown)
    assert "not identifiable" in text
    assert "no calibration was written" in text
    assert "+z" in text
    assert "figure of eight" in text
    assert shown.count("<svg ") == 1


def test_the_refusal_page_of_a_sensor_at_rest_has_no_map():
    still = recorded(torch.ones(50, 3, dtype=torch.float64))
    with pytest.raises(NotIdentifiableError) as refused:
        calibrate(still)
    assert "<svg " not in refusal_report(still, refused.value)


@pytest.mark.e2e
def test_a_page_does_not_change_the_settings_of_matplotlib(calibration, recording):
    import matplotlib

    before = dict(matplotlib.rcParams)
    calibration_report(calibration, recording)
    assert dict(matplotlib.rcParams) == before


@pytest.mark.e2e
def test_same_input_gives_the_same_page(calibration, recording):
    assert calibration_report(calibration, recording) == calibration_report(calibration, recording)


@pytest.mark.e2e
def test_numbers_of_any_size_are_written_in_a_power_of_ten(recording):
    columns = {name: 1e-6 * values for name, values in recording.columns.items() if name != "time"}
    tiny = Recording(columns | {"time": recording["time"]}, units=dict.fromkeys(columns, "T"))
    text = text_of(calibration_report(calibrate(tiny), tiny))
    assert "± standard error, 10⁻⁶ T" in text
    assert re.search(r"Offset \(11\.\d+, −7\.\d+, 2\d\.\d+\) × 10⁻⁶ T", text)
    assert not re.search(r"± 0\.0+(?!\d)", text)
    strong = calibrate(tiny, field_strength=50.0)
    assert "Calibration matrix, 10⁶ µT per T" in text_of(calibration_report(strong, tiny))


def test_the_noise_is_in_the_units_of_the_recording(calibration, page):
    assert wording.noise(calibration).startswith("0.47")
    assert f"The noise is {wording.noise(calibration)}." in text_of(page)


@pytest.mark.e2e
def test_only_the_heavy_tail_test_decides_whether_the_noise_is_gaussian(calibration, recording):
    heavy = dataclasses.replace(calibration, tails=ChannelTails(31.5, 0.041, 0.006))
    share = "heavy-tailed: 4.1 ± 0.6 % of the residuals beyond three times that (0.27 % if Gaussian)"
    assert wording.noise(heavy).endswith(share)
    gaussian = dataclasses.replace(calibration, sigma=4.35, tails=ChannelTails(1.3, 0.0027, 0.001))
    assert wording.noise(gaussian).endswith("along the field, Gaussian")
    assert "no heavier than chance makes that of Gaussian noise" in text_of(calibration_report(gaussian, recording))
    # a calibration without the test states sigma
    assert wording.noise(dataclasses.replace(calibration, sigma=4.35, tails=None)).endswith("field, σ = 4.35")


@pytest.mark.e2e
def test_text_in_backticks_is_code(calibration, recording):
    shown = dataclasses.replace(calibration, warnings=("run `mkc <x>` & so on", "one ` alone"))
    html = calibration_report(shown, recording)
    assert "run <code>mkc &lt;x&gt;</code> &amp; so on" in html
    assert "one ` alone" in html


@pytest.mark.e2e
def test_warnings_about_the_file_do_not_make_the_result_doubtful(recording):
    time = recording["time"].clone()
    time[2000:] += 30.0
    gap = Recording(dict(recording.columns) | {"time": time})
    text = text_of(calibration_report(calibrate(gap), gap))
    assert "Calibrated. Disturbed from 37.8" in text
    assert "The time has 1 gap" in text


@pytest.mark.e2e
def test_the_page_of_many_rejected_samples_has_the_command_of_the_diagnosis():
    points = noisy_ellipsoid()
    points[:120] += torch.tensor([0.0, 0.0, 60.0])
    doubtful = recorded(points)
    assert "mkc diagnose RECORDING.csv --simulation magnetometer" in text_of(
        calibration_report(calibrate(doubtful), doubtful)
    )


def test_the_refusal_page_reports_excluded_values():
    points = noisy_ellipsoid(600)
    cap = points[points[:, 2] < -10.0]
    cap[3, 0] = 1e9
    refused_one = recorded(cap)
    with pytest.raises(NotIdentifiableError) as refused:
        calibrate(refused_one)
    assert "mag_x is 1e+09" in text_of(refusal_report(refused_one, refused.value))


def test_sizes_are_rounded_to_three_digits():
    assert wording.size(1234.5) == "1234"
    assert wording.size(1e-9) == "1.00e-09"
    assert wording.size(math.inf) == "inf"
    assert wording.number(-0.0, 2) == "0.00"


@pytest.mark.parametrize("times", [1.0, 3000.0])
def test_texts_of_pictures_are_inside_the_picture_and_do_not_overlap(recording, monkeypatch, times):
    """Also for counts of six digits."""
    columns = {name: values * (times if name.startswith("mag") else 1.0) for name, values in recording.columns.items()}
    counts = Recording(columns, units=dict.fromkeys(("mag_x", "mag_y", "mag_z"), "counts"))
    figures = []
    monkeypatch.setattr(panels, "svg", lambda figure, *_: figures.append(figure) or "")
    calibration_report(calibrate(counts), counts)
    assert len(figures) == 11
    for figure in figures:
        FigureCanvasAgg(figure).draw()
        texts = [_texts(ax) for ax in figure.axes]
        for box in itertools.chain(*texts):
            assert box.x0 >= -2.0
            assert box.y0 >= -2.0
            assert box.x1 <= figure.bbox.width + 2.0
            assert box.y1 <= figure.bbox.height + 2.0
        for item, other in itertools.combinations(texts, 2):
            assert not any(a.overlaps(b) for a in item for b in other)


def _texts(ax):
    """Return the boxes, in pixels, of the visible labels and titles of a panel."""
    low, high = sorted(ax.get_xlim())
    ticks = [label for label in ax.get_xticklabels() if low <= label.get_position()[0] <= high]
    low, high = sorted(ax.get_ylim())
    ticks += [label for label in ax.get_yticklabels() if low <= label.get_position()[1] <= high]
    texts = [*ticks, ax.xaxis.label, ax.yaxis.label, *ax.texts, ax.title, ax._left_title]
    return [text.get_window_extent() for text in texts if text.get_visible() and text.get_text()]
