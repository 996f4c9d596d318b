import dataclasses
import io
from pathlib import Path

import pytest

pytest.importorskip("rich")

from rich.console import Console

from mkc_torch.cli.diagnosis_summary import show
from mkc_torch.diagnosis.decisions import ScoredModel, Trail
from mkc_torch.diagnosis.result import EffectParameter, EvidenceResult, Region
from mkc_torch.report.diagnosis import verdict as top
from mkc_torch.report.diagnosis.evidence import SECTIONS, Row, Section
from tests.cli.commands import flat
from tests.diagnosis.factory import (
    graded,
    make_diagnosis,
    make_environment,
    make_goodness_of_fit,
    make_unfit,
    with_another_shape,
    with_evidence,
)


def summary_text(diagnosis, files=(), *, width=100, terminal=False, paths=None):
    stream = io.StringIO()
    console = Console(file=stream, width=width, force_terminal=terminal, highlight=False)
    show(console, diagnosis, [Path(file) for file in files], paths)
    return stream.getvalue()


def test_the_summary_of_a_finding_has_size_evidence_advice_and_files():
    text = summary_text(make_diagnosis(1), ["out/flight_07/diagnosis.json"])
    assert len(text.strip().splitlines()) <= 25
    for words in (
        "flight_07 against magnetometer",
        "Left out of the simulation: hard-iron step or current field (current)",
        "size offset change (3.214 ± 0.081, −1.104 ± 0.077, 0.325 ± 0.092) µT onset 41.32 ± 0.14 s",
        "where from 41.3 s on; acts on mag_x, mag_y, mag_z",
        "driven by no recorded column",
        "how sure p = 0.005 or less",
        "held out residual 0.912 → 0.521 µT (43 % less); surely better on held-out blocks",
        "named hard-iron step: left out of the simulation",
        "unexplained nothing",
        "or current field (current): this recording cannot distinguish",
        "compare a smooth correction by all recorded columns and by time reaches",
        "noise noise with a memory",
        "If it is hard-iron step: look for what changed at that time; use the calibration from after the step.",
        "to do To distinguish hard-iron step from current field (current), record again: a step does not come",
        "The model found here corrects for hard-iron step: confirm it on a second recording.",
        "mkc apply model.json NEW.csv --output corrected.csv",
        "warning 3 samples",
        "written out/flight_07/diagnosis.json",
    ):
        assert words in flat(text)


def test_the_summary_has_the_region_and_the_runs_of_a_finding():
    made = make_diagnosis(1)
    region = Region("speed", "rad/s", "near zero", 0.31, 0.82, 0.2)
    finding = dataclasses.replace(made.findings[0], region=region, experiments=(0.9, 0.1))
    text = flat(summary_text(dataclasses.replace(made, findings=(finding,))))
    assert "mostly 82 % of the gain, in 20 % of the time: speed within ±0.310 rad/s" in text
    assert "in run 1: 90 %, run 2: 10 %" in text


def test_the_summary_without_findings_has_p_value_and_advice():
    text = flat(summary_text(make_diagnosis(0)))
    assert "The recording shows no missing physics." in text
    assert "how sure p = 0.37, corrected for 64 candidates, level 0.05" in text
    assert "to do The simulation can be used" in text


def test_commands_are_not_wrapped():
    paths = top.RunPaths(f"/data/{'long_' * 30}.csv", "results/model.json", ())
    text = summary_text(make_diagnosis(1), paths=paths)
    assert any(f"mkc apply results/model.json {paths.recording} --output" in line for line in text.splitlines())


def test_several_findings_are_numbered():
    text = summary_text(make_diagnosis(3))
    for line in (
        "1  hard-iron step: left out of the simulation",
        "2  current field (current): left out of the simulation",
        "3  an effect outside the catalogue (temperature): not confirmed on held-out blocks",
    ):
        assert line in text.splitlines()
    assert "doubtful A curve has no size to compare." in flat(text)
    assert "together on held-out data: residual" in flat(text)
    assert "not surely Blocks of 4 s with gaps of 1 s." in flat(text)
    assert "nats" not in text
    assert "surrogates" not in text


def test_the_summary_states_structure_without_a_finding():
    text = flat(summary_text(make_diagnosis(0, verdict="unexplained", p_value=0.005)))
    assert "The residual has structure that no effect in the catalogue explains." in text


def test_markup_and_escape_codes_in_texts_from_files_have_no_effect():
    diagnosis = make_diagnosis(1, recording="[red]a[/red]\x1b[2J", warnings=("[/] \x1b]0;x\x07", "x" * 300))
    first = dataclasses.replace(diagnosis.findings[0], drivers=("[b]\x1b[2J",))
    text = summary_text(dataclasses.replace(diagnosis, findings=(first,)))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "[red]a[/red]" in text
    assert "[/]" in text


def test_long_paths_stay_on_one_line_and_many_warnings_are_counted():
    path = "folder/" * 20 + "report.html"
    text = summary_text(make_diagnosis(0, warnings=tuple(f"warning {i}" for i in range(40))), [path], width=80)
    assert any(line.endswith(path) for line in text.splitlines())
    assert "36 more; see report.html" in flat(text)


@pytest.mark.parametrize("width", [40, 60, 200])
def test_the_summary_fits_terminals_of_any_width(width):
    text = summary_text(make_diagnosis(3), width=width, terminal=True)
    assert "hard-iron step" in text


