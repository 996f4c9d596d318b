import dataclasses
import math
import re

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from mkc_torch.density import ChannelTails
from mkc_torch.diagnosis.evidence import prediction, remaining, residual_noise, timing
from mkc_torch.diagnosis.findings.advice import advice_of
from mkc_torch.diagnosis.result import (
    CandidateScore,
    DensityCheck,
    DriverShift,
    EffectParameter,
    EvidenceResult,
    Extrapolation,
    HeldOut,
    Region,
    Separability,
    SmoothCorrection,
    StateMap,
)
from mkc_torch.report.diagnosis import noise, numbers, pictures
from mkc_torch.report.diagnosis import verdict as top
from mkc_torch.report.diagnosis.evidence import SECTIONS, Row, Section, Table
from mkc_torch.report.diagnosis.page import bars, diagnosis_report, heat_map
from tests.diagnosis.factory import CHANNELS, make_candidates, make_diagnosis, make_separability, with_evidence
from tests.report.test_calibration_report import parse_page, text_of


def page_of(findings=1, **options):
    return diagnosis_report(make_diagnosis(findings, **({"samples": 600} | options)))


def test_a_small_residual_after_the_findings_is_enlarged():
    made = make_diagnosis(1, samples=600)
    small = dataclasses.replace(made.traces, after=0.01 * made.traces.after)
    assert "enlarged" not in pictures.over_time(made)
    assert "After, norm, enlarged" in pictures.over_time(dataclasses.replace(made, traces=small))


def test_changes_of_a_model_are_shown_line_by_line_and_only_where_there_are_any():
    made = make_diagnosis(1, samples=600)
    page = diagnosis_report(made, changes='--- arm.xml\n+++ corrected.xml\n@@ -1 +1 @@\n-<joint/>\n+<joint a="1"/>')
    removed, added = (
        '<span class="removed">-&lt;joint/&gt;</span>',
        '<span class="added">+&lt;joint a=&#34;1&#34;/&gt;</span>',
    )
    assert f"--- arm.xml\n+++ corrected.xml\n@@ -1 +1 @@\n{removed}\n{added}\n" in page
    assert page.count('class="added"') == 1  # the names of the files are no changes
    assert "corrected.xml changes" not in diagnosis_report(made)


def first_changed(diagnosis, *said, **changes):
    first, *rest = diagnosis.findings
    first = with_evidence(first, *said)
    return dataclasses.replace(diagnosis, findings=(dataclasses.replace(first, **changes), *rest))


@pytest.fixture(scope="module")
def page_of_three_findings():
    return page_of(3, channels=3)


def test_the_page_is_well_formed_with_unique_ids(page_of_three_findings):
    tags = parse_page(page_of_three_findings)
    assert len(tags.ids) == len(set(tags.ids))
    assert page_of_three_findings.count("<figure") == 4


def test_the_page_loads_nothing(page_of_three_findings):
    assert "<script" not in page_of_three_findings
    assert "@import" not in page_of_three_findings
    sources = re.findall(r'(?:href|src)="([^"]*)"', page_of_three_findings) + re.findall(
        r"url\(([^)]*)\)", page_of_three_findings
    )
    assert sources
    assert all(source.startswith(("#", "data:")) for source in sources)
    addresses = re.findall(r'https?://[^"\s<]*', page_of_three_findings)
    vocabularies = ("http://www.w3.org/", "http://purl.org/dc/", "http://creativecommons.org/ns#")
    assert all(address.startswith(vocabularies) for address in addresses)


def test_references_inside_the_pictures_resolve(page_of_three_findings):
    ids = set(parse_page(page_of_three_findings).ids)
    for target in re.findall(r'href="#([^"]*)"', page_of_three_findings) + re.findall(
        r"url\(#([^)]*)\)", page_of_three_findings
    ):
        assert target in ids


