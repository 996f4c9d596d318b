"""Vehicles that hardly tilt: what a gyroscope or an attitude determines, and what remains undetermined."""

import json
import math

import pytest
import torch

from mkc_torch.calibration import Calibration, NotIdentifiableError, calibrate
from mkc_torch.calibration.aided import select_response
from mkc_torch.calibration.aided.mounting import mounting, without_exchange
from mkc_torch.calibration.aided.turns import turns_of_attitude, turns_of_gyroscope
from mkc_torch.report import calibration_report
from tests.calibration.aided.vehicle import example, quaternions, with_columns
from tests.shared_data import shared_data

MAG, GYRO, Q = (tuple(f"{name}_{a}" for a in axes) for name, axes in (("mag", "xyz"), ("gyro", "xyz"), ("q", "wxyz")))


@pytest.fixture(autouse=True, scope="module")
def few_samples():
    """Fits on a third of the samples, for speed."""
    kept, select_response._MOST = select_response._MOST, 1000
    yield
    select_response._MOST = kept


@pytest.fixture(scope="module")
def simulated():
    return example().drawn(1, 8.0, 15.0, seconds=60.0)


@pytest.fixture(scope="module")
def calibrated(simulated):
    return calibrate(simulated.recording)


def heading(draw, c):
    return example().heading_errors(draw, torch.tensor(c.center).double(), torch.tensor(c.matrix).double())


@pytest.mark.e2e
def test_a_gyroscope_determines_a_heading_that_an_ellipsoid_does_not(simulated, calibrated):
    assert float(heading(simulated, calibrated).square().mean().sqrt()) < 2.0
    with pytest.raises(NotIdentifiableError):
        calibrate(with_columns(simulated.recording, drop=GYRO))
    least = example().by_least_squares(simulated)
    assert least is None or float(least.square().mean().sqrt()) > 4.0


@pytest.mark.e2e
def test_the_gyroscope_is_reported_as_aid_with_valid_standard_errors(simulated, calibrated):
    aid = calibrated.aid
    assert (aid.by, aid.response) == ("gyroscope", "full matrix")
    assert {name for name, value in aid.evidence if value == 0.0} == {"full matrix"}
    assert any(
        "the gyroscope replaces the missing turns" in w and "Not identifiable" not in w for w in calibrated.notes
    )
    off = (torch.tensor(calibrated.center).double() - simulated.offset) / torch.tensor(calibrated.center_se).double()
    assert float(off.abs().max()) < 4.0
    assert 0.0 < aid.heading_error < 1.5
    assert 0.05 < calibrated.rejected_share < 0.25


@pytest.mark.slow
def test_the_gyroscopes_bias_is_estimated():
    draw = example().drawn(2, 8.0, 15.0, seconds=60.0)
    bias = torch.tensor([0.01, -0.02, 0.03]).double()
    rates = {name: draw.recording[name] + b for name, b in zip(GYRO, bias.tolist(), strict=True)}
    before, after = calibrate(draw.recording).aid, calibrate(with_columns(draw.recording, **rates)).aid
    moved = torch.tensor(after.gyro_bias).double() - torch.tensor(before.gyro_bias).double()
    assert float((moved - bias).abs().max()) < 1e-3


@pytest.mark.e2e
def test_json_round_trips_and_old_files_are_read(calibrated):
    content = json.loads(calibrated.to_json())
    assert content["schema"] == "mkc-calibration/1"
    assert content["aided"]["by"] == "gyroscope"
    assert Calibration.from_json(calibrated.to_json()) == calibrated
    del content["aided"], content["rejected"]["interval_unit"]
    old = Calibration.from_json(json.dumps(content))
    assert (old.aid, old.disturbed_unit) == (None, "s")


@pytest.mark.e2e
def test_the_report_names_the_aid(simulated, calibrated):
    page = calibration_report(calibrated, simulated.recording)
    assert "By the gyroscope: offset and full matrix" in page
    assert "Gyroscope bias" in page


