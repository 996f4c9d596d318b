"""How a page reports the goodness of fit, the process noise, and whether an effect's shape fits the recording."""

import dataclasses
import math
import re

import pytest
import torch

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from mkc_torch.diagnosis.environment import ShapeCheck
from mkc_torch.diagnosis.evidence import prediction
from mkc_torch.diagnosis.result import DivergedBlock, HeldOut, ResidualSizes
from mkc_torch.report.diagnosis import environment, unseen
from mkc_torch.report.diagnosis import verdict as top
from mkc_torch.report.diagnosis.page import diagnosis_report
from tests.diagnosis.factory import (
    POOR_FITS,
    PROCESS_NOISE,
    graded,
    make_diagnosis,
    make_disturbance,
    make_environment,
    make_goodness_of_fit,
    make_unfit,
    with_another_shape,
    with_evidence,
)
from tests.report.test_calibration_report import parse_page, text_of


def disturbed(**changes):
    return make_diagnosis(
        0,
        simulation="Pendulum",
        samples=200,
        verdict="unexplained",
        p_value=0.4,
        environment=make_environment(**changes),
    )


def with_first(diagnosis, change):
    first, *rest = diagnosis.findings
    return dataclasses.replace(diagnosis, findings=(change(first), *rest))


def box_of(page):
    """Return the text of the box at the top and of the facts below the first picture."""
    head, facts = page.index('<div class="top'), page.index('<div class="top facts">')
    rows = page[facts : page.index("</table>", facts)]
    text = text_of(page[head : page.index("</div>", head)] + "</div>" + rows + "</table></div>")
    return re.sub(" ([.,:])", r"\1", text)  # after code


def test_the_box_has_the_goodness_of_fit_of_each_output_in_its_unit():
    followed = (make_goodness_of_fit(), make_goodness_of_fit("rate", "rad/s", 0.031, 1.4, 0.02, floor_source="samples"))
    quiet = make_diagnosis(
        0, samples=200, environment=make_environment(goodness_of_fit=followed, process_noise=(), disturbance=())
    )
    page = diagnosis_report(quiet)
    box = box_of(page)
    assert "The recording shows no missing physics." in box
    assert "angle: residual 0.00490 rad; noise floor 0.00500 rad (declared); explains 99.98 % of the variance" in box
    assert "rate: residual 0.0310 rad/s; noise floor 0.0200 rad/s (estimated); explains 99.95 %" in box
    assert "The residual is the sensor's noise. Input hold: torque is constant between samples." in box
    assert "µT" not in box.replace("reaches 0", "").split("For comparison")[0]
    assert '<h1 class="usable">' in page


def test_an_output_of_small_variation_has_no_explained_share():
    still = make_goodness_of_fit(residual=0.0051, variation=0.006, explained=0.2)
    (line,) = environment.output_lines(
        make_diagnosis(0, samples=50, verdict="unexplained", environment=make_environment(goodness_of_fit=(still,)))
    )
    assert line.startswith("angle: residual 0.00510 rad; noise floor 0.00500 rad (declared)")
    assert "explains" not in line


def test_the_table_has_all_of_many_outputs():
    many = tuple(make_goodness_of_fit(f"motor_{i}", "rad/s", rmse_of_last_value=math.nan) for i in range(9))
    page = diagnosis_report(
        make_diagnosis(
            0, samples=100, environment=make_environment(goodness_of_fit=many, process_noise=(), disturbance=())
        )
    )
    assert "and 3 more outputs; see the table" in box_of(page)
    assert "motor_8 0.00490 rad/s 0.00500 rad/s (declared) 0.350 rad/s 99.98 % 0.350 rad/s unknown" in text_of(page)


def test_the_page_of_a_poor_fit_starts_with_it_and_names_no_physics():
    page = diagnosis_report(make_unfit())
    box = box_of(page)
    assert box.startswith("The simulation does not fit the recording.")
    assert (
        "angle: the simulation explains 12 % of the variance; RMSE 0.360 rad, of the output's mean 0.350 rad; "
        "noise floor 0.00500 rad (declared)"
    ) in box
    assert "Why Another start reaches 0.006 rad: gravity = −9.81 with the other sign. damping ends at its bound" in box
    assert '<h1 class="unusable">' in page
    text = text_of(page)
    for words in ("The simulation can be used", "no missing physics", "The candidates", "hard-iron", "distinguish"):
        assert words not in text


