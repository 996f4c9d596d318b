"""The verdict by four questions, on answers made by hand."""

import itertools
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.settings import EvidenceSettings
from mkc_torch.diagnosis.verdict import FitAssessment, verdict_of
from mkc_torch.simulation.dynamics.noise import StateSpaceNoise
from mkc_torch.simulation.dynamics.noise_selection import SelectedNoise
from mkc_torch.simulation.dynamics.observer import Disturbance
from tests.diagnosis.factory import make_follows

FOLLOWING, LOST = make_follows(), make_follows(residual=0.33, explained=0.1)
HALFWAY = make_follows(residual=0.15, explained=0.8, floor=0.14)
FIRST, SMALL = SimpleNamespace(grade="left_out"), SimpleNamespace(grade="small")


def noise(*pushes):
    return StateSpaceNoise(SelectedNoise(pushes, (), (), torch.tensor([0.005]).double(), 0.0, (False,)), None)


PUSHED = noise(Disturbance("rate", True, 1.0, 0.3))


def around(*follows, corrected=(), noise=None):
    return FitAssessment(follows, corrected, noise)


def verdict(known, *findings, structure=False, white=True, **settings):
    return verdict_of(known, findings, structure=structure, white=white, settings=EvidenceSettings(**settings))


@pytest.mark.parametrize("known", [around(FOLLOWING), around(FOLLOWING, noise=noise()), around()])
def test_what_follows_and_leaves_white_noise_is_adequate(known):
    assert verdict(known) == "adequate"


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (around(FOLLOWING), {"structure": True}),
        (around(FOLLOWING), {"white": False}),
        (around(FOLLOWING, noise=PUSHED), {}),
        (around(FOLLOWING, make_follows(residual=0.008)), {}),
    ],
)
def test_structure_colour_a_push_or_a_residual_above_its_declared_floor_is_unexplained(known, said):
    assert verdict(known, **said) == "unexplained"
    corrected = around(FOLLOWING, corrected=known.follows, noise=known.noise)
    assert verdict(corrected, FIRST, **said) == "unexplained"


def test_a_floor_is_kept_to_up_to_half_as_much_again_and_only_where_it_was_declared():
    assert verdict(around(make_follows(residual=0.0074))) == "adequate"
    assert verdict(around(make_follows(residual=0.0076))) == "unexplained"
    assert verdict(around(make_follows(residual=0.0076)), above_floor=2.0) == "adequate"
    for source in ("samples", "quantisation"):
        assert verdict(around(make_follows(residual=0.0076, floor_source=source))) == "adequate"


def test_with_findings_it_is_the_corrected_residual_that_the_floor_is_asked_of():
    before, after = make_follows(residual=0.05, explained=0.9), make_follows(residual=0.0051)
    assert verdict(around(before, corrected=(after,)), FIRST) == "explained"
    assert verdict(around(after, corrected=(before,)), FIRST) == "unexplained"


@pytest.mark.parametrize("findings", [(FIRST,), (SMALL,), (FIRST, SMALL)])
def test_findings_with_names_that_leave_white_noise_explain(findings):
    assert verdict(around(FOLLOWING, corrected=(FOLLOWING,)), *findings) == "explained"


@pytest.mark.parametrize("grade", ["unconfirmed", "nearest"])
def test_one_finding_without_a_name_of_its_own_leaves_it_unexplained(grade):
    doubted = SimpleNamespace(grade=grade)
    for findings in ((doubted,), (FIRST, doubted)):
        assert verdict(around(FOLLOWING, corrected=(FOLLOWING,)), *findings) == "unexplained"


@pytest.mark.parametrize("findings", [(), (FIRST,)])
def test_what_does_not_follow_is_unfit_whatever_is_left(findings):
    for structure, white, left in itertools.product((False, True), (False, True), (None, noise(), PUSHED)):
        assert verdict(around(LOST, noise=left), *findings, structure=structure, white=white) == "unfit"


def test_an_output_that_is_not_followed_is_no_misfit_where_the_others_are():
    assert not around(FOLLOWING, LOST).unfit(EvidenceSettings())
    assert around(LOST, LOST).unfit(EvidenceSettings())
    assert verdict(around(FOLLOWING, LOST)) == "unexplained"


@pytest.mark.parametrize(("explained", "unfit"), [(0.34, True), (0.36, False), (-5.0, True)])
def test_a_share_of_the_variation_is_needed_unless_set_otherwise(explained, unfit):
    known = around(make_follows(explained=explained))
    assert known.unfit(EvidenceSettings()) is unfit
    assert known.unfit(EvidenceSettings(useful=0.999)) is True


@pytest.mark.parametrize(("corrected", "said"), [(FOLLOWING, "explained"), (HALFWAY, "explained"), (LOST, "unfit")])
def test_a_finding_that_explains_enough_of_the_variation_rescues(corrected, said):
    assert verdict(around(LOST, corrected=(corrected,)), FIRST) == said


def test_nothing_is_adequate_that_leaves_most_of_the_variation():
    assert verdict(around(make_follows(explained=0.4))) == "unexplained"
    assert verdict(around(make_follows(explained=0.6))) == "adequate"


def test_a_slow_error_of_a_sensor_is_noise_beside_a_finding_and_a_question_alone():
    slow = noise(Disturbance("angle", False, 1.0, 0.3))
    assert verdict(around(FOLLOWING, corrected=(FOLLOWING,), noise=slow), FIRST) == "explained"
    assert verdict(around(FOLLOWING, noise=slow)) == "unexplained"