@pytest.mark.parametrize("findings", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 2, 4])
@pytest.mark.parametrize("has_time", [True, False])
def test_pages_show_all_channels_for_any_number_of_findings(findings, channels, has_time):
    page = page_of(findings, channels=channels, has_time=has_time, samples=240)
    text = text_of(page)
    assert page.count("<figure") == 1 + findings
    assert "nan" not in text.lower()
    assert "None" not in text
    for name in CHANNELS[:channels]:
        assert f"{'Before' if findings else 'Residual'}, {name}" in text
    assert ("time (s)" in text) == has_time


@pytest.mark.parametrize("samples", [1, 2, 9])
@pytest.mark.parametrize("findings", [0, 2])
def test_recordings_of_few_samples_have_a_page(samples, findings):
    assert "samples" in text_of(page_of(findings, samples=samples))


def test_an_adequate_diagnosis_describes_its_noise():
    text = text_of(page_of(0))
    assert "The recording shows no missing physics." in text
    assert "p = 0.37, corrected for 64 candidates (level 0.05)" in text
    assert "memory of 2 samples and 11 % outliers" in text
    assert "mkc apply" not in text
    assert "with the findings" not in text


def test_an_explained_diagnosis_states_effect_time_evidence_and_improvement():
    diagnosis = make_diagnosis(1, samples=4500)
    text = text_of(diagnosis_report(first_changed(diagnosis, alternatives=diagnosis.findings[0].alternatives[:1])))
    assert "Left out of the simulation: hard-iron step." in text
    assert "offset change (3.214 ± 0.081, −1.104 ± 0.077, 0.325 ± 0.092) µT; onset 41.32 ± 0.14 s" in text
    assert "From 41.3 s on; acts on mag_x, mag_y, mag_z." in text
    assert "p = 0.005 or less, corrected for 64 candidates (level 0.05)." in text
    assert "On held-out data: residual 0.912 → 0.521 µT (43 % less)." in text
    assert "If it is hard-iron step: look for what changed at that time; use the calibration from after the" in text
    assert "residual 0.912 → 0.521 µT (43 % less) surely better on held-out blocks" in text
    assert "hard-iron step +0.312 nats per sample (95 %: 0.281 to 0.350) not tested not tested" in text
    assert "p-values come from 199 surrogates" in text
    assert "offset drift a factor of more than a million yes" in text


def test_the_summary_has_no_word_of_the_statistics_behind_it():
    for made in (make_diagnosis(0, samples=100), make_diagnosis(1, samples=100), make_diagnosis(3, samples=100)):
        page = diagnosis_report(made)
        top_of_page = text_of(page[page.index('<div class="top') : page.index("<h2", page.index('class="top facts"'))])
        assert not re.search("nats|surrogate", top_of_page)


def test_inseparable_rivals_are_in_the_headline():
    text = text_of(page_of(1))
    assert "hard-iron step or current field (current), which this recording cannot distinguish." in text
    assert "current field (current) a factor of 3.7 no" in text
    assert "not distinguished from finding 1" in text
    headline = "Left out of the simulation: hard-iron step, or an alternative; current field (current)."
    assert headline in text_of(page_of(3))


def test_an_unexplained_diagnosis_reports_the_remaining_structure():
    text = text_of(page_of(0, verdict="unexplained", p_value=0.005))
    assert "The residual has structure that no effect in the catalogue explains." in text
    assert "Record again, for longer, with more columns" in text
    both = text_of(page_of(2, verdict="unexplained"))
    assert "Structure remains that no effect in the catalogue explains." in both


def test_findings_that_are_not_plausible_or_not_held_out_are_marked(page_of_three_findings):
    text = text_of(page_of_three_findings)
    assert "Not plausible: an effect outside the catalogue (temperature). A curve has no size to compare." in text
    assert "not measured: The event has no second occurrence to be held out." in text
    assert "(4.02 ± 0.11) × 10⁻⁶ 1/µT²" in text
    assert "mainly from 12.1 to 18.4 s and from 60.0 to 71.5 s" in text_of(page_of(2, samples=4500))


