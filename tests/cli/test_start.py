"""Help, version and usage errors load no heavy dependency such as torch."""

import subprocess
import sys

import pytest

pytest.importorskip("typer")
pytest.importorskip("polars")

from mkc_torch.cli import diagnosis_request
from mkc_torch.diagnosis import declared
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.recording.recording import write_table

WITHOUT_HEAVY_IMPORTS = """
import sys

class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in HEAVY:
            raise AssertionError(f"{name} was loaded")

HEAVY = {"torch", "numpy", "polars", "lightning", "matplotlib", "scipy", "sklearn", "jinja2", "pydantic"}
sys.meta_path.insert(0, Refusing())
import mkc_torch.cli as cli
cli.find_spec = lambda name: name  # what is looked for is not loaded
cli.main()
"""


def run_without_heavy_imports(*arguments):
    return subprocess.run(
        [sys.executable, "-c", WITHOUT_HEAVY_IMPORTS, *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.parametrize(
    "command", [(), *((name,) for name in ("diagnose", "calibrate", "apply", "check", "demo", "effects"))]
)
def test_help_loads_no_heavy_dependency(command):
    done = run_without_heavy_imports(*command, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert " ".join(("Usage: mkc", *command)) in done.stdout


def test_the_version_loads_no_heavy_dependency():
    done = run_without_heavy_imports("--version")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("mkc ")


@pytest.mark.parametrize("mistake", [("nonsense",), ("calibrate", "--nonsense"), ("demo", "--outptu", "there")])
def test_usage_errors_load_no_heavy_dependency(mistake):
    done = run_without_heavy_imports(*mistake)
    assert done.returncode == 2
    assert "Usage: mkc" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_command_loads_heavy_dependencies(tmp_path):
    done = run_without_heavy_imports("demo", "--output", str(tmp_path / "demo"))
    assert "was loaded" in done.stderr


@pytest.mark.process
def test_a_calibration_loads_no_compiler(tmp_path):
    path = tmp_path / "a.csv"
    write_table(path, simulated_recording()[0].columns)
    code = (
        "import sys, torch; there = set(sys.modules); from mkc_torch.cli.app import app; app(standalone_mode=False); "
        "print('loaded', sorted({'torch._dynamo', 'sympy'} & (set(sys.modules) - there)))"
    )
    arguments = ("calibrate", str(path), "--output", str(tmp_path / "out"))
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.stdout.endswith("loaded []\n"), done.stdout + done.stderr


def test_defaults_of_the_command_line_equal_those_of_diagnose():
    module = sys.modules["mkc_torch.diagnosis.diagnose"]
    for name in ("LEVEL", "SURROGATES", "MAX_FINDINGS"):
        assert getattr(diagnosis_request, name) == getattr(module, name)
    assert diagnosis_request.INPUT_HOLDS == declared.BETWEEN
