"""Candidates far behind the first are not tried at other shapes."""

import dataclasses

import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.joint_refits import _leading
from mkc_torch.diagnosis.search.ranking import ModelPrior, within_reach
from mkc_torch.diagnosis.settings import SearchSettings, Settings
from mkc_torch.effects import CATALOGUE
from tests.diagnosis.line import Line


def test_candidates_far_behind_are_out_of_reach():
    settings = dataclasses.replace(SearchSettings(), behind=50.0)
    assert within_reach([400.0, 151.0, 149.0], settings) == [True, True, False]
    # a candidate without a gain sets no share for the others
    assert within_reach([-10.0, -59.0, -61.0], settings) == [True, True, False]


def test_a_fit_far_behind_does_not_lead():
    line, settings = Line(), Settings()
    step = next(effect for effect in CATALOGUE if effect.id == "hard_iron_step")
    term = Term(step, None, {"onset": 0.4}, "mixed")
    base = fitted(JointModel(line), line.start())
    first = fitted(base.model.with_term(term), torch.cat([base.parameters, torch.zeros(3)]), base.bound)
    far = dataclasses.replace(first, log_likelihood=first.log_likelihood - 1e4)
    prefer = ModelPrior((term,), line, settings.naming)
    assert _leading([first, far], base, prefer, settings.search) == [first]
    assert len(_leading([first, dataclasses.replace(first)], base, prefer, settings.search)) == 2