def test_names_and_texts_from_files_are_escaped_everywhere(monkeypatch):
    bad = "<b>x</b> & $a$ \x1b[31m"
    section = Section((Row(bad, bad),), Table(bad, (bad,), ((bad,),), bad))
    monkeypatch.setitem(SECTIONS, "bad", lambda _: section)
    diagnosis = make_diagnosis(2, samples=300, channels=2)
    traces = dataclasses.replace(
        diagnosis.traces, channels=(bad, "_y"), unit=bad, drivers={bad: diagnosis.traces.time},
        driver_units={bad: bad},
    )  # fmt: skip
    hostile = dataclasses.replace(
        diagnosis, recording=bad, simulation=bad, warnings=(bad,), advice=(bad,), traces=traces,
        noise=dataclasses.replace(diagnosis.noise, description=bad, parameters={bad: 1.0}),
        candidates=(CandidateScore("driver_offset", (bad,), bad, 3.0, 2.4),),
        separability=Separability((bad,), torch.zeros(1, 1), torch.ones(1)),
    )  # fmt: skip
    first = hostile.findings[0]
    (parameter, *_) = first.parameters
    (rival, *_) = first.alternatives
    hostile = first_changed(
        hostile, prediction.held_out_gain_result(None, bad),
        EvidenceResult("bad", bad),
        drivers=(bad,), channels=(bad,), equation=bad, explanation=bad, plausibility=bad,
        parameters=(dataclasses.replace(parameter, name=bad, unit=bad),),
        alternatives=(dataclasses.replace(rival, drivers=(bad,), separable=False),),
        curve=dataclasses.replace(first.curve, driver=bad, unit=bad, channels=(bad, "_y"), value_unit=bad),
    )  # fmt: skip
    page = diagnosis_report(hostile, note=bad)
    assert "<b>" not in page
    assert "&lt;b&gt;x&lt;/b&gt; &amp; $a$" in page
    parse_page(page)


def test_names_with_glyphs_missing_in_the_font_are_shown():
    diagnosis = make_diagnosis(2, samples=300)
    assert "温度" in text_of(diagnosis_report(dataclasses.replace(
        diagnosis, traces=dataclasses.replace(diagnosis.traces, channels=("温度",)),
    )))  # fmt: skip


def test_the_page_shows_the_best_twelve_candidates():
    page = page_of(1, candidates=300, candidates_tried=300, separability=make_separability(20))
    text = text_of(page)
    assert "The best 12 of 300 candidates." in text
    assert "The first 12 of 20." in text
    assert len(bars(make_candidates(300))) == 12
    assert len(page) < 400_000


def test_bars_are_proportional_to_gains_and_not_negative():
    shown = bars((CandidateScore("a", (), "", 10.0, 4.5), CandidateScore("b", (), "", -1.0, 0.0)))
    assert [b.percent for b in shown] == [100.0, 0.0]
    assert [b.percent for b in bars((CandidateScore("a", (), "", 0.0, 0.0),))] == [0.0]


def test_the_heat_map_colours_separability():
    share = torch.tensor([[0.0, 1.0], [0.02, math.nan]])
    first, second = heat_map(Separability(("a", "b"), share, torch.tensor([0.5, 1.2])))
    assert [c.text for c in first] == ["0.50", "·", "1.00"]
    assert [c.text for c in second] == ["1.00", "0.02", "·"]
    assert first[2].color == second[0].color == "#d6e8f4"
    assert heat_map(Separability((), torch.zeros(0, 0), torch.zeros(0))) == []


def test_absent_candidates_curves_and_separability_are_omitted():
    empty = Separability((), torch.zeros(0, 0), torch.zeros(0))
    diagnosis = make_diagnosis(1, samples=300, candidates=0, separability=empty, ceiling=None, advice=(), warnings=())
    page = diagnosis_report(first_changed(diagnosis, curve=None))
    assert page.count("<figure") == 1
    text = text_of(page)
    assert "The candidates" not in text
    assert "Separability of the candidates" not in text
    assert "smooth correction" not in text