def level_vehicle(seconds=30.0, rate=50.0, noise=0.3):
    """A vehicle that only turns about its vertical, and its heading."""
    draw = torch.Generator().manual_seed(3)
    t = torch.arange(round(seconds * rate), dtype=torch.float64) / rate
    yaw_rate = 0.5 + 0.3 * torch.sin(0.4 * t)
    yaw = torch.cat([torch.zeros(1), (0.5 * (yaw_rate[1:] + yaw_rate[:-1]) / rate).cumsum(0)]).double()
    field = torch.stack([20.0 * yaw.sin(), 20.0 * yaw.cos(), torch.full_like(yaw, -40.0)], -1)
    seen = field + torch.tensor([5.0, -8.0, 12.0]) + noise * torch.randn(len(t), 3, generator=draw)
    rates = torch.stack([0 * yaw, 0 * yaw, yaw_rate], -1) + 1e-3 * torch.randn(len(t), 3, generator=draw)
    columns = dict(zip((*MAG, *GYRO), torch.cat([seen, rates], -1).unbind(-1), strict=True))
    return t, yaw, columns


def test_the_vertical_offset_of_a_level_vehicle_is_reported_as_undetermined():
    t, yaw, columns = level_vehicle()
    c = calibrate(
        with_columns(example().drawn(0, seconds=1.0).recording, drop=(*MAG, *GYRO, "time"), time=t, **columns)
    )
    assert "offset_z" in c.aid.undetermined
    assert math.isinf(c.center_se[2])
    assert json.loads(c.to_json())["center"]["standard_error"][2] is None
    assert c.center[:2] == pytest.approx((5.0, -8.0), abs=0.5)
    assert any("Not determined: the offset of z" in w for w in c.warnings)
    # and a level heading is still accurate
    field = c.corrected(torch.stack([columns[name] for name in MAG], -1))
    off = torch.rad2deg(torch.atan2(field[:, 0], field[:, 1]) - yaw)
    off = (off + 180.0) % 360.0 - 180.0
    assert float((off - off.median()).abs().median()) < 1.0
    assert c.aid.heading_error < 1.0
    assert "nan" not in c.to_json().lower()


@pytest.mark.e2e
def test_an_attitude_determines_offset_and_matrix(simulated):
    q = quaternions(simulated.to_world)
    c = calibrate(with_columns(simulated.recording, drop=GYRO, **dict(zip(Q, q.unbind(-1), strict=True))))
    assert c.aid.by == "attitude"
    assert c.aid.gyro_bias is None
    assert float(heading(simulated, c).square().mean().sqrt()) < 1.0
    off = (torch.tensor(c.center).double() - simulated.offset) / torch.tensor(c.center_se).double()
    assert float(off.abs().max()) < 4.0


@pytest.mark.parametrize(("gains", "chosen"), [((1.0, 1.0, 1.0), "offset"), ((1.06, 0.95, 1.0), "offset and scale")])
def test_the_simplest_response_that_explains_the_recording_is_selected(simulated, gains, chosen):
    draw = torch.Generator().manual_seed(5)
    q = quaternions(simulated.to_world)
    body = simulated.to_world.mT @ torch.tensor([0.0, 22.0, -40.0]).double()
    seen = body * torch.tensor(gains) + torch.tensor([10.0, -5.0, 3.0]) + 0.5 * torch.randn(len(q), 3, generator=draw)
    columns = dict(zip((*MAG, *Q), torch.cat([seen, q], -1).unbind(-1), strict=True))
    c = calibrate(with_columns(simulated.recording, drop=(*GYRO, *MAG), **columns))
    assert c.aid.response == chosen
    off = (torch.tensor(c.center).double() - torch.tensor([10.0, -5.0, 3.0])) / torch.tensor(c.center_se).double()
    assert float(off.abs().max()) < 4.0
    assert torch.tensor(c.semi_axes).div(c.radius).tolist() == pytest.approx(
        sorted(g / math.prod(gains) ** (1 / 3) for g in gains), abs=0.01
    )
    assert c.aid.undetermined == ()


