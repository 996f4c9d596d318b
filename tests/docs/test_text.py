"""The README and the manual: their lengths and links, and whether names and options exist."""

import pydoc
import re
import subprocess

import pytest

pytest.importorskip("lightning")
pytest.importorskip("typer")

from mkc_torch.effects import CATALOGUE
from tests.docs.commands import MKC, check_install, example_options, mkc_options, script_of
from tests.docs.pages import PAGES, README, ROOT, anchors, blocks, inline, links, prose

MANUAL = {
    "architecture.md",
    "bad_inputs.md",
    "calibrate.md",
    "changelog.md",
    "check.md",
    "diagnose.md",
    "estimators.md",
    "for_networks.md",
    "for_sensors.md",
    "for_simulations.md",
    "gallery.md",
    "glossary.md",
    "how_it_decides.md",
    "index.md",
    "large_data.md",
    "loss.md",
    "losses.md",
    "measured.md",
    "mujoco.md",
    "own_simulation.md",
    "promises.md",
    "ros.md",
    "wrong_targets.md",
}
FOLDERS = {"decisions/index.md"}
COMMON = {"--version", "--help", "--install-completion"}
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)


def test_the_readme_is_short():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_the_second_block_of_the_readme_runs_the_tests():
    """`.ci/run` takes the command from there."""
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    program = re.search(r"awk '(.+?)' README.md", script)[1]
    found = subprocess.run(["awk", program, README], capture_output=True, text=True, check=True).stdout
    assert found.strip() == [block.text for block in blocks(README) if block.language == "sh"][1]
    assert found.strip().endswith(".venv/bin/python -m pytest -q -n auto")
    options = "-m 'not slow' --dist loadscope --hypothesis-profile=ci --durations=20"
    assert f'bash -euo pipefail -c "$test_command {options}"\n' in script
    doctests = "--hypothesis-profile=ci --doctest-modules mkc_torch examples/blind_proof"
    assert f"python -m pytest -q -n auto {doctests}\n" in script


def test_the_readme_links_to_every_page():
    assert {page.name for page in PAGES[1:]} == MANUAL
    targets = [target for target in links(README) if not target.startswith("docs/pictures/")]
    led = {target.partition("#")[0].removeprefix("docs/") for target in targets if target.startswith("docs/")}
    assert led - FOLDERS == MANUAL


@each_page
def test_link_targets_exist(page):
    for target in links(page):
        path, _, heading = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists(), f"{page.name}: {target}"
        assert not heading or heading in anchors(place), f"{page.name}: {target}"


@each_page
def test_lines_are_at_most_120_characters_wide(page):
    """Table rows may be longer."""
    for line in prose(page).splitlines():
        assert len(line) <= 120 or line.startswith("|"), f"{page.name}: {line}"


@each_page
def test_names_in_inline_code_exist(page):
    for text in inline(page):
        for name in re.findall(r"\bmkc_torch(?:\.\w+)+", text):
            assert pydoc.locate(name) is not None, f"{page.name}: {name}"


@each_page
def test_commands_and_options_in_inline_code_exist(page):
    known = COMMON.union(*(mkc_options(command) for command in MKC))
    texts = [block.text for block in blocks(page)]
    scripts = {word for text in texts for word in re.findall(r"examples/\S+\.py", text)}
    scripts |= {script_of(word) for text in texts for word in re.findall(r"python -m (examples[.\w]+)", text)}
    known = known.union(*(example_options(script) for script in scripts))
    for text in inline(page):
        words = text.split()
        assert words[0] != "python", f"{page.name}: `{text}` belongs into a block, which is run"
        options = {word for word in words if re.fullmatch(r"--[\w-]+", word)}
        if words[:2] == ["pip", "install"]:
            check_install([word.strip('"') for word in words[2:]])
        elif words[0] == "mkc" and len(words) > 1 and not words[1].startswith("-"):
            assert words[1] in MKC, f"{page.name}: `{text}`"
            assert options <= mkc_options(words[1]), f"{page.name}: `{text}`"
        else:
            assert options <= known, f"{page.name}: `{text}`"


@pytest.mark.parametrize("command", ["calibrate", "check", "diagnose"])
def test_every_option_is_documented(command):
    named = " ".join(inline(ROOT / "docs" / f"{command}.md"))
    assert {option for option in mkc_options(command) if option not in named} == set()


def test_every_effect_of_the_catalogue_is_documented():
    named = {*inline(ROOT / "docs" / "diagnose.md"), *inline(ROOT / "docs" / "own_simulation.md")}
    assert {effect.id for effect in CATALOGUE} <= named