SMOOTH = "with a smooth correction by all recorded columns"


@pytest.mark.parametrize("findings", [0, 2])
def test_a_better_smooth_correction_is_listed_with_the_models_compared(findings):
    diagnosis = make_diagnosis(findings, samples=300, channels=2)
    rows = dict(noise.held_out_rows(diagnosis))
    assert list(rows)[-1] == SMOOTH
    assert rows[SMOOTH] == [f"{diagnosis.ceiling.rmse:.3f}", "−0.895", "1.40, 1.40", "0.300, 0.300"]
    text = text_of(diagnosis_report(diagnosis))
    assert f"{SMOOTH} {diagnosis.ceiling.rmse:.3f} −0.895" in text
    assert "It is not an upper bound: a step or a sharp corner can exceed it." in text
    present = f"{'with the findings' if findings else 'the residual is'} {diagnosis.corrected.rmse:.3f} µT"
    assert noise.smooth_fit(diagnosis).endswith(f"reaches {diagnosis.ceiling.rmse:.3f} µT; {present}")


def test_a_smooth_correction_worse_than_the_findings_is_not_reported():
    diagnosis = make_diagnosis(2, samples=300)
    worse = dataclasses.replace(diagnosis.ceiling, rmse=1.2 * diagnosis.corrected.rmse)
    beaten = with_evidence(diagnosis, remaining.as_result(SmoothCorrection(worse, ())))
    assert noise.smooth_fit(beaten) == ""
    assert list(dict(noise.held_out_rows(beaten))) == ["the simulation without findings", "with the findings"]
    text = text_of(diagnosis_report(beaten))
    assert "smooth correction" not in text
    assert "no bound" not in text
    # without findings it is reported in any case
    adequate = make_diagnosis(0, samples=300, ceiling=worse)
    assert "smooth correction" in text_of(diagnosis_report(adequate))


def headline_and_advice(gain, interval, before, after, verdict="explained"):
    """Return headline, answer and advice of a step with this held-out evidence, and the diagnosis."""
    held_out = HeldOut(gain, interval, before, after, "µT")
    diagnosis = first_changed(
        make_diagnosis(1, samples=240), prediction.held_out_gain_result(held_out, ""), alternatives=()
    )
    diagnosis = dataclasses.replace(diagnosis, verdict=verdict)
    diagnosis = dataclasses.replace(diagnosis, advice=advice_of(diagnosis))
    return top.headline(diagnosis), top.answer_word(diagnosis), " ".join(top.to_do(diagnosis)), diagnosis


def test_an_unconfirmed_finding_is_excluded_from_headline_advice_and_command():
    headline, answer, doing, diagnosis = headline_and_advice(0.134, (-0.019, 0.276), 1.74, 1.73, verdict="unexplained")
    assert headline.endswith("too small to be worth correcting: hard-iron step.")
    assert "Found, but not confirmed on held-out blocks and" in headline
    assert answer == "look"
    assert "Do not correct for hard-iron step yet" in doing
    assert "use the calibration" not in doing
    assert top.apply_command(diagnosis) == ""
    text = text_of(diagnosis_report(diagnosis))
    assert "probably better on held-out blocks, not surely" in text
    assert "mkc apply" not in text
    assert '<h1 class="look">' in diagnosis_report(diagnosis)
    larger, *_ = headline_and_advice(-0.16, (-0.41, 0.09), 0.269, 0.231, verdict="unexplained")
    assert larger.endswith("Found, but not confirmed on held-out blocks: hard-iron step.")