@pytest.mark.e2e
def test_a_gyroscope_with_other_axes_or_units_is_refused_with_the_reason(simulated):
    r = simulated.recording
    swapped = {"mag_x": r["mag_y"], "mag_y": r["mag_x"]}
    with pytest.raises(NotIdentifiableError, match=r"With the gyroscope: .*x and y seem exchanged"):
        calibrate(with_columns(r, **swapped))
    with pytest.raises(NotIdentifiableError, match="With the gyroscope: the gyroscope does not turn like the field"):
        calibrate(with_columns(r, **{name: 57.3 * r[name] for name in GYRO}))


def test_a_response_with_exchanged_axes_is_reported():
    sentence, rest = without_exchange(
        torch.tensor([[0.1, 9.0, 0.0], [0.0, 0.0, -8.0], [7.0, 0.0, 0.2]]).double(), "gyroscope"
    )
    assert "x is z of the magnetometer, y is x of the magnetometer, z is minus y" in sentence
    assert bool((rest.diagonal() > 6.0).all())
    assert without_exchange(torch.eye(3).double(), "gyroscope")[0] == ""


@pytest.mark.parametrize(
    ("order", "signs", "words"),
    [
        ((0, 1, 2), (1, 1, 1), None),
        ((0, 2, 1), (1, 1, 1), "y and z seem exchanged"),
        ((0, 1, 2), (1, -1, 1), "y seems to have the other sign"),
        ((2, 0, 1), (1, 1, 1), "axes seem to differ from the attitude's"),
    ],
)
def test_exchanged_axes_and_signs_are_detected_by_the_attitude(simulated, order, signs, words):
    turns = turns_of_attitude(quaternions(simulated.to_world))
    body = (simulated.to_world.mT @ simulated.field) @ simulated.response.mT + simulated.offset
    seen = body[:, list(order)] * torch.tensor(signs)
    found = mounting(seen, turns, torch.zeros_like(turns.window), float(simulated.field.norm()), "attitude")
    assert found is None if words is None else words in found.sentence


def test_a_sensor_at_rest_is_refused_with_a_gyroscope_too():
    draw = torch.Generator().manual_seed(0)
    columns = {name: 20.0 + 0.3 * torch.randn(600, generator=draw) for name in MAG}
    columns |= {name: 1e-3 * torch.randn(600, generator=draw) for name in GYRO}
    recording = with_columns(example().drawn(0, seconds=1.0).recording, drop=(*MAG, *GYRO, "time"),
                        time=torch.arange(600) / 50.0, **columns)  # fmt: skip
    with pytest.raises(NotIdentifiableError, match="at rest"):
        calibrate(recording)


def test_derivatives_of_the_turns_equal_differences():
    draw = torch.Generator().manual_seed(1)
    time = torch.arange(60, dtype=torch.float64) / 50.0
    rate = torch.randn(60, 3, generator=draw, dtype=torch.float64)
    run = (slice(0, 60),)
    at = turns_of_gyroscope(time, rate, run, torch.zeros(12).double())
    for k in range(12):
        step = torch.zeros(12).double()
        step[k] = 1e-5
        moved = turns_of_gyroscope(time, rate, run, step)
        # errors are subtracted from the rates, and rotate the frame in the opposite direction
        turn = (at.to_frame @ moved.to_frame.mT - torch.eye(3)) / 1e-5
        skew = torch.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
        assert torch.allclose(skew, at.summed[:, :, k], atol=2e-3 * float(at.summed.abs().max()))


@pytest.mark.slow
def test_a_real_quadrotor_is_calibrated_by_its_attitude():
    from mkc_torch import Recording

    recording = Recording.read(shared_data("magnetometer/quadrotor_compass1.csv"))
    c = calibrate(recording)
    assert c.aid.by == "attitude"
    without = {name: values for name, values in recording.columns.items() if name in MAG}
    with pytest.raises(NotIdentifiableError, match=r"\+z"):
        calibrate(Recording(without))