def test_the_answer_is_usable_if_adequate_or_explained_look_if_unexplained_and_unusable_if_unfit():
    quiet = make_diagnosis(0, samples=50, environment=make_environment(process_noise=(), disturbance=()))
    assert [top.answer_word(d) for d in (quiet, make_unfit(), disturbed(), make_diagnosis(1, samples=50))] == [
        "usable", "unusable", "look", "usable",
    ]  # fmt: skip


def test_the_disturbance_has_a_picture_after_the_residual_with_size_and_correlation_time():
    page = diagnosis_report(disturbed())
    parse_page(page)
    assert page.index("Residual over time before and after") < page.index("Disturbance over time, and")
    box = box_of(page)
    assert box.startswith("Process noise acts on the rate of rate, and no physics in the catalogue explains it.")
    assert "Process noise on the rate of rate: 0.228 ± 0.021 rad/s², correlation time 0.7 s." in box
    assert (
        "A model without this noise of rate is less likely by a factor of more than a million. "
        "No physics is significant in addition to it." in box
    )
    text = text_of(page)
    assert "It is not white: it is correlated up to 0.7 s. It goes along with none of the inputs, at no lag." in text
    for name in ("Over angle", "Over rate", "Over torque"):
        assert name in text
    assert "the rate of rate 0.228 ± 0.021 rad/s² 0.7 s 311" in text
    assert "no missing physics" not in text


def test_a_quick_look_leaves_open_whether_a_finding_explains_the_process_noise():
    untested = dataclasses.replace(make_diagnosis(1, samples=50).findings[0], grade="unconfirmed", evidence=())
    look = dataclasses.replace(disturbed(), quick=True, findings=(untested,))
    sentence = top.headline(look)
    assert sentence.startswith("The simulation alone has process noise on the rate of")
    assert "a quick look does not test whether a finding explains it. Found, but not tested" in sentence
    assert "no physics" not in sentence


@pytest.mark.parametrize("samples", [1, 2, 5000])
@pytest.mark.parametrize("curves", [0, 1, 12])
def test_disturbances_of_any_length_and_number_of_curves_have_a_page(samples, curves):
    forcing = make_disturbance(samples)
    forcing = dataclasses.replace(forcing, curves=tuple(forcing.curves[i % 3] for i in range(curves)))
    page = diagnosis_report(disturbed(disturbance=(forcing,)))
    assert page.count("<figure") == 2
    assert len(page) < 500_000


def test_lines_of_pictures_are_interrupted_between_runs():
    from mkc_torch.diagnosis.plot.drawings import _joined

    time = torch.cat([torch.arange(5.0), torch.arange(5.0)]).numpy()
    assert math.isnan(_joined(time, time)[5])
    assert len(_joined(time, time)) == 11


def test_drift_of_a_sensor_is_reported_as_drift():
    slow = dataclasses.replace(
        PROCESS_NOISE, place="angle", at_rate=False, unit="rad", size=0.012, standard_error=0.002
    )
    text = text_of(diagnosis_report(disturbed(process_noise=(slow,), disturbance=(make_disturbance(200, slow),))))
    assert "A drift of angle adds to the sensor's noise, and no physics" in text
    assert "Drift of angle in addition to its white noise: 0.0120 ± 0.0020 rad, correlation time 0.7 s." in text
    assert "Drift of angle" in text


def test_two_drifts_of_an_output_share_a_sentence_and_have_numbered_headings():
    slow = dataclasses.replace(PROCESS_NOISE, place="angle", at_rate=False, unit="rad", correlation_time=29.0)
    fast = dataclasses.replace(slow, correlation_time=1.5)
    drifts = tuple(make_disturbance(200, process) for process in (slow, fast))
    text = text_of(diagnosis_report(disturbed(process_noise=(slow, fast), disturbance=drifts)))
    assert text.count("in addition to its white noise") == 1
    assert "correlation time 29 s; and" in text
    assert "Drift of angle , part 1 of 2" in text
    assert "Drift of angle , part 2 of 2" in text


def test_a_form_that_is_kept_at_a_small_p_value_has_a_reason():
    kept = ShapeCheck(5.2, 0.0055)
    made = with_first(make_diagnosis(1, samples=200), lambda finding: dataclasses.replace(finding, shape=kept))
    text = text_of(diagnosis_report(made))
    assert "is only a little better (p = 0.0055 if the name is right): the name is kept" in text


