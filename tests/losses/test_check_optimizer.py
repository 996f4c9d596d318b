"""The check of the optimizer: SGD needs a limit on the gradient, which grows as the residuals shrink."""

import pytest
import torch

from mkc_torch import MKCLoss


def of_clipping(loss, make):
    model = torch.nn.Linear(3, 1)
    optimizer = make([{"params": model.parameters()}, *loss.param_groups()])
    return [text for text in loss.check(optimizer=optimizer) if "clip_grad_norm_" in text]


def test_sgd_is_reported_with_the_robust_objective_alone():
    assert len(of_clipping(MKCLoss(1), lambda groups: torch.optim.SGD(groups, lr=0.1))) == 1
    assert not of_clipping(MKCLoss(1, d=1.0, bound=20.0), lambda groups: torch.optim.SGD(groups, lr=0.1))
    assert not of_clipping(MKCLoss(1), torch.optim.AdamW)


def test_the_gradient_of_the_network_grows_as_the_scale_shrinks():
    g = torch.Generator().manual_seed(0)
    norms = []
    for scale in (1.0, 0.01):
        prediction = torch.zeros(64, 1, requires_grad=True)
        MKCLoss(1)(prediction, scale * torch.randn(64, 1, generator=g)).backward()
        norms.append(float(prediction.grad.norm()))
    assert norms[1] == pytest.approx(100.0 * norms[0], rel=0.2)
