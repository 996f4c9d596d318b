"""The comparison of the calibrations of several sensors."""

import torch

from mkc_torch import Recording
from mkc_torch.calibration import calibrate
from mkc_torch.calibration.coverage import fibonacci_sphere
from mkc_torch.report.fleet import fleet_of_calibrations, fleet_report
from mkc_torch.report.fleet.sentences import conclusions


def calibrations(offsets):
    """Sensors whose offset along x differs."""
    found = {}
    for number, offset in enumerate(offsets):
        g = torch.Generator().manual_seed(number)
        field = 50.0 * fibonacci_sphere(300).double() * torch.tensor([1.1, 1.0, 0.9])
        noise = 0.3 * torch.randn(300, 3, generator=g, dtype=torch.float64)
        measured = field + noise + torch.tensor([offset, -4.0, 2.0])
        columns = {f"mag_{axis}": measured[:, k] for k, axis in enumerate("xyz")}
        found[f"sensor{number}"] = calibrate(Recording(columns, units=dict.fromkeys(columns, "µT")))
    return found


def test_offsets_of_the_sensors_have_their_spread_and_gains_agree():
    fleet = fleet_of_calibrations(calibrations([10.0, 11.0, 9.0, 10.5, 9.5, 20.0]))
    own = {(each.effect, each.place): each for each in fleet.quantities}
    along = own["offset", "x"]
    assert [each.unit for each in along.departing] == [5]
    assert along.rest is not None
    assert abs(along.rest.mean - 10.0) < 0.2
    assert abs(along.rest.spread - 0.79) < 0.1
    for place in "yz":
        assert own["offset", place].pooled.agree
        assert own["gain", place].pooled.agree
    assert len(own) == 9
    text = " ".join(conclusions(fleet))
    assert "Offset, x in all 6 recordings: mean 11" in text
    assert "`sensor5` departs from the others: 20.0" in text


def test_the_page_names_what_was_done():
    page = fleet_report(fleet_of_calibrations(calibrations([1.0, 2.0]), {"broken.csv": "no samples"}))
    assert "2 of 3 recordings calibrated, 2 usable" in page
    assert "Not calibrated:" in page
    assert "length of the field" in page
    assert "held-out" not in page
