"""``diagnosis.plot``: the report's pictures as axes that show the numbers of the diagnosis."""

import dataclasses

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from matplotlib import pyplot

import mkc_torch.diagnosis
from tests.diagnosis.factory import make_diagnosis, make_environment


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def found():
    return make_diagnosis(3, samples=300, channels=4, verdict="unexplained", environment=make_environment())


def labels_of(ax):
    """Return the labels of both axes and the title."""
    return ax.get_xlabel(), ax.get_ylabel(), ax.get_title()


PICTURES = {
    "residual": lambda plot, ax: plot.residual(ax=ax),
    "effect": lambda plot, ax: plot.effect(1, ax=ax),
    "over_driver": lambda plot, ax: plot.over_driver(1, ax=ax),
    "held_out": lambda plot, ax: plot.held_out(ax=ax),
    "candidates": lambda plot, ax: plot.candidates(ax=ax),
    "separability": lambda plot, ax: plot.separability(ax=ax),
    "forcing": lambda plot, ax: plot.forcing(ax=ax),
}


@pytest.mark.parametrize("name", PICTURES)
def test_every_picture_is_drawn_on_given_axes_or_on_a_new_figure(found, name):
    given = pyplot.subplots()[1]
    assert PICTURES[name](found.plot, given) is given
    assert given.has_data()
    new = PICTURES[name](found.plot, None)
    assert new is not given
    assert labels_of(new) == labels_of(given)
    assert labels_of(new)[2]


def test_every_plot_method_is_tested():
    methods = {name for name in vars(mkc_torch.diagnosis.DiagnosisPlot) if not name.startswith("_")}
    assert methods == {*PICTURES, "gain_map"}


def test_the_residual_plot_shows_channel_unit_and_samples(found):
    ax = found.plot.residual("turn_y", corrected=False)
    assert labels_of(ax) == ("time (s)", f"residual ({found.traces.unit})", "Before, turn_y")
    samples = max((line.get_ydata() for line in ax.lines if line.get_marker() == "."), key=len)
    before, used = found.traces.before[:, 2].numpy(), found.traces.weight[:, 2].numpy() >= 0.5
    shown = before[used][np.abs(before[used]) <= ax.get_ylim()[1]]
    np.testing.assert_array_equal(samples, shown)


def test_the_residual_plot_is_titled_after_if_there_are_findings(found):
    assert found.plot.residual().get_title() == "After, norm"
    assert make_diagnosis(0, samples=200).plot.residual().get_title().startswith("Residual")


def test_the_effect_plot_shows_the_curve_of_the_finding(found):
    curve = found.findings[1].curve
    ax = found.plot.effect(1)
    lines = [line for line in ax.lines if len(line.get_xdata()) == len(curve.x)]
    np.testing.assert_array_equal(np.stack([line.get_ydata() for line in lines], -1), curve.value.numpy())
    assert curve.driver in ax.get_xlabel()
    assert curve.unit in ax.get_xlabel()


def test_the_held_out_plot_shows_gains_with_their_intervals(found):
    ax = found.plot.held_out()
    known = [f.held_out for f in found.findings if f.held_out is not None]
    points = [float(line.get_xdata()[0]) for line in ax.lines if line.get_marker() == "o"]
    assert points == [one.log_likelihood_gain for one in known]
    spans = [tuple(line.get_xdata()) for line in ax.lines if len(line.get_xdata()) == 2][1:]
    assert spans == [one.confidence_interval for one in known]


def test_the_candidates_plot_has_bars_of_gains_in_the_order_of_the_search(found):
    shown = dataclasses.replace(found, candidates=found.candidates[::-1])
    widths = [bar.get_width() for bar in shown.plot.candidates(5).patches]
    assert widths == [max(c.log_likelihood_gain, 0.0) for c in shown.candidates[:5]]
    assert len(set(widths)) > 1


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (lambda d: d.plot.residual(9), "`channel`.*9.*0 to 3"),
        (lambda d: d.plot.residual("nothing"), "one of norm, turn_x"),
        (lambda d: d.plot.effect(7), "`finding`.*7.*0 to 2"),
        (lambda d: d.plot.over_driver(1, driver="nothing"), "`driver`.*'nothing'; there are"),
        (lambda d: d.plot.forcing(5), "`index`.*5"),
        (lambda d: d.plot.candidates(0), "`most` to be at least 1 but got 0"),
        (lambda d: d.plot.separability(0), "`most` to be at least 1 but got 0"),
        (
            lambda d: dataclasses.replace(d, findings=()).plot.residual(corrected=True),
            "`corrected`.*no finding that counts",
        ),
        (lambda d: dataclasses.replace(d, findings=()).plot.effect(), "no finding was made"),
        (lambda d: dataclasses.replace(d, findings=()).plot.held_out(), "No finding has a gain"),
        (lambda d: dataclasses.replace(d, candidates=()).plot.candidates(), "no candidates"),
    ],
)
def test_arguments_without_a_picture_raise_with_the_valid_values(found, draw, words):
    with pytest.raises(ValueError, match=words):
        draw(found)
    assert pyplot.get_fignums() == []  # no empty figure is left


def test_a_gain_map_is_drawn_or_raises_if_absent(found):
    with_map = next((i for i, f in enumerate(found.findings) if f.map is not None), None)
    if with_map is None:
        with pytest.raises(ValueError, match="no map over two states"):
            found.plot.gain_map()
    else:
        assert found.plot.gain_map(with_map).has_data()


def test_axes_of_another_type_raise(found):
    with pytest.raises(TypeError, match=r"`ax`.*axes of matplotlib or None.*got Figure"):
        found.plot.residual(ax=pyplot.figure())


def test_the_notebook_view_shows_findings_and_escapes_text_from_files(found):
    page = dataclasses.replace(found, recording="<b>x</b>")._repr_html_()
    assert "&lt;b&gt;x" in page
    assert "<b>" not in page
    assert "hard-iron step" in page
    assert "http" not in page
    assert repr(found).startswith("Diagnosis('flight_07' against 'magnetometer': unexplained; hard_iron_step")
    assert len(repr(found)) < 200
