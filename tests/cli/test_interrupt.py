"""An interrupt at any time prints a line, and the exit code is 130."""

import os
import signal
import subprocess
import sys
import time
from importlib import import_module

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")

from mkc_torch.cli import console
from tests.calibration.test_calibrate import noisy_ellipsoid
from tests.cli.commands import mkc
from tests.cli.test_cli import table
from tests.started import started

SLOW_IMPORT = """
import pathlib, sys, time
pathlib.Path(sys.argv[-1]).write_text("begun")
try:
    time.sleep(60.0)
except BaseException as error:
    raise ImportError("what an interrupt is made of") from error
"""


@pytest.mark.skipif(os.name == "nt", reason="signals are another thing there")
def test_an_interrupt_during_the_import_of_torch_prints_a_line(tmp_path):
    (tmp_path / "torch.py").write_text(SLOW_IMPORT)
    begun = tmp_path / "begun"
    path = os.pathsep.join([str(tmp_path), *sys.path])
    code = "from mkc_torch.cli import main; main()"
    with started("-c", code, "demo", "--output", begun, env=os.environ | {"PYTHONPATH": path}) as process:
        waited = time.monotonic() + 60.0
        while not begun.exists() and process.poll() is None and time.monotonic() < waited:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, reported = process.communicate(timeout=60)
    (line,) = reported.splitlines()
    assert line.startswith("mkc: interrupted")
    assert "nothing was written" in line
    assert process.returncode == 130


def test_the_package_imports_no_heavy_dependency():
    code = "import sys, mkc_torch.cli; print(sorted({'torch', 'numpy', 'polars', 'rich'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_all_public_names_can_be_imported():
    import mkc_torch

    assert all(getattr(mkc_torch, name) is not None for name in mkc_torch.__all__)
    assert set(mkc_torch.__all__) <= set(dir(mkc_torch))
    assert mkc_torch.density.robustness.__name__ == "mkc_torch.density.robustness"
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = mkc_torch.nothing


def interrupting(monkeypatch, command, name, after=0):
    """Interrupt when a function of a command's module was called so many times."""
    module = import_module(f"mkc_torch.cli.{command}")
    works = getattr(module, name)
    calls = []

    def interrupted(*arguments, **options):
        calls.append(arguments)
        if len(calls) > after:
            raise KeyboardInterrupt
        return works(*arguments, **options)

    monkeypatch.setattr(module, name, interrupted)


def assert_interrupted(result, sentence):
    assert result.exit_code == 130
    assert result.stderr == f"mkc: interrupted; {sentence}\n"


@pytest.mark.e2e
def test_an_interrupted_calibrate_names_the_recordings_without_results(tmp_path, monkeypatch):
    paths = [table(tmp_path / f"{name}.csv", noisy_ellipsoid(200)) for name in "abc"]
    interrupting(monkeypatch, "calibration_files", "fit", after=1)
    result = mkc("calibrate", *paths, "--output", tmp_path / "out")
    assert_interrupted(result, f"nothing was written for {paths[1]}, {paths[2]}.")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a"]
    assert "a: Calibrated.\noffset" in result.stdout


def test_an_interrupted_diagnose_names_the_recordings_without_results(tmp_path, monkeypatch):
    path = table(tmp_path / "a.csv", noisy_ellipsoid(200))
    interrupting(monkeypatch, "diagnosis_files", "diagnose_file")
    assert_interrupted(
        mkc("diagnose", path, "--simulation", "magnetometer", "--output", tmp_path / "out"),
        f"nothing was written for {path}.",
    )


@pytest.mark.e2e
def test_an_interrupted_apply_or_demo_reports_its_files(tmp_path, monkeypatch):
    path = table(tmp_path / "a.csv", noisy_ellipsoid(200))
    assert mkc("calibrate", path, "--output", tmp_path).exit_code == 0
    interrupting(monkeypatch, "correction", "correct")
    output = tmp_path / "o.csv"
    assert_interrupted(
        mkc("apply", tmp_path / "a" / "calibration.json", path, "--output", output), f"nothing was written to {output}."
    )
    interrupting(monkeypatch, "demonstration", "simulated_recording")
    assert_interrupted(mkc("demo", "--output", tmp_path / "demo"), f"nothing was written to {tmp_path / 'demo'}.")
    assert not (tmp_path / "demo").exists()


def test_results_that_may_be_incomplete_are_named(tmp_path):
    a, b = tmp_path / "a.csv", tmp_path / "b.csv"
    (tmp_path / "out" / "b").mkdir(parents=True)
    assert console.not_written([a, b], tmp_path / "out") == (
        f"nothing was written for {a}; {tmp_path / 'out' / 'b'} may be incomplete."
    )
    assert console.not_written([], tmp_path) == "all results were written."
