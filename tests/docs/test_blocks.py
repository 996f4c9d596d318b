"""Every fenced block of the README and of the manual runs, in the order of the page."""

import pytest

pytest.importorskip("lightning")
pytest.importorskip("typer")
pytest.importorskip("polars")

from examples.blind_proof import __main__ as proof
from tests.docs.commands import EXAMPLES, SMALL, TESTED, commands, run, script_of
from tests.docs.files import write_examples
from tests.docs.outputs import differences, run_page
from tests.docs.pages import PAGES, ROOT, RUN, SHOWN, blocks
from tests.simulation.fmu.made import COMPILER

pytestmark = [
    # advice such as more workers for the loader
    pytest.mark.filterwarnings("ignore::lightning.fabric.utilities.warnings.PossibleUserWarning"),
    pytest.mark.filterwarnings(r"ignore:.*LeafSpec.* is deprecated"),
    pytest.mark.filterwarnings("ignore:Starting from v1.9.0, `tensorboardX`"),
]

PAGES_WITH_CODE = [page for page in PAGES if any(block.language in RUN for block in blocks(page))]

EXPECTED_FINDINGS = {
    "diagnose": {"result": "current_field"},
    "own_simulation": {"result": "quadratic_drag", "paired": "gain", "supplied": "supply_offset"},
}
"""First findings of the diagnoses of a page, by the name of the diagnosis in the page."""

LONG = ("measured",)
"""Pages of commands that other tests run as well, in a smaller version."""

PACKAGES_OF_PAGES = {"large_data": "pyarrow", "own_simulation": "fmpy", "mujoco": "mujoco"}
"""Packages that a page needs in addition to those of all pages."""

OPTIONAL = [block for page in PAGES for block in blocks(page) if block.needs is not None]
"""Blocks that need packages on which this project does not depend."""


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    write_examples(folder)
    return folder


@pytest.fixture
def folder(examples, tmp_path, monkeypatch):
    """Return the working folder of a reader: the tables, and nothing else."""
    for table in examples.iterdir():
        (tmp_path / table.name).symlink_to(table)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.manual
@pytest.mark.parametrize(
    "page",
    [pytest.param(page, id=page.stem, marks=[pytest.mark.slow] * (page.stem in LONG)) for page in PAGES_WITH_CODE],
)
def test_every_block_of_a_page_runs(page, folder):
    if page.stem in PACKAGES_OF_PAGES:
        pytest.importorskip(PACKAGES_OF_PAGES[page.stem])
    if page.stem == "own_simulation" and COMPILER is None:
        pytest.skip("there is no compiler of C for its FMU")
    names, shown = run_page(page, folder)
    found = {name: names[name].findings[0].effect for name in EXPECTED_FINDINGS.get(page.stem, {})}
    assert found == EXPECTED_FINDINGS.get(page.stem, {})
    for block, printed in shown:
        wrong = list(differences(block.text.splitlines(), printed))
        assert not wrong, f"{block}: `python -m tests.docs.outputs` fills in\n" + "\n".join(wrong)


@pytest.mark.parametrize("block", OPTIONAL, ids=str)
def test_the_package_of_an_optional_block_is_installed(block):
    """The block runs with its page; if its package is absent, the skip names the package."""
    pytest.importorskip(block.needs)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_block_has_a_known_language(page):
    for block in blocks(page):
        assert block.language in RUN | SHOWN, f"{block}: its language is {block.language!r}"
        if block.language in SHOWN:
            assert "import " not in block.text, f"{block} looks like code that should run"


def test_every_small_variant_belongs_to_a_shown_command():
    shown = [words for page in PAGES for b in blocks(page) if b.language == "sh" for line in b.text.splitlines()
             for words in commands(line)]  # fmt: skip
    proofs = [words[3:] for words in shown if words[:3] == ["python", "-m", "examples.blind_proof"]]
    assert set(SMALL) == {proof.parser().parse_args(words).kind for words in proofs}
    scripts = {words[1] for words in shown if words[0] == "python" and words[1].startswith("examples/")}
    modules = {words[2] for words in shown if words[:2] == ["python", "-m"] and words[2].startswith("examples.")}
    scripts |= {script_of(module) for module in modules - {"examples.blind_proof"}}
    assert set(EXAMPLES) | set(TESTED) == scripts
    assert all((ROOT / script).is_file() for script in scripts)


def test_an_unknown_command_fails(tmp_path):
    for line in ("rm -rf results", "python other.py", "mkc nothing", "pip install -e .[none]"):
        with pytest.raises(AssertionError):
            run(commands(line)[0], tmp_path)
