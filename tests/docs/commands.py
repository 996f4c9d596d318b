"""Run the commands that the README and the manual show; slow commands are run as small variants."""

from __future__ import annotations

import hashlib
import importlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from examples.blind_proof import __main__ as proof
from mkc_torch.cli.app import app
from mkc_torch.cli.console import DOUBTFUL
from tests.docs.pages import ROOT

MKC = typer.main.get_command(app).commands

BUILD = ("--config-file", ".zensical.toml")
"""Options of the build of the site, in addition to ``--strict``."""

PROOF = "--cases 0 --empty 1 --workers 1 --seed 1"

SMALL = {
    "magnetometer": f"{PROOF} --duration 10",
    "equations": PROOF,
    "mujoco": "--help",  # minutes for a recording; tests/blind_proof/mujoco runs it
    "magnetometer_scenarios": f"{PROOF} --only white --duration 15",
    "equations_scenarios": f"{PROOF} --only white",
}
"""Small runs of each kind of blind proof; the shown runs take hours."""

EXAMPLES = {
    "examples/paper/density.py": "",
    "examples/calibration/passing_magnet.py": "RECORDING.csv --output picture.png",
    "examples/calibration/against_least_squares.py": "RECORDING.csv ANOTHER.csv",
    "examples/calibration/hardly_tilting.py": "--draws 1 --tilt 8 15",
    "examples/lightning/any_unit.py": "--help",
    "examples/loss_pictures.py": "--output pictures",
    "examples/gallery.py": "--help",  # minutes, on recordings that are not part of the project
    # minutes each, on recordings that are not part of the project
    "examples/concealed_physics/dynamics/heaters.py": "--help",
    "examples/concealed_physics/dynamics/silverbox.py": "--help",
    "examples/concealed_physics/dynamics/servo.py": "--help",
}
"""Scripts that the tests run, with these arguments instead of those shown."""

TESTED = {
    "examples/paper/example_2.py": "test_example_2.py",
    "examples/paper/table_1.py": "test_mkc_examples.py",
    "examples/paper/table_2.py": "test_mkc_examples.py",
    "examples/paper/all.py": "test_mkc_examples.py",
    "examples/paper/error_bound.py": "test_mkc_examples.py",
    "examples/paper/comparison.py": "test_mkc_examples.py",
    "examples/paper/lel_table_5.py": "test_lel_examples.py",
    "examples/paper/lel_tables_1_to_4.py": "test_lel_examples.py",
    "examples/paper/lel_figures.py": "test_lel_examples.py",
    "examples/paper/lel_range_image.py": "test_lel_examples.py",
    "examples/lightning/heavy_tailed_channel.py": "test_lightning_examples.py",
    "examples/lightning/corrupted_tabular.py": "test_lightning_examples.py",
    "examples/lightning/bursty_series.py": "test_lightning_examples.py",
    "examples/lightning/speed.py": "test_lightning_examples.py",
    "examples/lightning/noisy_labels.py": "test_noisy_labels.py",
    "examples/lightning/wrong_targets.py": "test_lightning_examples.py",
    "examples/lightning/noise_over_input.py": "test_lightning_examples.py",
    "examples/lightning/optimisers.py": "test_lightning_examples.py",
    "examples/density/heavy_tails.py": "test_heavy_tails.py",
    "examples/estimators/coverage.py": "test_coverage.py",
    "examples/concealed_physics/magnetometer/real_recordings.py": "test_real_recordings.py",
    "examples/concealed_physics/dynamics/falling_balls.py": "test_concealed_dynamics.py",
    "examples/concealed_physics/dynamics/baselines.py": "test_dynamics_baselines.py",
    "examples/concealed_physics/real.py": "test_known_physics.py",
    "examples/concealed_physics/histone/petab_select_0009.py": "test_petab_select.py",
    "examples/numbers_alone/compare.py": "test_numbers_alone.py",
}
"""Scripts that tests/examples runs at a small size: here only their options are checked."""


_DIAGNOSED: dict[str, tuple[Path, str]] = {}
_KEPT = tempfile.TemporaryDirectory()


def commands(line: str) -> list[list[str]]:
    """Split a line into commands, and each command into words; comments are left out.

    Example:
        >>> commands("cp a b && mkc demo  # all of it")
        [['cp', 'a', 'b'], ['mkc', 'demo']]
    """
    parts: list[list[str]] = [[]]
    for word in shlex.split(line, comments=True):
        if word == "&&":
            parts.append([])
        else:
            parts[-1].append(word)
    return [part for part in parts if part]


