import dataclasses
import math
import re

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from mkc_torch.diagnosis.result import Candidate, DriverShift, Extrapolation, Region, Separability, StateMap
from mkc_torch.report import diagnosis_wording as say
from mkc_torch.report.diagnosis import bars, diagnosis_report, heat_map
from tests.diagnosis.factory import CHANNELS, make_candidates, make_diagnosis, make_separability
from tests.test_report import parsed, text_of


def page_of(findings=1, **options):
    return diagnosis_report(make_diagnosis(findings, **({"samples": 600} | options)))


def first_changed(diagnosis, **changes):
    first, *rest = diagnosis.findings
    return dataclasses.replace(diagnosis, findings=(dataclasses.replace(first, **changes), *rest))


@pytest.fixture(scope="module")
def three():
    return page_of(3, channels=3)


def test_page_is_well_formed_with_unique_ids(three):
    tags = parsed(three)
    assert len(tags.ids) == len(set(tags.ids))
    assert three.count("<svg ") == 4


def test_page_loads_nothing(three):
    assert "<script" not in three
    assert "@import" not in three
    sources = re.findall(r'(?:href|src)="([^"]*)"', three) + re.findall(r"url\(([^)]*)\)", three)
    assert sources
    assert all(source.startswith(("#", "data:")) for source in sources)
    addresses = re.findall(r'https?://[^"\s<]*', three)
    vocabularies = ("http://www.w3.org/", "http://purl.org/dc/", "http://creativecommons.org/ns#")
    assert all(address.startswith(vocabularies) for address in addresses)


def test_references_inside_the_pictures_resolve(three):
    ids = set(parsed(three).ids)
    for target in re.findall(r'href="#([^"]*)"', three) + re.findall(r"url\(#([^)]*)\)", three):
        assert target in ids


@pytest.mark.parametrize("findings", [0, 1, 2, 3])
@pytest.mark.parametrize("channels", [1, 2, 4])
@pytest.mark.parametrize("has_time", [True, False])
def test_every_shape_has_a_page(findings, channels, has_time):
    page = page_of(findings, channels=channels, has_time=has_time, samples=240)
    text = text_of(page)
    assert page.count("<svg ") == 1 + findings
    assert "nan" not in text.lower()
    assert "None" not in text
    for name in CHANNELS[:channels]:
        assert f"{'Before' if findings else 'Residual'}, {name}" in text
    assert ("time (s)" in text) == has_time


@pytest.mark.parametrize("samples", [1, 2, 9])
@pytest.mark.parametrize("findings", [0, 2])
def test_few_samples_have_a_page(samples, findings):
    assert "samples" in text_of(page_of(findings, samples=samples))


def test_adequate_says_so_with_its_noise():
    text = text_of(page_of(0))
    assert "Nothing is missing that this recording could show." in text
    assert "would find as much in 37 % of recordings (p = 0.37; the level asked for is 0.05)" in text
    assert "memory of 2 samples and 11 % outliers" in text
    assert "mkc apply" not in text
    assert "with the findings" not in text


def test_explained_answers_what_where_how_sure_and_how_much_better():
    diagnosis = make_diagnosis(1, samples=4500)
    text = text_of(diagnosis_report(first_changed(diagnosis, alternatives=diagnosis.findings[0].alternatives[:1])))
    assert "Left out of the simulation: hard-iron step." in text
    assert "offset change (3.214 ± 0.081, −1.104 ± 0.077, 0.325 ± 0.092) µT; onset 41.32 ± 0.14 s" in text
    assert "From 41.3 s on; acts on mag_x, mag_y, mag_z." in text
    assert "p = 0.005, the smallest that 199 surrogates can show" in text
    assert "On data the fit had not seen, the residual is" in text
    assert "Record at two more temperatures" in text
    assert "+0.312 nats a sample (95 %: 0.281 to 0.350); residual 0.912 → 0.521 µT (43 % less)" in text
    assert "offset drift 41.2 yes" in text


def test_rivals_that_cannot_be_told_apart_stand_in_the_headline():
    text = text_of(page_of(1))
    assert "hard-iron step or current field (current), which this recording cannot tell apart." in text
    assert "current field (current) 1.30 no" in text
    assert "not to be told from finding 1" in text
    assert "hard-iron step, or a rival; current field (current); an effect outside" in text_of(page_of(3))


def test_unexplained_says_so():
    text = text_of(page_of(0, verdict="unexplained", p_value=0.005))
    assert "Structure remains that no effect in the catalogue accounts for." in text
    assert "Record more columns" in text
    both = text_of(page_of(2, verdict="unexplained"))
    assert "Yet structure remains that no effect in the catalogue accounts for." in both