def test_every_test_of_evidence_has_a_row(monkeypatch):
    section = Section((Row("remaining", "white"), Row("in print", "more", in_terminal=False)))
    monkeypatch.setitem(SECTIONS, "my_test", lambda _: section)
    said = EvidenceResult("my_test", "white")
    made = make_diagnosis(1)
    of_finding = dataclasses.replace(made, findings=(with_evidence(made.findings[0], said),))
    for diagnosis in (with_evidence(made, said), of_finding):
        text = summary_text(diagnosis)
        assert "remaining white" in flat(text)
        assert "in print" not in text


def test_an_absent_smooth_correction_is_omitted():
    assert "smooth correction" not in summary_text(make_diagnosis(1, ceiling=None))


def test_a_significant_candidate_without_a_finding_is_unexplained():
    text = flat(summary_text(make_diagnosis(0, p_value=0.04)))
    assert "no missing physics" not in text
    assert "The residual has structure that no effect in the catalogue explains" in text
    assert "how sure p = 0.04" in text


def test_a_long_parameter_shows_its_largest_component():
    made = make_diagnosis(1)
    slopes = EffectParameter("gradient", (0.1, -0.6, 3.0, 0.2, 0.3, 0.4, 0.5), (0.1,) * 7, "µT/m", tuple("abcdefg"))
    text = flat(
        summary_text(dataclasses.replace(made, findings=(dataclasses.replace(made.findings[0], parameters=(slopes,)),)))
    )
    assert "size gradient, largest c: 3.00 ± 0.10 µT/m further parameters: see the report" in text


def first_lines(diagnosis):
    """Return the first lines, up to the unexplained structure."""
    text = flat(summary_text(diagnosis, width=200))
    return text[: text.index("unexplained") + 80] if "unexplained" in text else text


def test_fit_noise_named_and_unexplained_come_first():
    quiet = make_diagnosis(0, simulation="Pendulum", environment=make_environment(process_noise=(), disturbance=()))
    assert first_lines(quiet).startswith(
        "flight_07 against Pendulum The recording shows no missing physics. answer usable as it is "
        "fit angle: residual 0.00490 rad; noise floor 0.00500 rad (declared); explains 99.98 % of the variance "
        "noise The residual is the sensor's noise. Input hold: `torque` is constant between samples. named "
        "nothing unexplained nothing"
    )


def test_process_noise_is_in_the_headline_with_its_state():
    disturbed = make_diagnosis(
        0, simulation="Pendulum", verdict="unexplained", p_value=0.4, environment=make_environment()
    )
    text = first_lines(disturbed)
    assert "Pendulum Process noise acts on the rate of `rate`, and no physics in the catalogue" in text
    assert "noise Process noise on the rate of `rate`: 0.228 ± 0.021 rad/s², correlation time 0.7 s" in text
    assert "answer look: a part of the residual has no known cause fit" in text
    assert "named nothing unexplained the rate of `rate`" in text


def test_the_summary_of_a_poor_fit_names_no_physics():
    text = flat(summary_text(make_unfit(), width=200))
    assert text.startswith("flight_07 against Pendulum The simulation does not fit the recording. answer unusable: the")
    assert "explains 12 % of the variance; RMSE 0.360 rad, of the output's mean 0.350 rad" in text
    assert "why Another start reaches 0.006 rad" in text
    assert "named nothing: a simulation must fit before physics is named" in text
    for words in ("Use the simulation", "how sure", "compare", "unexplained"):
        assert words not in text


def test_nearest_and_unconfirmed_findings_are_not_listed_as_named():
    made = make_diagnosis(1, verdict="unexplained")
    for change, grade in (
        (with_another_shape, "nearest in the catalogue"),
        (lambda f: graded(f, "unconfirmed"), "not conf"),
    ):
        text = flat(summary_text(dataclasses.replace(made, findings=(change(made.findings[0]),)), width=200))
        assert f"named nothing confirmed; hard-iron step: {grade}" in text
        assert "unexplained unnamed structure" in text
    shape = flat(summary_text(dataclasses.replace(made, findings=(with_another_shape(made.findings[0]),)), width=200))
    assert "is clearly better (p = 0.002 if the name is right); 0.0071 |x|^1.52 sign(x)" in shape


def test_each_output_has_its_own_unit():
    followed = (
        make_goodness_of_fit(),
        make_goodness_of_fit("rate", "rad/s", 0.03, 1.4, 0.02, floor_source="quantisation"),
    )
    text = flat(summary_text(make_diagnosis(0, environment=make_environment(goodness_of_fit=followed)), width=200))
    assert "rate: residual 0.0300 rad/s; noise floor 0.0200 rad/s (resolution of the recording)" in text


def test_suspected_effects_are_compared_with_the_findings():
    alone = ScoredModel((), "", 800.0, {}, "white", {"angle": 0.02})
    lag = ScoredModel(("input_lag@torque",), "suspected", 812.3, {}, "white", {"angle": 0.0139}, suspected=True)
    text = summary_text(make_diagnosis(0, environment=make_environment(), decisions=Trail((alone, lag))))
    expected = "The suspected input_lag@torque scores 12.3 more than the simulation alone; it leaves 0.0139 rad."
    assert f"suspected {expected}" in flat(text)
