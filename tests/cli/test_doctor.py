import re
from pathlib import Path

import pytest
import tomllib

pytest.importorskip("typer")

from typer.testing import CliRunner

import mkc_torch
from mkc_torch.cli import doctor
from mkc_torch.cli.app import app

PYPROJECT = Path(mkc_torch.__file__).parent.parent / "pyproject.toml"
COLLECTIONS = {"logs", "all", "test", "examples"}


def packages(extras, name):
    found = []
    for line in extras[name]:
        package = re.match(r"[\w-]+", line)[0]
        inner = re.search(r"\[(.*)\]", line)
        found += [p for extra in inner[1].split(",") for p in packages(extras, extra)] if inner else [package]
    return found


def test_every_extra_is_listed_with_its_packages():
    extras = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    listed = {extra.name: list(extra.packages) for extra in doctor.EXTRAS}
    described = {name: packages(extras, name) for name in extras if name in listed}
    assert listed == described
    assert not {name for name in extras if name not in listed} - COLLECTIONS - {"docs", "dev", "device"}


def test_a_missing_extra_is_listed_with_its_purpose_and_installation(monkeypatch):
    monkeypatch.setattr(doctor, "_installed", lambda package: package != "fmpy")
    text = CliRunner().invoke(app, ["doctor"]).output
    assert "missing fmpy; simulations in FMUs" in text
    assert 'pip install "mkc-torch[fmu]"' in text
    assert mkc_torch.__version__ in text


def test_command_descriptions_are_complete_sentences_at_80_columns():
    text = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    text = text.partition("Options:")[2]
    assert "..." not in text
    commands = text.partition("Commands:")[2].strip().splitlines()
    assert len(commands) == len(app.registered_commands)
    assert all(line.endswith(".") and len(line) <= 80 for line in commands)