def test_findings_that_are_not_plausible_or_not_held_out_say_so(three):
    text = text_of(three)
    assert "Not plausible: an effect outside the catalogue. A curve has no size to compare." in text
    assert "not measured: The event has no second occurrence to be held out." in text
    assert "(4.02 ± 0.11) × 10⁻⁶ 1/µT²" in text
    assert "mainly from 12.1 to 18.4 s and from 60.0 to 71.5 s" in text_of(page_of(2, samples=4500))


def test_names_and_texts_from_files_are_escaped_everywhere():
    bad = "<b>x</b> & $a$ \x1b[31m"
    diagnosis = make_diagnosis(2, samples=300, channels=2)
    traces = dataclasses.replace(
        diagnosis.traces, channels=(bad, "_y"), unit=bad, drivers={bad: diagnosis.traces.time},
        driver_units={bad: bad},
    )  # fmt: skip
    hostile = dataclasses.replace(
        diagnosis, recording=bad, simulation=bad, warnings=(bad,), advice=(bad,), traces=traces,
        noise=dataclasses.replace(diagnosis.noise, description=bad, parameters={bad: 1.0}),
        candidates=(Candidate("driver_offset", (bad,), bad, 3.0, 2.4),),
        separability=Separability((bad,), torch.zeros(1, 1), torch.ones(1)),
    )  # fmt: skip
    first = hostile.findings[0]
    (parameter, *_) = first.parameters
    (rival, *_) = first.alternatives
    hostile = first_changed(
        hostile, drivers=(bad,), channels=(bad,), equation=bad, explanation=bad, held_out_note=bad, plausibility=bad,
        parameters=(dataclasses.replace(parameter, name=bad, unit=bad),),
        alternatives=(dataclasses.replace(rival, drivers=(bad,), separable=False),),
        curve=dataclasses.replace(first.curve, driver=bad, unit=bad, channels=(bad, "_y"), value_unit=bad),
    )  # fmt: skip
    page = diagnosis_report(hostile, note=bad)
    assert "<b>" not in page
    assert "&lt;b&gt;x&lt;/b&gt; &amp; $a$" in page
    parsed(page)


def test_names_in_letters_that_the_font_lacks():
    diagnosis = make_diagnosis(2, samples=300)
    assert "温度" in text_of(diagnosis_report(dataclasses.replace(
        diagnosis, traces=dataclasses.replace(diagnosis.traces, channels=("温度",)),
    )))  # fmt: skip


def test_of_many_candidates_the_best_twelve_are_shown():
    page = page_of(1, candidates=300, candidates_tried=300, separability=make_separability(20))
    text = text_of(page)
    assert "The best 12 of 300 that were tried." in text
    assert "The first 12 of 20." in text
    assert len(bars(make_candidates(300))) == 12
    assert len(page) < 400_000


def test_bars_are_in_proportion_and_never_negative():
    shown = bars((Candidate("a", (), "", 10.0, 4.5), Candidate("b", (), "", -1.0, 0.0)))
    assert [b.percent for b in shown] == [100.0, 0.0]
    assert [b.percent for b in bars((Candidate("a", (), "", 0.0, 0.0),))] == [0.0]


def test_heat_map_colours_run_from_inseparable_to_clear():
    share = torch.tensor([[0.0, 1.0], [0.02, math.nan]])
    first, second = heat_map(Separability(("a", "b"), share, torch.tensor([0.5, 1.2])))
    assert [c.text for c in first] == ["0.50", "·", "1.00"]
    assert [c.text for c in second] == ["1.00", "0.02", "·"]
    assert first[2].color == second[0].color == "#d6e8f4"
    assert heat_map(Separability((), torch.zeros(0, 0), torch.zeros(0))) == []


def test_pages_without_candidates_curves_and_separability():
    empty = Separability((), torch.zeros(0, 0), torch.zeros(0))
    diagnosis = make_diagnosis(1, samples=300, candidates=0, separability=empty, ceiling=None, advice=(), warnings=())
    page = diagnosis_report(first_changed(diagnosis, curve=None))
    assert page.count("<svg ") == 1
    text = text_of(page)
    assert "The candidates" not in text
    assert "What this recording can tell apart" not in text
    assert "ceiling" not in text


def test_the_ceiling_stands_beside_the_models_compared():
    for findings in (0, 2):
        diagnosis = make_diagnosis(findings, samples=300, channels=2)
        rows = dict(say.held_out_rows(diagnosis))
        assert list(rows)[-1] == "with any smooth correction (the ceiling)"
        assert rows["with any smooth correction (the ceiling)"] == [
            f"{diagnosis.ceiling.rmse:.3f}", "−0.895", "1.40, 1.40", "0.300, 0.300",
        ]  # fmt: skip
        text = text_of(diagnosis_report(diagnosis))
        assert f"with any smooth correction (the ceiling) {diagnosis.ceiling.rmse:.3f} −0.895" in text
        assert "The ceiling is how far curves of all columns and of time come" in text