def test_a_finding_that_hardly_reduces_the_residual_is_reported_as_small():
    headline, answer, doing, diagnosis = headline_and_advice(0.05, (0.03, 0.07), 1.74, 1.70)
    assert headline.startswith("Real, but small compared with the noise: hard-iron step")
    assert answer == "usable"
    assert "Do not correct for hard-iron step, unless" in doing
    assert "by only 2.3 %" in doing
    assert top.apply_command(diagnosis) == ""


def test_a_confirmed_finding_is_reported_as_left_out_of_the_simulation():
    headline, answer, doing, diagnosis = headline_and_advice(0.31, (0.28, 0.35), 0.9, 0.5)
    assert headline.startswith("Left out of the simulation: hard-iron step")
    assert answer == "usable"
    assert doing.startswith("Look for what changed at that time; use the calibration from after the step.")
    assert "The model found here corrects for hard-iron step" in doing
    assert "surely better on held-out blocks" in text_of(diagnosis_report(diagnosis))


def test_structure_without_a_finding_is_in_the_headline():
    quiet = make_diagnosis(0, samples=240)
    assert top.answer_word(quiet) == "usable"
    rare = make_diagnosis(0, samples=240, p_value=0.04)
    assert top.headline(rare) == "The residual has structure that no effect in the catalogue explains."
    smooth = make_diagnosis(0, samples=240, remaining=("temperature",))
    assert top.headline(smooth).startswith("The residual has a smooth trend along temperature that no effect")
    for diagnosis in (rare, smooth):
        assert top.answer_word(diagnosis) == "look"
        text = text_of(diagnosis_report(diagnosis))
        assert "no missing physics" not in text
        assert "The simulation can be used" not in text
    found = make_diagnosis(1, samples=240, remaining=("load",))
    assert top.headline(found).endswith("A smooth trend along load remains that no effect in the catalogue explains.")


@pytest.mark.parametrize(
    ("simulation", "command"),
    [
        ("magnetometer", "mkc apply model.json NEW.csv --output corrected.csv"),
        ("simulated", "mkc apply model.json NEW.csv --simulator-output NEW_SIM.csv --output corrected.csv"),
        ("Pendulum", "mkc apply model.json NEW.csv --simulation FILE.py:Pendulum --output simulated.csv"),
    ],
)
def test_the_apply_command_has_the_options_of_the_simulation(simulation, command):
    assert top.apply_command(make_diagnosis(1, samples=50, simulation=simulation)) == command
    placed = first_changed(make_diagnosis(1, samples=50, simulation=simulation), location_specific=True)
    assert top.apply_command(placed) == ""


def test_event_times_and_component_labels_are_shown():
    jumps = EffectParameter(
        "heading_change", (11.2, 5.8, -1.2), (4.4, 3.9, 0.6), "°", ("jump at 61.1 s", "at 77.8 s", "c")
    )
    changed = first_changed(
        make_diagnosis(1, samples=4500),
        onset=61.1,
        event_times=(61.1, 77.8),
        parameters=(jumps,),
        channels=("heading",),
    )
    page = diagnosis_report(changed)
    text = text_of(page)
    assert "At 61.1 s and 77.8 s; acts on heading." in text
    assert "jump at 61.1 s: 11.2 ± 4.4 ° at 77.8 s: 5.8 ± 3.9 ° c: −1.2 ± 0.6 °" in text


def test_an_intermittent_step_is_reported_as_intermittent():
    intervals = ((8.0, 9.0), (20.0, 22.0), (34.0, 37.3), (50.0, 51.0))
    diagnosis = first_changed(
        make_diagnosis(1, samples=4500), timing.onset_result((5.9, 6.3)), timing.intermittency_result(True),
        onset=6.2, intervals=intervals, alternatives=(),
    )  # fmt: skip
    diagnosis = dataclasses.replace(diagnosis, advice=advice_of(diagnosis))
    text = text_of(diagnosis_report(diagnosis))
    label = "irst at 6.2 s (95 %: 5.9 to 6.3 s), then intermittent, mainly in 4 intervals, the longest from 34.0"
    assert text.count(label) == 2
    assert "intermittent hard-iron step" in top.headline(diagnosis)
    assert "from 6.2 s on" not in text
    assert "unrecorded cause that is switched on and off" in text
    assert "Look for a cause that is switched" in text
    assert "use the calibration from after the step" not in text


