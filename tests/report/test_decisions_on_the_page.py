"""How a diagnosis was decided, on the page."""

import dataclasses

import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from mkc_torch.diagnosis.decisions import Decision, ScoredModel, Trail
from mkc_torch.report.diagnosis.decisions import decision_rows, model_rows
from mkc_torch.report.diagnosis.page import diagnosis_report
from tests.diagnosis.factory import make_diagnosis
from tests.report.exclusive import page_rows

MODELS = (
    ScoredModel((), "", 790.0, {"log_likelihood": 793.5, "parameters": 3.5}, "white", {"speed": 0.31}),
    ScoredModel(("linear_drag@speed",), "add linear_drag@speed", None, {}, "white", {}),
    ScoredModel(
        ("coulomb_friction@speed", "input_lag@command"),
        "add input_lag@command",
        812.5,
        {"log_likelihood": 830.0, "parameters": 10.5, "terms": 7.0},
        "process noise of speed",
        {"speed": 0.021},
        chosen=True,
        suspected=True,
    ),
)
DECISIONS = (
    Decision("p_value", "coulomb_friction@speed", 0.01, 0.05, True, "p = 0.01 after the whole search.", 1),
    Decision("size_plausible", "coulomb_friction@speed", 12.0, 10.0, False, "Its size is -12 times `x` <b>.", 1),
    Decision("explained_share", "", None, 0.35, True, "The simulation explains the recording."),
)
TITLE = "How this was decided"


def page_of(trail):
    return diagnosis_report(dataclasses.replace(make_diagnosis(0, samples=50), decisions=trail))


def test_models_are_scored_from_the_best_one():
    alone, unscored, chosen = model_rows(Trail(MODELS))
    assert (alone.terms, alone.score, alone.log_likelihood, alone.prices) == (
        "the simulation alone", "−22.5", "793.5", "parameters 3.5",
    )  # fmt: skip
    assert (unscored.score, unscored.log_likelihood, unscored.open_loop) == ("not scored", "–", "")
    assert (chosen.terms, chosen.score) == ("coulomb_friction@speed + input_lag@command", "0.0")
    assert (chosen.prices, chosen.mark) == ("parameters 10.5, terms 7.0", "chosen, suspected")


def test_a_scored_model_without_an_open_loop_residual_loses_the_recording():
    (row,) = model_rows(Trail((dataclasses.replace(MODELS[0], open_loop={}),)))
    assert row.open_loop == "loses the recording"


def test_decisions_have_their_rules_in_words():
    first, second, whole = decision_rows(Trail((), DECISIONS))
    assert (first.subject, first.rule, first.value, first.threshold) == (
        "coulomb_friction@speed", "p-value at most the level", "0.01", "0.05",
    )  # fmt: skip
    assert (second.passed, second.sentence) == (False, "Its size is −12 times `x` <b>.")
    assert (whole.subject, whole.value) == ("the whole diagnosis", "–")
    (unknown,) = decision_rows(Trail((), (dataclasses.replace(DECISIONS[0], rule="a_new_rule"),)))
    assert unknown.rule == "a new rule"


def test_the_section_opens_on_a_click_and_lists_models_and_decisions():
    page = page_of(Trail(MODELS, DECISIONS))
    assert f"<details><summary>{TITLE}</summary>" in page
    assert "<b>" not in page
    rows = page_rows(page)
    begin = rows.index(TITLE)
    section = rows[begin : begin + 12]
    assert section[1] == "Scored models"
    assert sum("chosen" in row and "coulomb_friction@speed" in row for row in section) == 1
    assert any(row.startswith("coulomb_friction@speed size plausible 12 10 no") for row in section)
    assert any(row.startswith("the whole diagnosis explained share") for row in section)


@pytest.mark.parametrize(("models", "decisions"), [(MODELS, ()), ((), DECISIONS)])
def test_a_table_without_rows_is_omitted(models, decisions):
    rows = page_rows(page_of(Trail(models, decisions)))
    assert TITLE in rows
    assert ("Scored models" in rows) == bool(models)
    assert ("Decisions" in rows) == bool(decisions)


def test_without_a_trail_there_is_no_section():
    assert TITLE not in page_of(Trail())
