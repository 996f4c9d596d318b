"""``calibration.plot``: the report's plots on axes, and a calibration in a notebook."""

import re

import numpy as np
import pytest
import torch

pytest.importorskip("matplotlib")

from matplotlib import pyplot

from mkc_torch.calibration import Calibration, CalibrationPlot, calibrate
from mkc_torch.calibration.plot import _covered
from mkc_torch.recording import simulated_recording

PICTURES = {
    "sphere": lambda plot, **more: plot.sphere(**more),
    "residual": lambda plot, **more: plot.residual(**more),
    "weights": lambda plot, **more: plot.weights(**more),
    "density": lambda plot, **more: plot.density(**more),
    "coverage": lambda plot, **more: plot.coverage(**more),
}


@pytest.fixture(scope="module")
def recording():
    return simulated_recording()[0].rows(np.arange(0, 4500, 5))


@pytest.fixture(scope="module")
def calibration(recording):
    return calibrate(recording)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    pyplot.close("all")


def test_every_plot_method_has_a_test_case():
    assert {name for name in vars(CalibrationPlot) if not name.startswith("_")} == set(PICTURES)


@pytest.mark.parametrize("name", PICTURES)
def test_each_plot_is_drawn_on_given_axes_or_on_a_new_figure(calibration, name):
    projection = "mollweide" if name == "coverage" else None
    given = pyplot.figure().add_subplot(projection=projection)
    assert PICTURES[name](calibration.plot, ax=given) is given
    assert given.has_data()
    new = PICTURES[name](calibration.plot)
    assert new.get_title() == given.get_title() or name == "weights"


def test_plots_show_names_units_and_every_sample(calibration, recording):
    ax = calibration.plot.residual()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time (s)", "residual (µT)")
    dots = [line for line in ax.lines if line.get_marker() == "."]
    assert sum(len(line.get_xdata()) for line in dots) == len(recording)
    rejected = next(line for line in dots if line.get_label() == "rejected")
    assert len(rejected.get_xdata()) == calibration.rejected
    measured, corrected = calibration.plot.sphere("xy"), calibration.plot.sphere("xy", corrected=True)
    assert measured.get_xlabel() == "x (µT)"
    outline = max(corrected.lines, key=lambda line: len(line.get_xdata()) == 361)
    radius = np.hypot(outline.get_xdata(), outline.get_ydata())
    np.testing.assert_allclose(radius, calibration.field_strength, rtol=1e-12)


def test_weights_equal_those_of_the_fit(calibration, recording):
    ax = calibration.plot.weights()
    shown = np.sort(np.concatenate([line.get_ydata() for line in ax.lines]))
    np.testing.assert_array_equal(shown, np.sort(calibration.weight(recording.magnetometer()).numpy()))


def test_a_calibration_from_a_file_needs_a_recording(calibration, recording):
    read = Calibration.from_json(calibration.to_json())
    assert read == calibration
    with pytest.raises(ValueError, match="has no samples to draw; pass its recording"):
        read.plot.residual()
    assert read.plot.residual(recording=recording).has_data()


def test_an_unknown_plane_and_bad_axes_are_refused(calibration):
    with pytest.raises(ValueError, match=r"`plane`.*xy, xz, yz.*got 'zx'"):
        calibration.plot.sphere("zx")
    with pytest.raises(ValueError, match=r"projection 'mollweide'.*got 'rectilinear'"):
        calibration.plot.coverage(ax=pyplot.subplots()[1])
    with pytest.raises(TypeError, match="got int"):
        calibration.plot.density(ax=1)


def test_a_notebook_shows_numbers_with_their_errors(calibration):
    page = calibration._repr_html_()
    cells = [float(v.replace("−", "-")) for v in re.findall(r">(−?[\d.]+) ±", page)]
    np.testing.assert_allclose(cells, [*calibration.center, *calibration.semi_axes], atol=0.02)
    assert "rejected" in page
    assert repr(calibration).startswith("Calibration('simulated_sensor', 900 samples")
    assert len(repr(calibration)) < 200


@pytest.mark.parametrize("count", [1, 30, 4000])
def test_covered_directions_are_near_a_sample(count):
    lon, lat = np.meshgrid(np.linspace(-3.1, 3.1, 25), np.linspace(-1.5, 1.5, 13))
    directions = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions[:, 2] = directions[:, 2].abs()  # half of the sphere
    grid = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
    unit = (directions / directions.norm(dim=-1, keepdim=True)).numpy()
    near = (grid @ unit.T).max(-1) > np.cos(np.radians(15.0))
    assert 0.0 < near.mean() < 1.0
    np.testing.assert_array_equal(_covered(lon, lat, directions), near.astype(float))