def test_the_reference_value_is_shown_with_the_equation():
    assert "δB = k (I − Ī) Ī: the mean of current over this recording, 15.0 A." in text_of(page_of(2))


def test_numbers_without_a_standard_error_are_marked():
    lag = (EffectParameter("lag", 1.5, None, "s"),)
    text = text_of(diagnosis_report(first_changed(make_diagnosis(1, samples=240), parameters=lag)))
    assert "lag 1.50 s, standard error not estimated" in text


def test_the_noise_has_the_share_of_the_errors_in_its_tail():
    tails = (ChannelTails(31.5, 0.041, 0.006), ChannelTails(1.3, 0.0027, 0.001))
    made = make_diagnosis(1, channels=2)
    texts = [text for _, text in noise.noise_parameters(dataclasses.replace(made.noise, tails=tails), ("x", "y"))]
    assert texts[-2].endswith("; heavy-tailed: 4.1 ± 0.6 % of the errors beyond 3 d (0.27 % if Gaussian)")
    assert texts[-1].endswith("; Gaussian")


def test_the_noise_has_units_and_its_density_is_compared():
    made = make_diagnosis(1, samples=240, channels=2)
    noise = dataclasses.replace(
        made.noise,
        parameters={"drift": 0.379, "drift_period": 7.21, "autoregression": ((0.26, 0.1), ())},
        units={"drift": "µT", "drift_period": "s"},
        unit="µT",
    )
    checks = [
        DensityCheck("norm", 0.021, 0.034, 4.0, 0.05, False),
        DensityCheck("turn_x", 0.2, 0.01, 2.0, 0.05, True),
    ]
    changed = with_evidence(dataclasses.replace(made, noise=noise), residual_noise.as_result(checks))
    text = text_of(diagnosis_report(changed))
    assert "Is the density right? channel distance of the density" in text
    assert "drift of the offset 0.379 µT, its standard deviation over the recording" in text
    assert "cut-off of the drift period 7.21 s" in text
    assert "autoregression of norm coefficients 0.260, 0.100" in text
    assert "memory of turn_x" not in text
    assert "d = 0.310 µT, within ±12.0 µT" in text
    assert "norm 0.021 0.034 (4 degrees of freedom) 0.05 not significant" in text
    assert "turn_x 0.2 0.01 (2 degrees of freedom) 0.05 a Student-t is closer" in text


def test_warnings_have_display_names_and_formatted_numbers():
    warning = "hard_iron_step by load (onset -6.1 s): p = 4e-05 at (-0.2, +0.9)."
    text = text_of(page_of(1, warnings=(warning,)))
    assert "Hard-iron step by load (onset −6.1 s): p = 4 × 10⁻⁵ at (−0.2, +0.9)." in text


def test_candidates_are_in_the_order_of_the_search():
    weak = CandidateScore("current_field", ("current",), "", 253.0, 22.5, behind=0.0)
    strong = CandidateScore("driver_offset", ("motor_1",), "", 294.0, 24.2, behind=31.5)
    never = CandidateScore("cubic_nonlinearity", (), "", 1.0, 1.4, behind=math.inf)
    text = text_of(diagnosis_report(dataclasses.replace(
        make_diagnosis(1, samples=240), candidates=(weak, strong, never),
    )))  # fmt: skip
    assert "penalised gap to the first, nats" in text
    assert "offset dependence (motor_1) 294 24.2 31.5" in text
    assert "not possible" in text
    assert text.index("current field (current) 253") < text.index("offset dependence (motor_1) 294")
    assert [bar.candidate for bar in bars((weak, strong, never))] == [weak, strong, never]
    assert "Bars: gain of the linearised model" in text


