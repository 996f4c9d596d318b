"""The verdict, from assessments made by hand."""

import itertools
from dataclasses import replace

import pytest
import torch

from mkc_torch.diagnosis.decisions import Decision, Trail
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.verdict import FitAssessment, Remainder, decisions_on_all, failed_rules, grades_of, verdict_of
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.diagnosis.factory import make_goodness_of_fit

GOOD_FIT, POOR_FIT = make_goodness_of_fit(), make_goodness_of_fit(residual=0.33, explained=0.1)
HALFWAY = make_goodness_of_fit(residual=0.15, explained=0.8, floor=0.14)
FAILED = {"left_out": (), "small": ("residual_reduction",), "nearest": ("shape",), "unconfirmed": ("open_loop",)}
FIRST, SMALL = "left_out", "small"


def noise(*disturbances):
    return StateSpaceNoise(SelectedNoise(disturbances, (), (), torch.tensor([0.005]).double(), 0.0, (False,)), None)


DISTURBED = noise(Disturbance("rate", True, 1.0, 0.3))


def assessed(*follows, corrected=(), noise=None):
    return FitAssessment(follows, corrected, noise)


def decisions_of(grades):
    """Return decisions on findings of these grades."""
    rules = [("p_value", *FAILED[grade]) for grade in grades]
    return [
        Decision(rule, "drag@speed", 1.0, 0.5, rule == "p_value", "", number)
        for number, each in enumerate(rules, start=1)
        for rule in each
    ]


def trail_of(known, *grades, structure=False, white=True, flexible=False, **settings):
    left = Remainder(("A trend remains.",) if structure else (), 0.0 if white else 3.0)
    limits = EvidenceSettings(**settings)
    on_all = decisions_on_all(known, left, limits, findings=bool(grades), flexible=flexible)
    trail = Trail(decisions=(*decisions_of(grades), *on_all))
    assert known.unfit(limits) or grades_of(trail) == grades
    return trail


def verdict(known, *grades, **changes):
    return verdict_of(trail_of(known, *grades, **changes))


@pytest.mark.parametrize("known", [assessed(GOOD_FIT), assessed(GOOD_FIT, noise=noise()), assessed()])
def test_a_good_fit_with_white_residual_is_adequate(known):
    assert verdict(known) == "adequate"


@pytest.mark.parametrize(
    ("known", "changes"),
    [
        (assessed(GOOD_FIT), {"structure": True}),
        (assessed(GOOD_FIT), {"white": False}),
        (assessed(GOOD_FIT, noise=DISTURBED), {}),
        (assessed(GOOD_FIT, make_goodness_of_fit(residual=0.008)), {}),
    ],
)
def test_structure_colour_disturbance_or_residual_above_the_floor_is_unexplained(known, changes):
    assert verdict(known, **changes) == "unexplained"
    corrected = assessed(GOOD_FIT, corrected=known.follows, noise=known.noise)
    assert verdict(corrected, FIRST, **changes) == "unexplained"


def test_declared_floors_limit_the_residual():
    assert verdict(assessed(make_goodness_of_fit(residual=0.0074))) == "adequate"
    assert verdict(assessed(make_goodness_of_fit(residual=0.0076))) == "unexplained"
    assert verdict(assessed(make_goodness_of_fit(residual=0.0076)), above_floor=2.0) == "adequate"


@pytest.mark.parametrize(("source", "step"), [("samples", 1.0), ("quantisation", 12.0**0.5)])
def test_a_residual_of_ten_times_the_noise_of_the_samples_is_unexplained(source, step):
    def left(times):
        fit = make_goodness_of_fit(residual=times * step * 0.005, explained=0.9, floor_source=source)
        return verdict(assessed(fit, noise=noise())), verdict(
            assessed(GOOD_FIT, corrected=(fit,), noise=noise()), FIRST
        )

    assert left(9.9) == ("adequate", "explained")
    assert left(10.1) == ("unexplained", "unexplained")


def test_a_slow_error_of_the_sensor_and_static_simulations_have_no_noise_of_the_samples_alone():
    far = make_goodness_of_fit(residual=0.06, explained=0.9, floor_source="samples")
    slow = noise(Disturbance("angle", False, 1.0, 0.03))
    assert verdict(assessed(GOOD_FIT, corrected=(far,), noise=noise()), FIRST) == "unexplained"
    assert verdict(assessed(GOOD_FIT, corrected=(far,), noise=slow), FIRST) == "explained"
    assert verdict(assessed(GOOD_FIT, corrected=(far,)), FIRST) == "explained"
    # without findings a slow error can be missing physics
    assert "above_estimated_noise" in failed_rules(trail_of(assessed(far, noise=slow)))
    assert "above_estimated_noise" not in failed_rules(trail_of(assessed(GOOD_FIT, noise=slow)))


