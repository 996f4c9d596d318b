"""The metadata of the package, and the recipe for conda, agree with each other."""

import re

import pytest

from tests.docs.pages import ROOT

tomllib = pytest.importorskip("tomllib")
yaml = pytest.importorskip("yaml")

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPE = yaml.safe_load((ROOT / ".github" / "conda" / "recipe.yaml").read_text(encoding="utf-8"))
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
"""Packages that conda names otherwise."""


def test_the_recipe_has_the_version_and_the_requirements_of_the_package():
    assert RECIPE["context"]["version"] == PROJECT["version"]
    assert f">={RECIPE['context']['python_min']}" == PROJECT["requires-python"]
    needed = [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["cli"]]
    names = (re.fullmatch(r"([\w-]+)(>=.+)", text).groups() for text in needed)
    expected = {f"{CONDA_NAMES.get(name, name)} {version}" for name, version in names}
    assert set(RECIPE["requirements"]["run"]) - {"python >=${{ python_min }}"} == expected
    assert RECIPE["build"]["python"]["entry_points"] == [f"mkc = {PROJECT['scripts']['mkc']}"]
    assert RECIPE["about"]["summary"] == PROJECT["description"]


def test_the_classifiers_are_the_tested_versions_of_python():
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    tested = workflow["jobs"]["matrix"]["strategy"]["matrix"]["python"]
    prefix = "Programming Language :: Python :: 3."
    assert [name.rpartition(" ")[2] for name in PROJECT["classifiers"] if name.startswith(prefix)] == tested
    assert set(workflow["jobs"]["package"]["strategy"]["matrix"]["python"]) == {tested[0], tested[-1]}
