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


UNREADABLE = [
    (None, "there is no such file"),
    ("", "the file is empty"),
    ("time,mag_x,mag_y,mag_z\n0,1,2,3\n1,2,3\n2,3,4,5\n", "line 3 has 3 values"),
]
# `mkc apply` takes any columns, because a model may be of a user's simulation
RENAMED = ("time,ux,uy,uz\n0,1,2,3\n1,2,3,4\n", "`--columns mag_x=ux,mag_y=uy,mag_z=uz`")


@pytest.mark.parametrize(
    ("command", "text", "words"),
    [
        *((("calibrate",), *each) for each in [*UNREADABLE, RENAMED]),
        *((("apply", "calibration.json"), *each) for each in UNREADABLE),
    ],
)
def test_an_unreadable_recording_is_refused_without_torch(tmp_path, command, text, words):
    if text is not None:
        (tmp_path / "new.csv").write_text(text)
    (tmp_path / "calibration.json").write_text("{}")
    code = "import sys; sys.modules['torch'] = None; from mkc_torch.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, *command, "new.csv", "--output", "out.csv"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        timeout=60,
    )
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("mkc: new.csv: ")
    assert words in done.stderr


def test_a_missing_calibration_is_refused_without_torch(tmp_path):
    code = "import sys; sys.modules['torch'] = None; from mkc_torch.cli import main; main()"
    arguments = ("export", "none.json", "--to", "px4", "--output", "out.params")
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=60
    )
    assert (done.returncode, done.stderr) == (1, "mkc: none.json: there is no such file.\n")
