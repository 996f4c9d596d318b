"""The comparison of several recordings: what is common, what differs, and which recordings depart."""

import re

import pytest
import torch

from mkc_torch.report.fleet import fleet_of, fleet_report
from mkc_torch.report.fleet.sentences import conclusions, headline


def content(
    value=None, *, effect="quadratic_drag", error=0.01, grade="left_out", answer="usable", heat=20.0, start=0.0
):
    """The content of a diagnosis.json with one finding, or none."""
    number = {"name": "drag", "value": value, "standard_error": error, "unit": "1/m"}
    finding = {
        "effect": effect, "grade": grade, "drivers": [], "channels": ["rate of speed"], "parameters": [number],
    }  # fmt: skip
    return {
        "simulation": "Cart",
        "verdict": "adequate" if value is None else "explained",
        "answer": answer,
        "search": {"stopped": None},
        "baseline": {"outputs": {"speed": {"rmse": 0.3, "unit": "m/s"}}},
        "corrected": {"outputs": {"speed": {"rmse": 0.005, "unit": "m/s"}}},
        "findings": [] if value is None else [finding],
        "conditions": {"start": {"value": 0.0, "unit": "s"}, "heat": {"value": heat, "unit": "degC"}},
    }


def drawn(units, spread, seed=0, slope=0.0):
    g = torch.Generator().manual_seed(seed)
    heat = 20.0 + 5.0 * torch.randn(units, generator=g, dtype=torch.float64)
    noise = torch.randn(2, units, generator=g, dtype=torch.float64)
    values = 0.4 + slope * (heat - 20.0) + spread * noise[0] + 0.01 * noise[1]
    return {f"unit{k}": content(float(v), heat=float(h)) for k, (v, h) in enumerate(zip(values, heat, strict=True))}


def test_sizes_that_agree_are_a_single_size():
    fleet = fleet_of(drawn(8, 0.0))
    (sentence,) = conclusions(fleet)
    assert sentence.startswith("Quadratic drag, rate of speed (`drag`) in all 8 recordings: 0.4")
    assert "agree within their errors" in sentence
    assert headline(fleet) == "8 of 8 recordings diagnosed, 8 usable"


def test_sizes_that_differ_have_a_spread_and_a_recording_that_departs_is_named():
    diagnoses = drawn(9, 0.05) | {"odd": content(1.4)}
    (quantity,) = fleet_of(diagnoses).quantities
    assert quantity.rest is not None
    assert quantity.rest.spread == pytest.approx(0.05, rel=0.5)
    assert quantity.rest.spread_low > 0.0
    text = " ".join(conclusions(fleet_of(diagnoses)))
    assert "so that each recording has its own size" in text
    assert "`odd` departs from the others: 1.400 ± 0.010 1/m" in text
    assert "The others: mean 0." in text


def test_an_effect_of_one_recording_is_stated_apart_from_one_of_some():
    diagnoses = drawn(3, 0.0) | {"own": content(0.2, effect="backlash"), "none": content()}
    text = " ".join(conclusions(fleet_of(diagnoses)))
    assert "in 3 of 5 recordings: 0.4" in text
    assert "In one recording: backlash, rate of speed (`drag`), 0.200 ± 0.010 1/m in own." in text


def test_a_trend_with_a_condition_is_stated_with_its_slope():
    text = " ".join(conclusions(fleet_of(drawn(15, 0.005, slope=0.02))))
    found = re.search(r"It changes with the mean of heat: (0\.\d+) ± (0\.\d+) 1/m per degC", text)
    assert found is not None
    assert abs(float(found[1]) - 0.02) < 4.0 * float(found[2]) < 0.01
    assert "It changes" not in " ".join(conclusions(fleet_of(drawn(15, 0.005))))


def test_unconfirmed_sizes_are_compared_and_nearest_effects_are_not():
    diagnoses = {name: content(0.4, grade="unconfirmed") for name in "abc"} | {"d": content(0.9, grade="nearest")}
    fleet = fleet_of(diagnoses)
    (sentence,) = conclusions(fleet)
    assert "in 3 of 4 recordings, unconfirmed in 3: 0.4" in sentence
    assert "0.900 ± 0.010 1/m (nearest)" in fleet_report(fleet)


def test_components_of_a_vector_are_compared_one_by_one():
    diagnoses = {}
    for name, y in (("a", 0.2), ("b", 0.3)):
        one = content([0.5, y], error=[0.01, 0.01])
        one["findings"][0]["channels"] = ["x", "y"]
        diagnoses[name] = one
    x, y = fleet_of(diagnoses).quantities
    assert (x.parameter, y.parameter) == ("drag, x", "drag, y")
    assert x.pooled.agree
    assert y.pooled.mean == pytest.approx(0.25)
    unknown = content([[0.5, 0.2]], error=[[0.01, None]])
    assert [q.parameter for q in fleet_of({"a": unknown}).quantities] == [
        "drag, rate of speed, 1",
        "drag, rate of speed, 2",
    ]


@pytest.mark.parametrize("error", [None, 0.0])
def test_sizes_without_an_error_are_listed_and_not_compared(error):
    fleet = fleet_of({name: content(0.4, error=error) for name in "ab"})
    assert fleet.quantities[0].pooled is None
    assert conclusions(fleet) == ["Quadratic drag, rate of speed (`drag`) in all 2 recordings."]


def test_the_page_has_every_recording_and_every_failure_as_text():
    diagnoses = drawn(4, 0.05) | {"<odd>": content(1.4), "stopped": content() | {"search": {"stopped": {}}}}
    page = fleet_report(fleet_of(diagnoses, {"broken.csv": "no column <time>"}))
    for text in ("unit0/report.html", "&lt;odd&gt;", "broken.csv: no column &lt;time&gt;", "adequate, stopped", "<svg"):
        assert text in page
    assert page.count('class="bad"') == 1
    assert "0.300 → 0.00500 m/s" in page
    assert "No effect was found in any recording." in fleet_report(fleet_of({"a": content()}))