def test_an_effect_of_another_shape_is_nearest_and_its_free_curve_is_shown():
    made = with_first(make_diagnosis(1, samples=200, verdict="unexplained"), with_another_shape)
    page = diagnosis_report(made)
    headline = top.headline(made)
    assert headline.startswith("The residual has structure that no effect in the catalogue explains")
    assert "Nearest in the catalogue: hard-iron step (a free curve" in headline
    assert "nats" not in headline
    text = text_of(page)
    assert "Left out" not in text
    assert "Nearest in the catalogue: hard-iron step" in text
    assert "Free curve with its 95 % band, and the named shape" in text
    assert "Nearest formula: 0.0071 |x|^1.52 sign(x) ." in text
    assert "is clearly better (p = 0.002 if the name is right)" in text
    assert "163 nats" in text[text.index("How this was decided") :]
    assert page.index("Free curve and the shape of finding 1") < page.index("Curve of finding 1, and")
    parse_page(page)
    # of another driver than the named form: the free curve alone
    curve = dataclasses.replace(made.findings[0].curve, driver="difference")
    alone = with_first(made, lambda f: with_another_shape(f, curve=curve, formula=""))
    assert "Free curve, 95 % band" in text_of(diagnosis_report(alone))


@pytest.mark.parametrize(
    ("grade", "text"),
    [
        ("left_out", "Left out of the simulation: hard-iron step"),
        ("small", "Real, but small compared with the noise: hard-iron step"),
        ("unconfirmed", "Found, but not confirmed on held-out blocks: hard-iron step"),
    ],
)
def test_the_headline_depends_on_the_grade_only(grade, text):
    made = with_first(make_diagnosis(1, samples=50), lambda f: graded(f, grade))
    assert top.headline(made).startswith(text)


def test_small_findings_of_an_adequate_simulation_are_in_the_headline():
    small = with_first(make_diagnosis(1, samples=50, verdict="adequate"), lambda f: graded(f, "small"))
    assert top.headline(small).startswith("No missing physics is worth correcting. Real, but small")
    weak = with_first(small, lambda f: graded(f, "unconfirmed"))
    assert "no missing physics" in top.headline(weak)


def test_contrary_changes_of_likelihood_and_residual_have_a_reason():
    diverged = {"diverged_blocks": (DivergedBlock(3, before=True, after=False),), "blocks": 25}
    for held, reason in (
        (HeldOut(0.13, (-0.4, 0.66), 1.0, 0.29, "m"), "the gain varies between blocks by more than its mean"),
        (HeldOut(0.13, (-0.4, 0.66), 1.0, 0.29, "m", **diverged), "diverges in 1 of 25 blocks without the finding"),
        (HeldOut(0.3, (0.2, 0.4), 1.0, 1.3, "m"), "surely more likely on held-out blocks: the gain is in the tail"),
        (HeldOut(0.3, (0.2, 0.4), 1.0, 1.0, "m"), "surely more likely on held-out blocks: the gain is in the tail"),
        (HeldOut(-0.3, (-0.4, -0.2), 1.0, 0.5, "m"), "worse on held-out blocks: the loss is in the tail"),
        (
            HeldOut(0.3, (0.2, 0.4), 1.0, 1.3, "m", decides=False),
            "not shown to be better on held-out blocks: the open-loop",
        ),
        (
            HeldOut(-0.3, (-0.4, -0.2), 1.0, 0.5, "m", decides=False),
            "do not reject it: the open-loop residual is smaller",
        ),
        (HeldOut(0.1, (-0.4, 0.6), 1.0, 0.97, "m", decides=False), "little difference on held-out blocks"),
    ):
        assert reason in unseen.better(held)
        assert unseen.diverged(held) == ""
    sentence = unseen.diverged(HeldOut(0.3, (0.2, 0.4), 1.0, 0.5, "m", **diverged))
    assert "in 1 of 25 blocks without the finding" in sentence
    assert unseen.better(HeldOut(0.001, (-0.4, 0.4), 1.0, 0.99, "m")) == "not shown to be better on held-out blocks"


