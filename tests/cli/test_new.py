"""`mkc new-simulation` and `mkc new-effect`: the generated files work."""

import subprocess
import sys

import pytest

pytest.importorskip("typer")


from mkc_torch.simulation import load_simulation
from tests.cli.commands import mkc


@pytest.mark.parametrize(("command", "kind"), [("new-simulation", "Dynamics"), ("new-effect", "GainEffect")])
def test_new_writes_two_files_and_replaces_none_without_force(tmp_path, monkeypatch, command, kind):
    monkeypatch.chdir(tmp_path)
    result = mkc(command, "two_kites")
    assert result.exit_code == 0, result.output
    assert result.stdout.split() == ["two_kites.py", "test_two_kites.py"]
    assert f"class TwoKites({kind})" in (tmp_path / "two_kites.py").read_text(encoding="utf-8")
    (tmp_path / "two_kites.py").unlink()
    (tmp_path / "test_two_kites.py").write_text("mine", encoding="utf-8")
    result = mkc(command, "two_kites")
    assert result.exit_code == 1
    assert "test_two_kites.py exists; choose another name, or replace it with `--force`." in result.stderr
    # neither of the two, where one cannot be
    assert [item.name for item in tmp_path.iterdir()] == ["test_two_kites.py"]
    assert (tmp_path / "test_two_kites.py").read_text(encoding="utf-8") == "mine"
    assert mkc(command, "two_kites", "--force", "--output", tmp_path).exit_code == 0
    assert "TwoKites" in (tmp_path / "test_two_kites.py").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("my-kite", "cannot be the name of a module"),
        ("../kite", "cannot be the name of a module"),
        ("class", "cannot be the name of a module"),
        ("_", "cannot be the name of a module"),
        ("torch", "a module torch is installed"),
        ("json", "a module json is installed"),
        ("Kite", "in lower case, kite"),
    ],
)
def test_invalid_module_names_are_refused(tmp_path, monkeypatch, name, words):
    monkeypatch.chdir(tmp_path)
    for command in ("new-simulation", "new-effect"):
        result = mkc(command, name)
        assert result.exit_code == 2
        assert words in " ".join(result.stderr.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


def test_a_new_simulation_can_be_loaded_by_file_and_class(tmp_path):
    assert mkc("new-simulation", "kite", "--output", tmp_path).exit_code == 0
    assert load_simulation(f"{tmp_path / 'kite.py'}:Kite").states == ("position", "speed")


@pytest.mark.slow
@pytest.mark.parametrize("command", ["new-simulation", "new-effect"])
def test_generated_tests_pass(tmp_path, command):
    assert mkc(command, "kite", "--output", tmp_path).exit_code == 0
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
