"""The verdict, from assessments made by hand."""

import itertools
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.pipeline.build import FitAssessment, verdict_of
from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.diagnosis.factory import make_follows

FOLLOWING, LOST = make_follows(), make_follows(residual=0.33, explained=0.1)
HALFWAY = make_follows(residual=0.15, explained=0.8, floor=0.14)
FIRST, SMALL = SimpleNamespace(grade="left_out"), SimpleNamespace(grade="small")


def noise(*disturbances):
    return StateSpaceNoise(SelectedNoise(disturbances, (), (), torch.tensor([0.005]).double(), 0.0, (False,)), None)


DISTURBED = noise(Disturbance("rate", True, 1.0, 0.3))


def assessed(*follows, corrected=(), noise=None):
    return FitAssessment(follows, corrected, noise)


def verdict(known, *findings, structure=False, white=True, **settings):
    return verdict_of(known, findings, structure=structure, white=white, settings=EvidenceSettings(**settings))


@pytest.mark.parametrize("known", [assessed(FOLLOWING), assessed(FOLLOWING, noise=noise()), assessed()])
def test_a_good_fit_with_white_residual_is_adequate(known):
    assert verdict(known) == "adequate"


@pytest.mark.parametrize(
    ("known", "changes"),
    [
        (assessed(FOLLOWING), {"structure": True}),
        (assessed(FOLLOWING), {"white": False}),
        (assessed(FOLLOWING, noise=DISTURBED), {}),
        (assessed(FOLLOWING, make_follows(residual=0.008)), {}),
    ],
)
def test_structure_colour_disturbance_or_residual_above_the_floor_is_unexplained(known, changes):
    assert verdict(known, **changes) == "unexplained"
    corrected = assessed(FOLLOWING, corrected=known.follows, noise=known.noise)
    assert verdict(corrected, FIRST, **changes) == "unexplained"


def test_only_declared_floors_limit_the_residual():
    assert verdict(assessed(make_follows(residual=0.0074))) == "adequate"
    assert verdict(assessed(make_follows(residual=0.0076))) == "unexplained"
    assert verdict(assessed(make_follows(residual=0.0076)), above_floor=2.0) == "adequate"
    for source in ("samples", "quantisation"):
        assert verdict(assessed(make_follows(residual=0.0076, floor_source=source))) == "adequate"


def test_with_findings_the_floor_limits_the_corrected_residual():
    before, after = make_follows(residual=0.05, explained=0.9), make_follows(residual=0.0051)
    assert verdict(assessed(before, corrected=(after,)), FIRST) == "explained"
    assert verdict(assessed(after, corrected=(before,)), FIRST) == "unexplained"


@pytest.mark.parametrize("findings", [(FIRST,), (SMALL,), (FIRST, SMALL)])
def test_named_findings_with_white_residual_explain(findings):
    assert verdict(assessed(FOLLOWING, corrected=(FOLLOWING,)), *findings) == "explained"


@pytest.mark.parametrize("grade", ["unconfirmed", "nearest"])
def test_a_finding_without_a_confirmed_name_is_unexplained(grade):
    doubted = SimpleNamespace(grade=grade)
    for findings in ((doubted,), (FIRST, doubted)):
        assert verdict(assessed(FOLLOWING, corrected=(FOLLOWING,)), *findings) == "unexplained"


@pytest.mark.parametrize("findings", [(), (FIRST,)])
def test_a_poor_fit_is_unfit_whatever_the_residual(findings):
    for structure, white, left in itertools.product((False, True), (False, True), (None, noise(), DISTURBED)):
        assert verdict(assessed(LOST, noise=left), *findings, structure=structure, white=white) == "unfit"


def test_an_output_that_runs_away_is_unfit_although_another_is_explained():
    tied, away = make_follows(residual=0.03, explained=0.99), make_follows(residual=0.7, explained=-3.6)
    assert assessed(LOST, LOST, corrected=(tied, away)).unfit(EvidenceSettings())
    assert not assessed(LOST, LOST, corrected=(tied, LOST)).unfit(EvidenceSettings())


def test_a_single_poor_output_is_not_unfit():
    assert not assessed(FOLLOWING, LOST).unfit(EvidenceSettings())
    assert assessed(LOST, LOST).unfit(EvidenceSettings())
    assert verdict(assessed(FOLLOWING, LOST)) == "unexplained"


@pytest.mark.parametrize(("explained", "unfit"), [(0.34, True), (0.36, False), (-5.0, True)])
def test_a_minimum_share_of_the_variation_is_required(explained, unfit):
    known = assessed(make_follows(explained=explained))
    assert known.unfit(EvidenceSettings()) is unfit
    assert known.unfit(EvidenceSettings(useful=0.999)) is True


@pytest.mark.parametrize(("corrected", "changes"), [(FOLLOWING, "explained"), (HALFWAY, "explained"), (LOST, "unfit")])
def test_a_finding_that_explains_enough_prevents_unfit(corrected, changes):
    assert verdict(assessed(LOST, corrected=(corrected,)), FIRST) == changes


def test_a_fit_that_explains_less_than_half_is_not_adequate():
    assert verdict(assessed(make_follows(explained=0.4))) == "unexplained"
    assert verdict(assessed(make_follows(explained=0.6))) == "adequate"


def test_slow_sensor_noise_is_unexplained_only_without_findings():
    slow = noise(Disturbance("angle", False, 1.0, 0.3))
    assert verdict(assessed(FOLLOWING, corrected=(FOLLOWING,), noise=slow), FIRST) == "explained"
    assert verdict(assessed(FOLLOWING, noise=slow)) == "unexplained"
