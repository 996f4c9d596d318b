"""The manual as a site: it builds without warnings, loads nothing from elsewhere, and documents every public name."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec

import pytest

from tests.docs.commands import BUILD
from tests.docs.pages import PAGES, ROOT

API = ROOT / "docs" / "api"
REFERENCED_PACKAGES = re.findall(
    r"^::: (\S+)\n(?! )", "\n".join(page.read_text(encoding="utf-8") for page in API.glob("*.md")), re.M
)
VERSION = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M)[1]
DATE = re.search(r"date-released: (\S+)", (ROOT / "CITATION.cff").read_text(encoding="utf-8"))[1]
LOADS = {"script": "src", "link": "href", "img": "src", "iframe": "src", "source": "src", "object": "data"}


def public_packages():
    """Return the public packages that the page on architecture names."""
    text = " ".join((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split())
    sentence = re.search(r"Public names are those of (.+?), without an underscore", text)[1]
    return [name if name.startswith("mkc_torch") else f"mkc_torch{name}" for name in re.findall(r"`(.+?)`", sentence)]


class Page(HTMLParser):
    """The ids of a page, and the addresses that a browser loads with it."""

    def __init__(self, path):
        super().__init__()
        self.ids, self.loads = set(), set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.ids.add(found.get("id"))
        if tag in LOADS and found.get("rel") not in ("canonical", "prev", "next"):
            self.loads.add(found.get(LOADS[tag]) or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return the site, built from a copy: the command writes into the folder of its sources."""
    if find_spec("zensical") is None or find_spec("mkdocstrings_handlers") is None:
        pytest.skip("the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "docs", folder / "docs")
    shutil.copy(ROOT / ".zensical.toml", folder)
    (folder / "mkc_torch").symlink_to(ROOT / "mkc_torch")
    words = [sys.executable, "-m", "zensical", "build", "--strict", *BUILD]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300, check=False)
    output = re.sub(r"\x1b\[[\d;]*m", "", done.stdout + done.stderr)
    assert done.returncode == 0, output
    assert "griffe:" not in output, output  # an argument in a docstring that does not exist
    return folder / "build" / "site"


def test_every_public_package_has_a_page():
    assert {*public_packages(), "mkc_torch.density", "mkc_torch.report"} == {"mkc_torch", *REFERENCED_PACKAGES}
    assert len(REFERENCED_PACKAGES) == len(set(REFERENCED_PACKAGES))


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r'"([\w/]+\.md)"', (ROOT / ".zensical.toml").read_text(encoding="utf-8")))
    assert listed == {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}


def test_pictures_are_small_and_shown():
    kept = {path.name: path.stat().st_size for path in (ROOT / "docs" / "pictures").iterdir()}
    assert {name: size for name, size in kept.items() if size > 100_000} == {}
    shown = {name for page in PAGES[1:] for name in re.findall(r"\(pictures/(.+?)\)", page.read_text(encoding="utf-8"))}
    assert shown == set(kept)


@pytest.mark.manual
def test_every_public_name_is_documented(site):
    pytest.importorskip("lightning")
    ids = set().union(*(Page(path).ids for path in (site / "api").glob("*.html")))
    names = {
        f"{room}.{name}"
        for room in ("mkc_torch", *REFERENCED_PACKAGES)
        for name in importlib.import_module(room).__all__
    }
    assert len(names) > 150
    assert names - ids == set()


@pytest.mark.manual
def test_the_loss_comes_first_in_the_reference(site):
    page = (site / "api" / "losses.html").read_text(encoding="utf-8")
    assert re.search(r'<h2 id="([\w.]+)"', page)[1] == "mkc_torch.losses.MKCLoss"
    names = re.findall(r"^\| \[`(\w+)`\]", (API / "index.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert names[0] == "MKCLoss"


@pytest.mark.manual
def test_every_page_shows_the_version_and_its_date(site):
    for path in site.rglob("*.html"):
        assert f"mkc_torch {VERSION}, {DATE}" in path.read_text(encoding="utf-8"), path.name


def test_version_and_date_are_the_same_everywhere():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {VERSION}\ndate-released: {DATE}\n" in citation
    assert f"\n## {VERSION}, {DATE}\n" in (ROOT / "docs" / "changelog.md").read_text(encoding="utf-8")
    assert f'copyright = "mkc_torch {VERSION}, {DATE}.' in (ROOT / ".zensical.toml").read_text(encoding="utf-8")


@pytest.mark.manual
def test_every_page_can_be_searched(site):
    index = json.loads((site / "search.json").read_text(encoding="utf-8"))
    found = {item["location"].partition("#")[0] for item in index["items"]}
    assert {"loss.html", "calibrate.html", "diagnose.html", "api/losses.html"} <= found


@pytest.mark.manual
def test_the_sections_of_a_docstring_are_recognised(site):
    page = (site / "api" / "losses.html").read_text(encoding="utf-8")
    assert "Example:" not in page  # parsed as a section, shown as code
    assert ":class:" not in page
    for name in ("input", "target"):  # documented together, listed separately
        assert re.search(rf"<b><code>{name}</code></b>|<code>{name}</code>", page)


@pytest.mark.manual
def test_pictures_exist_and_nothing_is_loaded_from_elsewhere(site):
    for path in site.rglob("*.html"):
        for target in Page(path).loads:
            assert "://" not in target, f"{path.name} loads {target}"
            # 404.html is shown at any address
            if path.name != "404.html" and target and not target.startswith("data:"):
                place = (path.parent / target.partition("?")[0].partition("#")[0]).resolve()
                assert place.exists(), f"{path.name}: {target}"


@pytest.mark.manual
def test_style_sheets_load_nothing_from_elsewhere(site):
    for path in site.rglob("*.css"):
        assert not re.search(r"url\(\s*[\"']?https?:|@import", path.read_text(encoding="utf-8")), path.name


@pytest.mark.manual
def test_every_page_fits_the_width_of_a_telephone(site):
    width = pytest.importorskip("tests.report.test_phone_width")
    if width.CHROMIUM is None:
        pytest.skip("no chromium on this machine: widths are not measured")
    pages = [path.relative_to(site).as_posix() for path in [*site.glob("*.html"), *(site / "api").glob("l*.html")]]
    pages.remove("404.html")
    assert len(pages) > 15
    found = width.widths_of({page: page for page in pages}, site)
    assert {page: needed for page, needed in found.items() if needed > width.WIDTH} == {}