def test_channels_of_a_compared_vector_are_explained():
    diagnosis = make_diagnosis(0, samples=240, channels=2)
    traces = dataclasses.replace(diagnosis.traces, channels=("along", "across_1"))
    text = text_of(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))
    assert "along: residual along the ambient field" in text
    assert "across_1 and across_2: the two perpendicular residuals" in text


def test_numbers_of_pictures_are_explained_only_if_present():
    assert "Numbers at the top" in text_of(page_of(2, samples=4500))
    bare = make_diagnosis(2, samples=240)
    findings = tuple(dataclasses.replace(f, onset=None, intervals=()) for f in bare.findings)
    assert "Numbers at the top" not in text_of(diagnosis_report(dataclasses.replace(bare, findings=findings)))


def test_a_long_driver_name_is_not_truncated():
    made = make_diagnosis(1, samples=240)
    curve = dataclasses.replace(made.findings[0].curve, driver="position along its longest direction", unit="m")
    names = ("position_x", "position_y")
    drivers = dict.fromkeys(names, made.traces.time)
    wide = first_changed(made, curve=curve, drivers=names)
    wide = dataclasses.replace(wide, traces=dataclasses.replace(wide.traces, drivers=drivers))
    assert "position along its longest direction (m)" in text_of(diagnosis_report(wide))


@pytest.mark.e2e
def test_extrapolation_of_a_finding_is_reported():
    diagnosis = make_diagnosis(2, samples=300)
    assert "beyond its range" not in text_of(diagnosis_report(diagnosis))
    for gain, interval, label, number in (
        (
            0.31,
            (0.28, 0.35),
            "improves the prediction at high values",
            "+0.310 nats per sample (95 %: 0.280 to 0.350)",
        ),
        (-0.02, (-0.12, 0.09), "is not significant at high values", "−0.020 nats per sample"),
        (-0.3, (-0.4, -0.2), "degrades the prediction at high values", "−0.300 nats per sample"),
    ):
        result = prediction.extrapolation_result(Extrapolation(gain, interval))
        text = text_of(diagnosis_report(first_changed(diagnosis, result)))
        assert f"beyond its range fitted at low values of its driver, it {label}" in text
        assert f"hard-iron step +0.312 nats per sample (95 %: 0.281 to 0.350) {number}" in text


def test_the_gain_of_shifted_copies_of_the_driver_is_reported():
    for as_good, text in ((0, "none of 38 copies"), (1, "one of 38 copies"), (12, "12 of 38 copies")):
        changed = first_changed(
            make_diagnosis(1, samples=240),
            timing.driver_shift_result(DriverShift(38, as_good, 22.5)),
            drivers=("load",),
        )
        verb = "gain" if as_good > 1 else "gains"
        assert f"driven by load; {text} shifted by up to 22.5 s {verb} as much" in text_of(diagnosis_report(changed))


def test_the_region_of_the_states_and_the_share_of_each_run_are_shown():
    edges = tuple(torch.linspace(-1.0, 1.0, 5, dtype=torch.float64) for _ in range(2))
    nats = torch.arange(-3.0, 13.0, dtype=torch.float64).reshape(4, 4)
    nats[0, 0] = torch.nan
    page = diagnosis_report(
        first_changed(
            make_diagnosis(1, samples=240),
            region=Region("angle", "rad", "far from zero", 0.8, 0.91, 0.2),
            experiments=(0.25, 0.75),
            map=StateMap(("angle", "speed"), ("rad", "rad/s"), edges, nats),
        )
    )
    text = text_of(page)
    assert "91 % of the gain, in 20 % of the time: angle beyond ±0.800 rad" in text
    assert "run 2: 75 %, run 1: 25 %" in text
    assert page.count("<svg ") == page_of(1, samples=240).count("<svg ") + 1
    assert "speed (rad/s)" in page
    assert "Gain of finding 1 over the states" in page


