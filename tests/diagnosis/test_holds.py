"""When a finding counts: the draws of noise have judged the first one, unseen blocks have to confirm what follows."""

import importlib
from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis.evidence import blocks_of

holds = importlib.import_module("mkc_torch.diagnosis.diagnose")._holds
N = 2000
BLOCKS = blocks_of(N, 1)


def evidence(mean, spread):
    noise = torch.randn(N, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return SimpleNamespace(log_likelihood=mean + spread * (noise - noise.mean()))


NOTHING = SimpleNamespace(log_likelihood=torch.zeros(N, dtype=torch.float64))


@pytest.mark.parametrize(
    ("first", "mean", "spread", "beyond", "counts"),
    [
        (True, 0.01, 1.0, 0.0, True),  # leans its way
        (True, -0.01, 1.0, 0.0, False),
        (True, -0.01, 1.0, 100.0, True),  # plain beyond all draws
        (False, 0.01, 1.0, 10.0, False),  # leans, and is not confirmed
        (False, 0.01, 1.0, 100.0, True),  # leans, and is plain
        (False, 0.5, 1.0, 0.0, True),
        (False, -0.5, 1.0, 100.0, False),
    ],
)
def test_a_finding_counts(first, mean, spread, beyond, counts):
    located = SimpleNamespace(beyond=beyond)
    assert holds(located, NOTHING, evidence(mean, spread), BLOCKS, 0, first=first) is counts
