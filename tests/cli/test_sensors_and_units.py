"""Several magnetometers in a file, units, and `mkc inspect`."""

import json
import shlex

import pytest
import torch

pytest.importorskip("typer")
pytest.importorskip("polars")


from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.cli.simulation_option import checked_sensor, checked_units
from mkc_torch.cli.units_option import parsed_units
from mkc_torch.recording.recording import Recording, write_table
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.commands import assert_refused, flat, mkc

COUNT = 300


def calibration(folder):
    return Calibration.from_json((folder / "calibration.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with calibrated tables: of two magnetometers, and of one in nT by its column names."""
    place = tmp_path_factory.mktemp("sensors")
    points, time = noisy_ellipsoid(COUNT), torch.arange(COUNT) / 50.0
    columns = {f"mag0_{a}": points[:, k] for k, a in enumerate("xyz")}
    columns |= {f"mag1_{a}": 1.1 * points[:, k] - 3.0 for k, a in enumerate("xyz")}
    write_table(place / "two.csv", {"time": time} | columns)
    write_table(place / "one.csv", {"time": time} | {f"mag{a} [nT]": 1e3 * points[:, k] for k, a in enumerate("XYZ")})
    write_table(place / "gauss.csv", {"t": 1e3 * time} | {f"mag_{a}": 0.01 * points[:, k] for k, a in enumerate("xyz")})
    for name in ("two", "one"):
        result = mkc("calibrate", place / f"{name}.csv", "--output", place / "out")
        assert result.exit_code == 0, result.output
    return place


def test_each_sensor_has_a_calibration_in_a_folder_of_its_name(folder):
    assert sorted(path.name for path in (folder / "out" / "two").iterdir()) == ["mag0", "mag1"]
    first, second = (calibration(folder / "out" / "two" / name) for name in ("mag0", "mag1"))
    assert first.recording == "two/mag0"
    assert second.center == pytest.approx([1.1 * value - 3.0 for value in first.center], abs=1e-6)
    assert sorted(path.name for path in (folder / "out" / "one").iterdir()) == ["calibration.json", "report.html"]


def test_results_of_several_sensors_are_kept(folder):
    assert_refused(
        mkc("calibrate", folder / "two.csv", "--output", folder / "out"), "two exists and is not empty", "--force"
    )


@pytest.mark.e2e
def test_a_failed_sensor_does_not_stop_the_others(folder, tmp_path):
    table = Recording.read(folder / "two.csv", recognise=False)
    flat_one = dict(table.columns) | {f"mag1_{axis}": torch.full((COUNT,), 20.0) for axis in "xyz"}
    write_table(tmp_path / "a.csv", flat_one)
    result = mkc("calibrate", tmp_path / "a.csv", "--output", tmp_path / "out")
    assert result.exit_code == 1
    assert "a.csv, sensor mag1:" in flat(result.stderr)
    assert "1 of 2 sensors were not calibrated" in flat(result.stderr)
    assert (tmp_path / "out" / "a" / "mag0" / "calibration.json").is_file()


@pytest.mark.e2e
def test_a_single_sensor_can_be_selected(folder, tmp_path):
    result = mkc("calibrate", folder / "two.csv", "--output", tmp_path, "--sensor", "mag1")
    assert result.exit_code == 0, result.output
    assert calibration(tmp_path / "two").center == calibration(folder / "out" / "two" / "mag1").center
    assert_refused(
        mkc("calibrate", folder / "two.csv", "--output", tmp_path / "o", "--sensor", "mag5"), "`mag0`, `mag1`"
    )


def test_apply_requires_the_sensor_of_a_file_with_several(folder, tmp_path):
    model = folder / "out" / "two" / "mag1" / "calibration.json"
    command = ("apply", model, folder / "two.csv", "--output", tmp_path / "o.csv")
    assert_refused(mkc(*command), "2 magnetometers, `mag0`, `mag1`", "--sensor mag0")
    assert mkc(*command, "--sensor", "mag1").exit_code == 0
    written = Recording.read(tmp_path / "o.csv", recognise=False)
    measured = Recording.read(folder / "two.csv", sensor="mag1").magnetometer()
    expected = calibration(model.parent).corrected(measured)
    assert torch.equal(written.stack("field_x", "field_y", "field_z"), expected)
    assert written.names[:7] == ("time", *(f"mag{n}_{axis}" for n in "01" for axis in "xyz"))


def test_apply_converts_units_as_calibrate_does(folder, tmp_path):
    """The same samples in nT by their names, and in gauss by the option, have the same corrected field."""
    model = folder / "out" / "one" / "calibration.json"
    assert calibration(model.parent).unit == "µT"
    named = ("apply", model, folder / "one.csv", "--output", tmp_path / "a.csv")
    asked = ("apply", model, folder / "gauss.csv", "--output", tmp_path / "b.csv", "--convert", "mag=gauss,time=ms")
    for command in (named, asked):
        result = mkc(*command)
        assert result.exit_code == 0, result.output
        assert "converted from" in flat(result.stdout)
    axes = ("field_x", "field_y", "field_z")
    first, second = (Recording.read(tmp_path / name, recognise=False).stack(*axes) for name in ("a.csv", "b.csv"))
    torch.testing.assert_close(first, second, rtol=0.0, atol=1e-9)


def test_apply_reports_different_units(folder, tmp_path):
    model = folder / "out" / "one" / "calibration.json"
    command = ("apply", model, folder / "one.csv", "--output", tmp_path / "a.csv", "--unit-label", "counts")
    assert_refused(mkc(*command), "is in counts, but the calibrated recording was in µT")
    assert_refused(mkc("apply", model, folder / "gauss.csv", "--output", tmp_path / "b.csv"), "`--convert mag=gauss`")


@pytest.mark.parametrize("texts", [["mag=gauss,time=ms"], ["mag=gauss", "time=ms"], ["mag=gauss time=ms"]])
def test_units_can_be_given_in_a_single_option_or_in_several(texts):
    assert parsed_units(texts) == {"mag": "gauss", "time": "ms"}


@pytest.mark.e2e
def test_a_probable_unit_is_refused_and_a_given_unit_is_converted(folder, tmp_path):
    path = folder / "gauss.csv"
    assert_refused(mkc("calibrate", path, "--output", tmp_path / "no"), "in gauss", "`--convert mag=gauss`")
    assert not (tmp_path / "no" / "gauss").exists()
    result = mkc("calibrate", path, "--output", tmp_path / "out", "--convert", "mag=gauss", "time=ms")
    assert result.exit_code == 0, result.output
    found, expected = calibration(tmp_path / "out" / "gauss"), calibration(folder / "out" / "one")
    assert found.center == pytest.approx(expected.center, abs=1e-8)
    assert "looks like ms" not in flat(result.stdout)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--convert", "mag="), '"mag=" is not NAME=UNIT'),
        (("--convert", "counts"), "--unit-label"),
        (("--convert", "mag=counts"), "known units: µT, nT"),
        (("--convert", "mag=nT,mag=uT"), "the unit of mag twice"),
        (("--unit-label", "gauss"), "give --convert mag=gauss"),
        (("--unit-label", "counts", "--convert", "mag=nT"), "exclude each other"),
        (("--sensor", "mag0", "--quantity", "accel"), "leave it out with --quantity accel"),
    ],
)
def test_invalid_units_are_refused_with_the_remedy(folder, tmp_path, arguments, words):
    assert_refused(mkc("calibrate", folder / "one.csv", "--output", tmp_path / "o", *arguments), words, code=2)