def test_whether_a_finding_extrapolates_is_said():
    diagnosis = make_diagnosis(2, samples=300)
    assert "beyond its range" not in text_of(diagnosis_report(diagnosis))
    for gain, interval, told in (
        (0.31, (0.28, 0.35), "it predicts where that is high: +0.310 nats a sample (95 %: 0.280 to 0.350)"),
        (-0.02, (-0.12, 0.09), "it says nothing where that is high: −0.020"),
        (-0.3, (-0.4, -0.2), "it misleads where that is high: −0.300"),
    ):
        text = text_of(diagnosis_report(first_changed(diagnosis, extrapolation=Extrapolation(gain, interval))))
        assert f"beyond its range fitted where its driver is low, {told}" in text


def test_what_shifted_copies_of_the_driver_gain_is_said():
    for as_good, told in ((0, "none of 38 copies"), (1, "one of 38 copies"), (12, "12 of 38 copies")):
        changed = first_changed(
            make_diagnosis(1, samples=240), drivers=("load",), driver_shift=DriverShift(38, as_good, 22.5)
        )
        verb = "gain" if as_good > 1 else "gains"
        assert f"driven by load; {told} shifted by up to 22.5 s {verb} as much" in text_of(diagnosis_report(changed))


def test_where_in_the_states_and_in_which_experiment_is_told_and_drawn():
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
    assert "91 % of the gain where angle is beyond ±0.800 rad, 20 % of the time" in text
    assert "experiment 2: 75 %, experiment 1: 25 %" in text
    assert page.count("<svg ") == page_of(1, samples=240).count("<svg ") + 1
    assert "speed (rad/s)" in page
    assert "Gain of finding 1 over the states" in page


def test_drivers_that_switch_are_constant_or_missing():
    diagnosis = make_diagnosis(2, samples=400)
    time = diagnosis.traces.time
    for column in ((time > 4.0).double(), torch.ones_like(time), torch.full_like(time, math.nan)):
        traces = dataclasses.replace(diagnosis.traces, drivers={"current": column})
        assert "current (A)" in text_of(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))
    traces = dataclasses.replace(diagnosis.traces, drivers={})
    assert "current (A)" in text_of(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))


def test_residuals_of_zero_and_of_nothing_in_use():
    diagnosis = make_diagnosis(2, samples=300)
    for before, weight in ((0.0, 1.0), (1.0, 0.0)):
        traces = dataclasses.replace(
            diagnosis.traces,
            before=torch.full_like(diagnosis.traces.before, before),
            after=torch.zeros_like(diagnosis.traces.before),
            weight=torch.full_like(diagnosis.traces.weight, weight),
        )
        parsed(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))


def test_single_precision_and_tensors_with_gradients():
    diagnosis = make_diagnosis(2, samples=300)
    t = diagnosis.traces
    traces = dataclasses.replace(t, before=t.before.float().requires_grad_(), after=t.after.float())
    parsed(diagnosis_report(dataclasses.replace(diagnosis, traces=traces)))


def test_same_input_gives_the_same_page_and_leaves_matplotlib_alone():
    import matplotlib

    before = dict(matplotlib.rcParams)
    assert page_of(2) == page_of(2)
    assert dict(matplotlib.rcParams) == before


def test_parameters_read_well():
    assert say.measured(0.0, 0.0, "µT") == ["0 µT"]
    assert say.measured(1234.5, 12.0, "") == ["1234 ± 12"]
    assert say.measured(2.5e7, 1.2e6, "counts") == ["(2.50 ± 0.12) × 10⁷ counts"]
    assert say.measured((1e-9, -2e-9), None, "T") == ["(1.00, −2.00) × 10⁻⁹ T"]
    assert say.measured(((1.0, 2.0), (3.0, 4.0)), ((0.1, 0.1), (0.1, None)), "") == [
        "(1.00 ± 0.10, 2.00 ± 0.10)",
        "(3.00 ± 0.10, 4.00)",
    ]
    assert say.measured((), None, "µT") == ["() µT"]
    assert say.measured(math.nan, None, "") == ["not known"]


def test_moments_have_the_digits_of_the_recording():
    def onset(seconds):
        traces = make_diagnosis(1, samples=50).traces
        clock = say.clock_of(dataclasses.replace(traces, time=torch.linspace(0.0, seconds, 50)))
        return clock.moment(1.23456789)

    assert (onset(0.5), onset(90.0), onset(5000.0)) == ("1.235 s", "1.2 s", "1 s")
