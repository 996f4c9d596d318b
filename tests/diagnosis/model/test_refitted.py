"""The joint refit of a named candidate, from the size of the search or from size 0."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.diagnosis.search.joint_refits import refitted
from mkc_torch.effects import CATALOGUE
from mkc_torch.simulation import Magnetometer
from tests.simulation.tumbling import tumbling

N = 1500
EFFECT = next(effect for effect in CATALOGUE if effect.id == "cubic_nonlinearity")


@pytest.fixture(scope="module")
def base():
    prepared = Magnetometer("norm").prepare(tumbling(N, noise=0.3))
    return fitted(JointModel(prepared), prepared.start())


def search_result(base, *gamma):
    """Return a stub of a search that estimates these sizes."""
    estimate = torch.tensor(gamma, dtype=torch.float64)
    return SimpleNamespace(scene=SimpleNamespace(base=base), estimate=lambda _: estimate)


@pytest.mark.parametrize("wrong_size", [0.0, -0.3, 30.0, -1e4])
def test_a_fit_that_diverges_restarts_from_size_zero(base, wrong_size):
    term = Term(EFFECT, None, {"terms": 2.0})
    found = refitted(base, term, search_result(base, *[wrong_size] * 6), 0)
    assert found.log_likelihood >= base.log_likelihood - 1e-6
    assert found.converged
