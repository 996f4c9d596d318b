"""The recordings of the benchmarks, and curves that end before their time limit."""

import itertools
import json
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("polars")
pytest.importorskip("matplotlib")

from mkc_torch import Recording
from tests.benchmarks import diagnosis, fmu, ratios, samples, sizes


def test_quaternions_turn_as_their_matrices_do():
    to_world = torch.linalg.qr(torch.randn(50, 3, 3, dtype=torch.float64, generator=torch.manual_seed(0)))[0]
    to_world = to_world * torch.linalg.det(to_world).sign()[:, None, None]
    w, x, y, z = diagnosis.quaternions(to_world).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    torch.testing.assert_close(torch.stack([torch.stack(row, -1) for row in rows], -2), to_world)


def test_a_sensor_is_recorded_at_the_requested_rate(tmp_path):
    recording = Recording.read(diagnosis.sensor(tmp_path / "a.csv", 10.0, 60.0, 1, attitude=True))
    assert len(recording) == 600
    assert float(recording["time"][-1]) == pytest.approx(59.9)
    field = recording.stack("mag_x", "mag_y", "mag_z")
    assert bool(((field - field.mean(0)).norm(dim=1) > 20.0).all())


def test_rows_of_recordings_that_are_absent_are_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(diagnosis, "CASES", tmp_path)
    assert list(diagnosis.rows(tmp_path, "case tanks")) == []
    assert f"left out: {tmp_path / 'tanks' / 'fit.csv'} is absent" in capsys.readouterr().out
    (row,) = diagnosis.rows(tmp_path, "three states, 1,000")
    assert len(Recording.read(row.files[0])) == 1000


def test_a_curve_ends_before_the_point_that_would_take_too_long(monkeypatch):
    clock = itertools.accumulate([0.0, 1.0, 0.0, 4.0, 0.0, 16.0, 0.0, 64.0])
    monkeypatch.setattr(sizes.time, "process_time", lambda: next(clock))
    curve = sizes.Curve("squares", "size").measure([1, 2, 4, 8, 16], lambda _: lambda: None, 20.0)
    assert curve.sizes == [1.0, 2.0, 4.0]
    assert curve.seconds == [1.0, 4.0, 16.0]


def test_the_picture_has_a_panel_for_each_size(tmp_path):
    curves = [sizes.Curve(f"curve {k}", f"panel {k}", [1.0, 2.0], [0.5, 1.0]) for k in range(5)]
    sizes.picture(
        [*curves, sizes.Curve("by the clock", "ranks of one thread", [1.0, 2.0], [2.0, 1.0])], tmp_path / "a.png"
    )
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_samples_end_before_the_point_that_would_take_too_long_and_are_drawn_with_their_exponent(tmp_path):
    counted = []

    def cpu_seconds(recording, simulation):
        counted.append(len(Recording.read(recording)))
        assert simulation == f"{tmp_path / 'rotor.py'}:Rotor"
        return counted[-1] / 100.0

    sizes_, seconds = samples.measure(tmp_path, 25.0, cpu_seconds, sizes=(1000, 2000, 4000))
    assert counted == sizes_ == [1000, 2000]
    assert samples.slope(sizes_, seconds) == pytest.approx(1.0)
    samples.draw(tmp_path / "samples.png", sizes_, seconds)
    assert (tmp_path / "samples.png").read_bytes().startswith(b"\x89PNG")


def test_the_rotor_is_slower_than_its_simulation_by_quadratic_drag(tmp_path):
    recording = Recording.read(samples.rotor(tmp_path / "rotor.csv", 3000))
    torque, speed = recording["torque"], recording["speed"]
    slope = (speed[20:] - speed[:-20]) / (20 * samples.STEP)
    lost = (torque[10:-10] - 0.5 * speed[10:-10] - slope)[:2980]
    drag = speed[10:-10] * speed[10:-10].abs()
    assert float((lost * drag).sum() / drag.square().sum()) == pytest.approx(0.4, abs=0.03)


def test_each_recording_is_diagnosed_with_the_model_in_torch_and_with_the_fmu(monkeypatch):
    seen = []

    def diagnosed(simulation, recording, **_):
        seen.append((simulation, recording.name))
        return SimpleNamespace(findings=(), model=SimpleNamespace(theta=torch.ones(2)))

    monkeypatch.setattr(fmu, "as_fmu", lambda system, *_, **__: system)  # compiling takes seconds
    monkeypatch.setattr(fmu, "load_fmu", lambda system: f"FMU of {system}")
    monkeypatch.setattr(fmu, "diagnose", diagnosed)  # a diagnosis takes half a minute
    (pair,) = fmu.pairs(1)
    assert (pair.name, pair.same, pair.off) == ("thermal_00000", True, 0.0)
    assert [type(seen[0][0]), seen[1][0]] == [fmu.NOMINAL["thermal"], "FMU of thermal"]
    assert {name for _, name in seen} == {pair.name}


def test_every_ratio_is_stored_and_one_that_has_outgrown_it_fails(monkeypatch, capsys):
    own = ratios.pairs()
    stored = json.loads(ratios.STORED.read_text(encoding="utf-8"))
    assert [pair.name for pair in own] == list(stored)
    monkeypatch.setattr(ratios, "pairs", lambda: own[1:3])
    monkeypatch.setattr(ratios, "ratio_of", lambda pair: stored[pair.name] * (3.1 if pair is own[2] else 2.0))
    assert ratios.main([]) == 1
    assert f"{own[2].name}: 3 times as slow as stored" in capsys.readouterr().out
    monkeypatch.setattr(ratios, "ratio_of", lambda pair: stored[pair.name])
    assert ratios.main([]) == 0
