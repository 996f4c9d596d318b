"""The earth's field at a place, and what it adds for a vehicle that hardly tilts."""

import datetime
import math
from pathlib import Path

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.calibration import calibrate, earth_field
from mkc_torch.calibration.aided.place import Field, parsed_date, parsed_place


def test_the_field_equals_the_test_values_of_the_model():
    ahrs = pytest.importorskip("ahrs")
    lines = (Path(ahrs.__file__).parent / "utils/WMM2025/WMM2025_TEST_VALUES.txt").read_text().splitlines()
    rows = [list(map(float, line.split())) for line in lines if line.strip() and not line.startswith("#")]
    assert len(rows) >= 10
    for year, height, latitude, longitude, _, _, _, _, total, dip, east, *_ in rows:
        begin = datetime.date(int(year), 1, 1)
        date = begin + datetime.timedelta(days=round((year % 1) * 365.25))
        field = earth_field(latitude, longitude, 1e3 * height, date)
        assert field.strength == pytest.approx(1e-3 * total, abs=0.02)
        assert math.degrees(field.inclination) == pytest.approx(dip, abs=0.03)
        assert math.degrees(field.declination) == pytest.approx(east, abs=0.06)


@pytest.mark.parametrize(
    ("place", "date", "words"),
    [
        ((91.0, 0.0, 0.0), (2026, 1, 1), "latitude"),
        ((0.0, 361.0, 0.0), (2026, 1, 1), "longitude"),
        ((0.0, math.nan, 0.0), (2026, 1, 1), "longitude"),
        ((0.0, 0.0, 1e7), (2026, 1, 1), "altitude"),
        ((0.0, 0.0, 0.0), (2031, 1, 1), "2029-12-31"),
        ((0.0, 0.0, 0.0), (1999, 1, 1), "2015"),
    ],
)
def test_places_and_dates_out_of_range_are_refused(place, date, words):
    with pytest.raises(ValueError, match=words):
        earth_field(*place, datetime.date(*date))


@pytest.mark.parametrize("text", ["", "48", "48,x", "1,2,3,4", "nan,1"])
def test_a_place_other_than_two_or_three_numbers_is_refused(text):
    with pytest.raises(ValueError, match="LAT,LON"):
        parsed_place(text)


def test_a_date_in_another_format_is_refused():
    assert parsed_date(" 2026-05-01") == datetime.date(2026, 5, 1)
    with pytest.raises(ValueError, match="YYYY-MM-DD"):
        parsed_date("1.5.2026")


@pytest.mark.e2e
def test_a_place_determines_the_vertical_offset_of_a_level_vehicle():
    draw = torch.Generator().manual_seed(4)
    yaw = torch.linspace(0.0, 20.0, 900, dtype=torch.float64)
    field = torch.stack([20.0 * yaw.sin(), 20.0 * yaw.cos(), torch.full_like(yaw, -42.0)], -1)
    seen = field + torch.tensor([5.0, -8.0, 60.0]) + 0.3 * torch.randn(900, 3, generator=draw)
    zero = torch.zeros_like(yaw)
    q = torch.stack([torch.cos(0.5 * yaw), zero, zero, torch.sin(0.5 * yaw)], -1)
    columns = {"time": torch.arange(900) / 20.0}
    columns |= dict(zip(("mag_x", "mag_y", "mag_z", "q_w", "q_x", "q_y", "q_z"), torch.cat([seen, q], -1).unbind(-1),
                        strict=True))  # fmt: skip
    recording = Recording(columns)
    without = calibrate(recording)
    assert "offset_z" in without.aid.undetermined
    assert math.isinf(without.center_se[2])
    known = Field(math.hypot(20.0, 42.0), math.atan2(42.0, 20.0), 0.0)
    c = calibrate(recording, earth=known)
    assert "offset_z" not in c.aid.undetermined
    assert abs(c.center[2] - 60.0) < 3.0 * c.center_se[2] < 20.0
    assert c.field_strength == pytest.approx(known.strength)
