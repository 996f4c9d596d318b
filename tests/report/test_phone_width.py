"""Pages on a telephone: no content beyond the right edge, measured in a browser."""

import dataclasses
import re
import shutil
import subprocess

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from examples.blind_proof.page import proof_page
from examples.blind_proof.score import ProofScore
from mkc_torch import check
from mkc_torch.calibration.calibrate import calibrate
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.recording.demonstration import simulated_recording
from mkc_torch.report import Comparison, calibration_report, check_report, refusal_report
from mkc_torch.report.diagnosis.page import diagnosis_report
from tests.blind_proof import test_scenarios_score as scenario_score
from tests.blind_proof.test_score import ADEQUATE, answer, finding, key, score
from tests.diagnosis.factory import (
    make_diagnosis,
    make_environment,
    make_goodness_of_fit,
    make_unfit,
    with_another_shape,
    with_courses,
)
from tests.diagnosis.validation.tank import tank_recording, usual_model

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
style="width:{width}px;height:900px;border:0"></iframe><p id="result"></p><script>
document.getElementById("phone").onload = (event) => {{
  const inside = event.target.contentDocument;
  if ({open}) for (const item of inside.querySelectorAll("details")) item.open = true;
  document.getElementById("result").textContent = "width " + inside.documentElement.scrollWidth + " end";
}};</script>"""


def dump_frame(folder, *flags):
    """Run the browser on the frame of a folder; its output is the document after all scripts."""
    command = [
        CHROMIUM, *FLAGS, *flags, f"--user-data-dir={folder / 'profile'}", "--allow-file-access-from-files",
        "--virtual-time-budget=5000", "--dump-dom", (folder / "frame.html").as_uri(),
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def width_of(page, folder, *, opened):
    """Return the width in pixels that a page needs on a telephone, with its details open or closed."""
    (folder / "page.html").write_text(page, encoding="utf-8")
    (folder / "frame.html").write_text(FRAME.format(width=WIDTH, open=str(opened).lower()), encoding="utf-8")
    result = dump_frame(folder)
    found = re.search(r"width (\d+) end", result.stdout)
    assert found, f"{CHROMIUM} measured nothing: {result.stderr[-1000:]}"
    return int(found[1])


MANY_FRAMES = """<!doctype html><body style="margin:0">{frames}<p id="result"></p><script>
window.onload = () => {{
  const widths = [...document.querySelectorAll("iframe")].map((frame) =>
    frame.id + " " + frame.contentDocument.documentElement.scrollWidth);
  document.getElementById("result").textContent = "widths " + widths.join(", ") + " end";
}};</script>"""


def widths_of(places, folder):
    """Return the widths in pixels that several pages need, measured in a single browser."""
    frames = "".join(
        f'<iframe id="{name}" src="{place}" style="width:{WIDTH}px;height:900px;border:0"></iframe>'
        for name, place in places.items()
    )
    (folder / "frame.html").write_text(MANY_FRAMES.format(frames=frames), encoding="utf-8")
    result = dump_frame(folder)
    found = re.search(r"widths (.+?) end", result.stdout)
    assert found, f"{CHROMIUM} measured nothing: {result.stderr[-1000:]}"
    return {name: int(width) for name, width in (item.rsplit(" ", 1) for item in found[1].split(", "))}


def long_names():
    """Return a diagnosis in which every text from a file is too long."""
    made = make_diagnosis(3, samples=200, channels=4, recording=LONG, simulation=LONG, warnings=(LONG,))
    findings = tuple(dataclasses.replace(f, drivers=(LONG,), equation=LONG, explanation=LONG) for f in made.findings)
    environment = make_environment(
        goodness_of_fit=(make_goodness_of_fit(LONG, LONG),), reasons=(LONG,), input_hold={LONG: "held"}
    )
    return dataclasses.replace(made, findings=findings, advice=(LONG,), environment=environment)


def first_nearest():
    made = make_diagnosis(2, samples=200, channels=4, verdict="unexplained")
    first, *rest = made.findings
    return dataclasses.replace(made, findings=(with_another_shape(first), *rest))


PAGES = {
    "adequate": lambda: make_diagnosis(0, samples=200, environment=make_environment(process_noise=(), disturbance=())),
    "unfit": make_unfit,
    "process noise": lambda: make_diagnosis(0, samples=200, verdict="unexplained", environment=make_environment()),
    "nearest": first_nearest,
    "long names": long_names,
    "recording and simulation": lambda: with_courses(long_names()),
}


def other_pages():
    """Yield pages of a calibration, a refusal and the blind proofs, with names that are too long."""
    recording, _ = simulated_recording()
    named = type(recording)(recording.columns, name=LONG, warnings=(LONG,))
    row = Comparison(LONG, (12.0, -7.5, 21.0), (45.0, 48.5, 51.5))
    yield "calibration", calibration_report(calibrate(named), named, note=LONG, comparison=[row])
    flat = named.rows(range(0, 4500, 5), f"about {LONG}")
    flat = type(flat)(dict(flat.columns) | {"mag_z": 0.0 * flat["mag_z"]}, name=LONG, warnings=(LONG,))
    with pytest.raises(NotIdentifiableError) as refused:
        calibrate(flat)
    yield "refusal", refusal_report(flat, refused.value)
    checked = check(usual_model(), tank_recording(1, name=LONG))
    output = dataclasses.replace(checked.outputs[0], output=LONG, unit=LONG, failure=f"{LONG} fails.")
    checked = dataclasses.replace(checked, simulation=LONG, outputs=(output,), findings=(LONG,), warnings=(LONG,))
    yield "check", check_report(checked)
    keys = [key(name, kind) for name, kind in (("a", "single"), ("b", "empty"), ("c", "single"), (LONG, "single"))]
    settings = scenario_score.SETTINGS | {"hidden": 3, LONG: LONG}
    result = score(keys, {"a": answer(finding("hard_iron_step")), "b": ADEQUATE, "c": answer(finding("offset_drift"))})
    yield "proof", proof_page(ProofScore((), result, tuple(result.cases)), {LONG: result}, settings)
    yield "scenarios", proof_page(scenario_score.all_kinds(), {}, settings)


def test_calibration_refusal_and_proof_pages_fit_a_telephone(tmp_path):
    places = {}
    for name, page in other_pages():
        places[name] = f"{name}.html"
        (tmp_path / places[name]).write_text(page, encoding="utf-8")
    assert widths_of(places, tmp_path) == dict.fromkeys(places, WIDTH)


@pytest.mark.parametrize("opened", [False, True])
@pytest.mark.parametrize("kind", PAGES)
def test_diagnosis_pages_fit_a_telephone(kind, opened, tmp_path):
    assert width_of(diagnosis_report(PAGES[kind]()), tmp_path, opened=opened) == WIDTH


def test_a_page_that_is_too_wide_is_detected(tmp_path):
    page = diagnosis_report(make_unfit()).replace("</main>", '<div style="width:700px">x</div></main>')
    assert width_of(page, tmp_path, opened=False) > WIDTH