def test_unit_and_sensor_options_are_refused_with_a_simulation_of_the_user():
    from typer import BadParameter

    assert checked_units(["time=us"], None, "pendulum.py:Pendulum") == {"time": "us"}
    with pytest.raises(BadParameter, match="apply to a magnetometer"):
        checked_units([], "counts", "pendulum.py:Pendulum")
    with pytest.raises(BadParameter, match="--sensor names a magnetometer"):
        checked_sensor("mag0", "pendulum.py:Pendulum")


# --- inspect


def test_inspect_shows_columns_rates_units_and_the_command(folder):
    result = mkc("inspect", folder / "one.csv", folder / "two.csv")
    assert result.exit_code == 0, result.output
    reported = flat(result.stdout)
    for words in (
        "table: 300 rows, 50 Hz, 5.98 s, no gaps",
        "magX [nT] numbers nT mag_x",
        "magnetometer: mag_x from magX [nT], mag_y from magY [nT], mag_z from magZ [nT], time",
        "converted from nT, as the file says, to µT",
        f"mkc calibrate {folder / 'one.csv'} --output results",
        "magnetometer mag1: mag_x from mag1_x",
    ):
        assert words in reported, reported


@pytest.mark.slow
def test_the_command_of_inspect_works(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("two", "gauss"):
        (data,) = json.loads(mkc("inspect", folder / f"{name}.csv", "--json").stdout)
        (command,) = data["commands"]
        assert ("--convert mag=gauss" in command) == (name == "gauss")
        result = mkc(*shlex.split(command)[1:])
        assert result.exit_code == 0, result.output
        assert [sensor["name"] for sensor in data["sensors"]] == (["mag0", "mag1"] if name == "two" else [""])


def test_inspect_reports_open_questions(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,ux,uy,uz,what\n0,1,2,3,a\n1,2,,4,b\n2,3,4,5,c\n40,1,1,1,d\n")
    (data,) = json.loads(mkc("inspect", path, "--json").stdout)
    assert data["commands"] == []
    assert "`--columns mag_x=ux,mag_y=uy,mag_z=uz`" in data["question"]
    (topic,) = data["topics"]
    assert (topic["rows"], topic["rate"], topic["gaps"], topic["longest_gap"]) == (4, 1.0, 1, 38.0)
    kinds = {column["name"]: (column["kind"], column["missing"]) for column in topic["columns"]}
    assert kinds["uy"] == ("whole numbers", 1)
    assert kinds["what"] == ("text", 0)


def test_inspect_goes_on_after_a_file_that_cannot_be_read(folder, tmp_path):
    result = mkc("inspect", tmp_path / "none.csv", folder / "one.csv")
    assert result.exit_code == 1
    assert "there is no such file" in result.stderr
    assert "1 of 2 files were not read" in result.stderr
    assert "300 rows" in result.stdout