def run(words: list[str], folder: Path) -> str:
    """Run a command in the folder, or its small variant; returns what `mkc` prints.

    Raises:
        AssertionError: the command fails, or is of an unknown kind.
    """
    match [words[0].removeprefix(".venv/bin/"), *words[1:]]:
        case ["python3", "-m", "venv", ".venv"]:
            pass  # .ci/run makes the environment
        case ["pip", "install", *arguments]:
            check_install(arguments)
        case ["python", "-m", "pytest", "-q", "-n", "auto"]:
            pass  # .ci/run runs the tests
        case ["mkc", "diagnose", *arguments] if "--output" in arguments:
            return run_diagnosis(arguments, folder)
        case ["mkc", *arguments]:
            return run_mkc(arguments)
        case ["python", "-m", "examples.blind_proof", *arguments]:
            run_proof(arguments, folder)
        case ["python", "-m", module, *arguments] if module.startswith("examples."):
            run_example(script_of(module), arguments, folder)
        case ["python", script, *arguments] if script.startswith("examples/"):
            run_example(script, arguments, folder)
        case ["python", "-m", module, *_] if module.startswith(
            (
                "tests.benchmarks",
                "tests.device",
                "tests.fuzz",
                "tests.gate",
                "tests.mutation",
                "tests.wheel",
            )
        ):
            # minutes each: check only that the command exists
            is_package = hasattr(importlib.import_module(module), "__path__")
            entry = importlib.import_module(f"{module}.__main__" if is_package else module)
            assert callable(entry.main)
        case ["python", script, *arguments] if script.endswith("/corrected.py"):
            words = [sys.executable, script, *arguments]
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
            assert done.returncode == 0, f"{script}:\n{done.stdout}\n{done.stderr}"
            return done.stdout
        case ["torchrun", *arguments]:
            words = [sys.executable, "-m", "torch.distributed.run", *arguments]
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
            assert done.returncode == 0, f"torchrun {shlex.join(arguments)}:\n{done.stdout}\n{done.stderr}"
        case ["zensical", *arguments]:
            assert arguments == ["build", "--strict", *BUILD], "test_site.py builds it otherwise"
        case ["cp", source, target]:
            shutil.copy(folder / source, folder / target)
        case _:
            raise AssertionError(f"no case runs `{shlex.join(words)}`")
    return ""


def run_mkc(arguments: list[str]) -> str:
    """Run the command `mkc` in this process, and return what it prints."""
    result = CliRunner().invoke(app, arguments)
    doubtful = arguments[0] == "diagnose" and result.exit_code == DOUBTFUL
    assert result.exit_code == 0 or doubtful, f"mkc {shlex.join(arguments)}:\n{result.output}\n{result.exception!r}"
    return result.stdout


def run_diagnosis(arguments: list[str], folder: Path) -> str:
    """Run `mkc diagnose`, once for all pages that show it for the same files; returns what it prints."""
    output = folder / arguments[arguments.index("--output") + 1]
    files = [folder / word.partition(":")[0] for word in arguments]
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files if file.is_file()]
    key = " ".join([*arguments, *digests])
    if key in _DIAGNOSED and not output.exists():
        results, printed = _DIAGNOSED[key]
        shutil.copytree(results, output)
        return printed
    fresh = not output.exists()
    printed = run_mkc(["diagnose", *arguments])
    if fresh:
        kept = Path(_KEPT.name) / str(len(_DIAGNOSED))
        shutil.copytree(output, kept)
        _DIAGNOSED[key] = kept, printed
    return printed


def run_proof(arguments: list[str], folder: Path) -> None:
    """Run a small blind proof of the same kind; a recording that could not be diagnosed is a failure."""
    options = proof.parser().parse_args(arguments)
    assert proof.KINDS[options.kind](10.0).only(options.only).scenarios
    if SMALL[options.kind] == "--help":
        return
    place = folder / f"small_{options.output.name}"
    small = [options.kind, *SMALL[options.kind].split(), "--output", str(place), "--force"]
    assert proof.main(small) == 0
    assert not list((place / "diagnoses").glob("*.error.txt"))


def run_example(script: str, arguments: list[str], folder: Path) -> None:
    """Run the script with few draws; if another test runs it, check its options only."""
    unknown = [word for word in arguments if word.startswith("--") and word not in example_options(script)]
    assert not unknown, f"{script} has no {', '.join(unknown)}"
    if script in TESTED:
        test = ROOT / "tests" / "examples" / TESTED[script]
        named = rf'"{Path(script).stem}(\.py)?"'
        assert re.search(named, test.read_text(encoding="utf-8")), f"{test.name} does not run {script}"
        return
    assert script in EXAMPLES, f"no test runs {script}; name it in EXAMPLES or in TESTED"
    before, code = set(sys.modules), None
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [str((ROOT / script).parent), *sys.path])
        patch.setattr(sys, "argv", [script, *EXAMPLES[script].split()])
        try:
            runpy.run_path(str(ROOT / script), run_name="__main__")
        except SystemExit as end:
            code = end.code
        finally:  # modules next to two scripts may have the same name
            for name in set(sys.modules) - before:
                if Path(getattr(sys.modules[name], "__file__", None) or "").parent == (ROOT / script).parent:
                    del sys.modules[name]
    assert not code, f"{script} ended with {code}"


def script_of(module: str) -> str:
    """Return the file that `python -m` runs for a module or package of the examples."""
    place = module.replace(".", "/")
    return f"{place}/__main__.py" if (ROOT / place).is_dir() else f"{place}.py"


def example_options(script: str) -> set[str]:
    """Return the options of a script and of the modules that it imports from its folder."""
    own = (ROOT / script).read_text(encoding="utf-8")
    imported = [
        (ROOT / script).with_name(f"{name}.py") for name in re.findall(r"^from (\w+) import", own, re.MULTILINE)
    ]
    texts = [own, *(path.read_text(encoding="utf-8") for path in imported if path.exists())]
    return {option for text in texts for option in re.findall(r"add_argument\(\s*\"(--[\w-]+)\"", text)}


def mkc_options(command: str) -> set[str]:
    """Return the options of a command of mkc."""
    return {option for parameter in MKC[command].params for option in parameter.opts if option.startswith("--")}


def check_install(arguments: list[str]) -> None:
    """Check that pip installs this package with existing extras, or a release of torch."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    extras = set(re.findall(r"^(\w+) = \[", section, re.MULTILINE))
    for word in arguments:
        if found := re.fullmatch(r"\.\[([\w,]+)\]", word):
            assert set(found[1].split(",")) <= extras, f"{word}: the extras are {', '.join(sorted(extras))}"
        else:
            assert word in ("-q", "-e") or re.fullmatch(r"torch==\d+\.\d+\.\d+", word), f"pip install {word}"
