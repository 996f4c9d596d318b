"""Pages on a telephone: nothing lies beyond the right edge, measured in a browser."""

import dataclasses
import re
import shutil
import subprocess

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from mkc_torch.report.diagnosis.page import diagnosis_report
from tests.diagnosis.factory import make_diagnosis, make_follows, make_unfit, make_world, nearest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
    "--disable-dev-shm-usage",
)  # fmt: skip
WIDTH = 390
LONG = "a_column_with_a_name_that_is_longer_than_any_telephone_is_wide_and_has_no_space_in_it"

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine: widths are not measured")

# a window of a headless browser cannot be as narrow as a telephone, a frame in it can
FRAME = """<!doctype html><body style="margin:0"><iframe id="phone" src="page.html"
style="width:{width}px;height:900px;border:0"></iframe><p id="told"></p><script>
document.getElementById("phone").onload = (event) => {{
  const inside = event.target.contentDocument;
  if ({open}) for (const one of inside.querySelectorAll("details")) one.open = true;
  document.getElementById("told").textContent = "width " + inside.documentElement.scrollWidth + " end";
}};</script>"""


def width_of(page, folder, *, opened):
    """The width that a page needs where it has that of a telephone, its details open or not."""
    (folder / "page.html").write_text(page, encoding="utf-8")
    (folder / "frame.html").write_text(FRAME.format(width=WIDTH, open=str(opened).lower()), encoding="utf-8")
    command = [
        CHROMIUM, *FLAGS, f"--user-data-dir={folder / 'profile'}", "--allow-file-access-from-files",
        "--virtual-time-budget=5000", "--dump-dom", (folder / "frame.html").as_uri(),
    ]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    found = re.search(r"width (\d+) end", result.stdout)
    assert found, f"{CHROMIUM} measured nothing: {result.stderr[-1000:]}"
    return int(found[1])


def long_names():
    """A page on which whatever comes from a file is too long."""
    made = make_diagnosis(3, samples=200, channels=4, recording=LONG, simulation=LONG, warnings=(LONG,))
    findings = tuple(dataclasses.replace(f, drivers=(LONG,), equation=LONG, explanation=LONG) for f in made.findings)
    world = make_world(follows=(make_follows(LONG, LONG),), reasons=(LONG,), between={LONG: "held"})
    return dataclasses.replace(made, findings=findings, advice=(LONG,), world=world)


def first_nearest():
    made = make_diagnosis(2, samples=200, channels=4, verdict="unexplained")
    first, *rest = made.findings
    return dataclasses.replace(made, findings=(nearest(first), *rest))


PAGES = {
    "adequate": lambda: make_diagnosis(0, samples=200, world=make_world(pushes=(), forcing=())),
    "unfit": make_unfit,
    "pushed": lambda: make_diagnosis(0, samples=200, verdict="unexplained", world=make_world()),
    "nearest": first_nearest,
    "long names": long_names,
}


@pytest.mark.parametrize("opened", [False, True])
@pytest.mark.parametrize("kind", PAGES)
def test_nothing_lies_beyond_the_edge_of_a_telephone(kind, opened, tmp_path):
    assert width_of(diagnosis_report(PAGES[kind]()), tmp_path, opened=opened) == WIDTH


def test_what_is_too_wide_is_measured(tmp_path):
    page = diagnosis_report(make_unfit()).replace("</main>", '<div style="width:700px">x</div></main>')
    assert width_of(page, tmp_path, opened=False) > WIDTH