def test_rows_and_table_of_any_evidence_test_are_shown(monkeypatch):
    section = Section(
        rows=(Row("residual", "correlated up to -0.4 s"), Row("in print", "more", in_terminal=False)),
        table=Table("By channel", ("channel", "lag"), (("norm", "0.4 s"),), "As far as -2 errors."),
    )
    monkeypatch.setitem(SECTIONS, "my_test", lambda _: section)
    result = EvidenceResult("my_test", 0.4)
    made = make_diagnosis(1, samples=240)
    for changed in (with_evidence(made, result), first_changed(made, result)):
        text = text_of(diagnosis_report(changed))
        assert "residual correlated up to −0.4 s in print more" in text
        assert "By channel channel lag norm 0.4 s As far as −2 errors." in text
    assert "Further evidence" in text_of(diagnosis_report(with_evidence(made, result)))
    assert "Further evidence" not in text_of(diagnosis_report(made))


@pytest.mark.e2e
def test_switched_constant_and_missing_drivers_have_a_page():
    diagnosis = make_diagnosis(2, samples=400)
    time = diagnosis.traces.time
    for column in ((time > 4.0).double(), torch.ones_like(time), torch.full_like(time, math.nan)):
        traces = dataclasses.replace(diagnosis.traces, drivers={"current": column})
        assert "current (A)" in text_of(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))
    traces = dataclasses.replace(diagnosis.traces, drivers={})
    assert "current (A)" in text_of(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))


def test_residuals_of_zero_and_without_weight_have_a_page():
    diagnosis = make_diagnosis(2, samples=300)
    for before, weight in ((0.0, 1.0), (1.0, 0.0)):
        traces = dataclasses.replace(
            diagnosis.traces,
            before=torch.full_like(diagnosis.traces.before, before),
            after=torch.zeros_like(diagnosis.traces.before),
            weight=torch.full_like(diagnosis.traces.weight, weight),
        )
        parse_page(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))


def test_float32_and_tensors_with_gradients_have_a_page():
    diagnosis = make_diagnosis(2, samples=300)
    t = diagnosis.traces
    traces = dataclasses.replace(t, before=t.before.float().requires_grad_(), after=t.after.float())
    parse_page(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))


def test_a_page_is_reproducible_and_does_not_change_matplotlib():
    import matplotlib

    before = dict(matplotlib.rcParams)
    assert page_of(2) == page_of(2)
    assert dict(matplotlib.rcParams) == before


def test_parameters_are_rounded_with_their_errors_and_units():
    assert numbers.measured(0.0, 0.0, "µT") == ["0 µT"]
    assert numbers.measured(1234.5, 12.0, "") == ["1234 ± 12"]
    assert numbers.measured(2.5e7, 1.2e6, "counts") == ["(2.50 ± 0.12) × 10⁷ counts"]
    assert numbers.measured((1e-9, -2e-9), None, "T") == ["(1.00, −2.00) × 10⁻⁹ T"]
    assert numbers.measured(((1.0, 2.0), (3.0, 4.0)), ((0.1, 0.1), (0.1, None)), "") == [
        "(1.00 ± 0.10, 2.00 ± 0.10)",
        "(3.00 ± 0.10, 4.00)",
    ]
    assert numbers.measured((), None, "µT") == ["() µT"]
    assert numbers.measured(math.nan, None, "") == ["unknown"]


def test_the_digits_of_a_time_follow_the_duration_of_the_recording():
    def onset(seconds):
        traces = make_diagnosis(1, samples=50).traces
        clock = numbers.clock_of(dataclasses.replace(traces, time=torch.linspace(0.0, seconds, 50)))
        return clock.moment(1.23456789)

    assert (onset(0.5), onset(90.0), onset(5000.0)) == ("1.235 s", "1.2 s", "1 s")
