"""`mkc apply` refuses a recording in another unit than the calibrated recording, for every kind of file."""

import dataclasses

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")

from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.recording.recording import Recording, write_table
from mkc_torch.recording.unit_words import factors
from tests.calibration.test_other_sensors import laid_down
from tests.cli.commands import assert_refused, flat, mkc
from tests.diagnosis.files.test_sensor_correction import model_of

OFFSET = torch.tensor([30.0, -35.0, 33.0], dtype=torch.float64)  # its length is 1.2 times the field's
COUNT = 400


def directions():
    return torch.nn.functional.normalize(
        torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1
    )


def table(path, points, quantity="mag"):
    axes = {f"{quantity}_{axis}": points[:, k] for k, axis in enumerate("xyz")}
    write_table(path, {"time": torch.arange(len(points)) / 50.0, **axes}, overwrite=True)
    return path


def recorded(points, quantity="mag"):
    return Recording({f"{quantity}_{axis}": points[:, k] for k, axis in enumerate("xyz")}, name="made")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files of each kind that `mkc apply` takes, made in µT, in counts, or in m/s²."""
    place = tmp_path_factory.mktemp("kinds")
    points = 48.0 * directions() + OFFSET
    of_field = calibrate(recorded(points))
    counts = dataclasses.replace(calibrate(recorded(150.0 * points)), unit="counts", field_unit="counts")
    theta = (*OFFSET.tolist(), 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    texts = {
        "calibration": of_field.to_json(),
        "counts": counts.to_json(),
        "accel": calibrate(recorded(laid_down().double(), "accel"), sensor="accel").to_json(),
        "model": model_of([], [], theta=theta).to_json(),
    }
    for name, text in texts.items():
        (place / f"{name}.json").write_text(text, encoding="utf-8")
    return place


@pytest.mark.parametrize(("kind", "more"), [("calibration", ()), ("calibration", ("--ros",)), ("model", ())])
@pytest.mark.parametrize("unit", ["gauss", "mG", "nT", "tesla"])
@pytest.mark.parametrize("turned", [True, False])
def test_a_field_in_an_unnamed_other_unit_is_refused(files, tmp_path, kind, more, unit, turned):
    points = 48.0 * (directions() if turned else directions()[:1].expand(COUNT, 3)) + OFFSET
    path = table(tmp_path / "new.csv", points / factors("mag")[unit])
    command = ("apply", files / f"{kind}.json", path, "--output", tmp_path / "out.csv", *more)
    assert_refused(mkc(*command), f"`--convert mag={unit}`")
    assert not (tmp_path / "out.csv").exists()
    result = mkc(*command, "--convert", f"mag={unit}")
    assert result.exit_code == 0, result.output
    assert "warning: the corrected field" not in flat(result.stdout)


@pytest.mark.parametrize(
    ("kind", "points", "quantity", "words"),
    [
        ("counts", directions() * 48.0 + OFFSET, "mag", "`--unit-label counts`"),
        ("accel", laid_down().double() / 9.80665, "accel", "`--convert accel=g`"),
        ("calibration", 40.0 * (48.0 * directions() + OFFSET), "mag", "more than between any two places"),
    ],
)
def test_a_recording_outside_the_calibrated_range_is_refused(files, tmp_path, kind, points, quantity, words):
    path = table(tmp_path / "new.csv", points, quantity)
    assert_refused(mkc("apply", files / f"{kind}.json", path, "--output", tmp_path / "out.csv"), words)


@pytest.mark.parametrize(
    ("kind", "points", "quantity"),
    [
        ("calibration", 48.0 * directions() + OFFSET, "mag"),
        ("calibration", 27.0 * directions() + OFFSET, "mag"),  # another place
        ("calibration", 48.0 * directions()[:1].expand(COUNT, 3) + OFFSET, "mag"),  # at rest
        ("calibration", 0.3 * directions()[:1].expand(COUNT, 3), "mag"),  # the offset cancels the field
        ("counts", 150.0 * (48.0 * directions() + OFFSET), "mag"),
        ("model", 48.0 * directions() + OFFSET, "mag"),
        ("accel", laid_down().double(), "accel"),
    ],
)
def test_a_recording_in_the_calibrated_unit_is_corrected(files, tmp_path, kind, points, quantity):
    if float(points.abs().max()) < 1.0:  # the field that the offset cancels
        at_rest = calibrate(recorded(48.0 * directions() + OFFSET * 48.0 / float(OFFSET.norm())))
        (tmp_path / f"{kind}.json").write_text(at_rest.to_json(), encoding="utf-8")
        files = tmp_path
    path = table(tmp_path / "new.csv", points, quantity)
    result = mkc("apply", files / f"{kind}.json", path, "--output", tmp_path / "out.csv")
    assert result.exit_code == 0, result.output


def test_a_stated_unit_is_compared_by_name_for_an_accelerometer(files, tmp_path):
    path = table(tmp_path / "new.csv", laid_down().double() / 9.80665, "accel")
    command = ("apply", files / "accel.json", path, "--output", tmp_path / "out.csv", "--convert", "accel=g")
    assert mkc(*command).exit_code == 0