def test_each_output_has_its_own_residual_sizes_and_noise_floor():
    held = HeldOut(
        0.3, (0.2, 0.4), 15671.0, 0.661, "",
        {"angle": ResidualSizes(0.02, 0.0051, "rad"), "rate": ResidualSizes(0.3, 0.1, "rad/s")},
        (DivergedBlock(3, before=True, after=False),), 25,
    )  # fmt: skip
    made = make_diagnosis(
        2, samples=200, channels=2, simulation="Motor", environment=make_environment(process_noise=(), disturbance=())
    )
    traces = dataclasses.replace(made.traces, channels=("angle", "rate"), unit="")
    made = dataclasses.replace(made, traces=traces, findings=tuple(
        with_evidence(f, prediction.held_out_gain_result(held, "")) for f in made.findings
    ))  # fmt: skip
    for item in (made, dataclasses.replace(made, findings=made.findings[:1])):
        text = text_of(diagnosis_report(item))
        assert "angle 0.0200 → 0.00510 rad (74 % less), noise floor 0.00500 rad" in text
        assert "rate 0.300 → 0.100 rad/s (67 % less)" in text
        assert "15671" not in text
        assert "n 1 of 25 blocks without the finding" in text
    # without sizes of each output there is no joint size
    bare = dataclasses.replace(made, findings=tuple(dataclasses.replace(f, evidence=()) for f in made.findings))
    assert unseen.residual_of_all(bare) == []


def test_the_box_has_effect_time_size_and_evidence_of_each_finding():
    box = box_of(diagnosis_report(make_diagnosis(3, samples=4500)))
    for words in (
        "1 · Hard-iron step Left out of the simulation; not distinguished from: current field (current).",
        "offset change (3.214 ± 0.081, −1.104 ± 0.077, 0.325 ± 0.092) µT. From 41.3 s on; acts on mag_x",
        "p = 0.005; surely better on held-out blocks: residual 0.912 → 0.521 µT (43 % less).",
        "2 · Current field (current) Left out of the simulation. k (−0.170 ± 0.012",
        "3 · An effect outside the catalogue (temperature) Not confirmed on held-out blocks.",
    ):
        assert words in box


def test_warnings_follow_the_findings_and_start_with_those_of_findings():
    made = make_diagnosis(1, samples=200, warnings=("A column is empty.", "hard_iron_step may be a door."))
    page = diagnosis_report(made)
    assert top.warned(made) == ["Hard-iron step may be a door.", "A column is empty."]
    assert page.index("Alternatives") < page.index("may be a door") < page.index("Statistics</h2>")


def test_statistics_are_in_closed_details():
    page = diagnosis_report(disturbed(process_noise=(PROCESS_NOISE,)))
    closed = re.findall(r"<details><summary>([^<]*)</summary>", page)
    assert closed[:4] == [
        "Goodness of fit", "Process noise and drift", "Scores on held-out data",
        "Noise model of the tests",
    ]  # fmt: skip


def test_the_noise_floor_is_drawn_with_the_residual():
    made = make_diagnosis(
        0,
        samples=200,
        environment=make_environment(goodness_of_fit=(make_goodness_of_fit("norm", "µT"),), process_noise=()),
    )
    page = diagnosis_report(made)
    assert "Dotted: the sensor's noise floor." in text_of(page)
    without = diagnosis_report(
        dataclasses.replace(made, environment=make_environment(process_noise=()))
    )  # of no channel
    assert "Dotted" not in without
    assert page.count("stroke-dasharray") == without.count("stroke-dasharray") + 2


def test_nats_are_explained_once_before_their_first_use():
    text = "Log-likelihood gains are in nats"
    for made in (make_diagnosis(3, samples=100, channels=2), disturbed()):
        page = diagnosis_report(made)
        assert page.count(text) == 1
        first = page.index(" nats", page.index("<h1"))
        assert first in range(page.index(text), page.index(text) + 60)
    assert text not in diagnosis_report(make_unfit())


def test_names_in_the_environment_are_escaped():
    bad = "<b>x</b> & $a$"
    noise = dataclasses.replace(PROCESS_NOISE, place=bad, unit=bad)
    forcing = dataclasses.replace(make_disturbance(50, noise), sentences=(bad,))
    hostile = make_environment(
        goodness_of_fit=(make_goodness_of_fit(bad, bad),),
        process_noise=(noise,),
        input_hold={bad: "linear"},
        disturbance=(forcing,),
        reasons=(bad,),
    )
    for verdict in ("unfit", "unexplained"):
        page = diagnosis_report(make_diagnosis(0, samples=100, verdict=verdict, environment=hostile))
        assert "<b>" not in page
        parse_page(page)


def test_a_poor_fit_is_reported_as_a_poor_fit():
    lost = make_diagnosis(
        0, samples=50, environment=make_environment(goodness_of_fit=POOR_FITS, process_noise=(), disturbance=())
    )
    assert top.answer_word(lost) == "unusable"
    assert "does not fit the recording" in top.headline(lost)