def test_with_findings_the_floor_limits_the_corrected_residual():
    before, after = make_goodness_of_fit(residual=0.05, explained=0.9), make_goodness_of_fit(residual=0.0051)
    assert verdict(assessed(before, corrected=(after,)), FIRST) == "explained"
    assert verdict(assessed(after, corrected=(before,)), FIRST) == "unexplained"


@pytest.mark.parametrize("findings", [(FIRST,), (SMALL,), (FIRST, SMALL)])
def test_named_findings_with_white_residual_explain(findings):
    assert verdict(assessed(GOOD_FIT, corrected=(GOOD_FIT,)), *findings) == "explained"


@pytest.mark.parametrize("grade", ["unconfirmed", "nearest"])
def test_a_finding_without_a_confirmed_name_is_unexplained(grade):
    for findings in ((grade,), (FIRST, grade)):
        assert verdict(assessed(GOOD_FIT, corrected=(GOOD_FIT,)), *findings) == "unexplained"


@pytest.mark.parametrize("findings", [(), (FIRST,)])
def test_a_poor_fit_is_unfit_whatever_the_residual(findings):
    for structure, white, left in itertools.product((False, True), (False, True), (None, noise(), DISTURBED)):
        assert verdict(assessed(POOR_FIT, noise=left), *findings, structure=structure, white=white) == "unfit"


def test_a_diverging_output_is_unfit_although_another_output_is_explained():
    tied, away = make_goodness_of_fit(residual=0.03, explained=0.99), make_goodness_of_fit(residual=0.7, explained=-3.6)
    assert assessed(POOR_FIT, POOR_FIT, corrected=(tied, away)).unfit(EvidenceSettings())
    assert not assessed(POOR_FIT, POOR_FIT, corrected=(tied, POOR_FIT)).unfit(EvidenceSettings())


def test_a_single_poor_output_is_not_unfit():
    assert not assessed(GOOD_FIT, POOR_FIT).unfit(EvidenceSettings())
    assert assessed(POOR_FIT, POOR_FIT).unfit(EvidenceSettings())
    assert verdict(assessed(GOOD_FIT, POOR_FIT)) == "unexplained"


@pytest.mark.parametrize(("explained", "unfit"), [(0.34, True), (0.36, False), (-5.0, True)])
def test_a_minimum_share_of_the_variation_is_required(explained, unfit):
    known = assessed(make_goodness_of_fit(explained=explained))
    assert known.unfit(EvidenceSettings()) is unfit
    assert known.unfit(EvidenceSettings(useful=0.999)) is True


@pytest.mark.parametrize(
    ("corrected", "changes"), [(GOOD_FIT, "explained"), (HALFWAY, "explained"), (POOR_FIT, "unfit")]
)
def test_a_finding_that_explains_enough_prevents_unfit(corrected, changes):
    assert verdict(assessed(POOR_FIT, corrected=(corrected,)), FIRST) == changes


def test_a_fit_that_explains_less_than_half_is_not_adequate():
    assert verdict(assessed(make_goodness_of_fit(explained=0.4))) == "unexplained"
    assert verdict(assessed(make_goodness_of_fit(explained=0.6))) == "adequate"


def test_slow_sensor_noise_is_unexplained_only_without_findings():
    slow = noise(Disturbance("angle", False, 1.0, 0.3))
    assert verdict(assessed(GOOD_FIT, corrected=(GOOD_FIT,), noise=slow), FIRST) == "explained"
    assert verdict(assessed(GOOD_FIT, noise=slow)) == "unexplained"


@pytest.mark.parametrize(
    ("grades", "corrected", "unfit"),
    [
        (("left_out", "nearest"), GOOD_FIT, False),
        (("nearest", "left_out"), GOOD_FIT, True),
        (("left_out",), make_goodness_of_fit(residual=0.2, explained=0.45), True),
        ((), GOOD_FIT, True),
    ],
)
def test_findings_make_a_simulation_usable_if_the_first_is_named_and_every_output_follows(grades, corrected, unfit):
    limits = EvidenceSettings()
    poor = assessed(POOR_FIT, POOR_FIT, corrected=(GOOD_FIT, corrected), noise=noise())
    assert poor.unfit_with(grades, limits) is unfit
    assert not replace(poor, noise=None).unfit_with(grades, limits)
    assert not assessed(GOOD_FIT, corrected=(corrected,), noise=noise()).unfit_with(grades, limits)
