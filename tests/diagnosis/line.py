"""A simulation that is not a magnetometer: two channels linear in time, a pointwise port and a summing port."""

import torch

from mkc_torch.nonlinear import GaussianPrior
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Port
from mkc_torch.simulation.protocol import ClosedForm


class Line(ClosedForm):
    """``y = θ₀ + θ₁ t`` in both channels; ``mixing`` multiplies a change at "mixed", a change at "summed" is summed."""

    name = "line"
    channels = ("left", "right")
    unit = "V"
    independent = (True, True)
    parameter_names = ("level", "slope")
    warnings = ()
    bounds = None
    state = {}
    ports = {
        "mixed": Port(("a", "b", "c"), "mV", allows_drift=True),
        "summed": Port(("flow",), "l/s", pointwise=False),
    }

    def __init__(self, N=100, *, prior=None, noise=0.1, seed=0):
        generator = torch.Generator().manual_seed(seed)
        self.time = torch.linspace(0.0, 2.0, N, dtype=torch.float64)
        self.mixing = torch.randn(N, 2, 3, generator=generator, dtype=torch.float64)
        error = noise * torch.randn(N, 2, generator=generator, dtype=torch.float64)
        self.measured = (1.0 + 0.5 * self.time).unsqueeze(-1) + error
        self.recording = Recording({"time": self.time, "left": self.measured[:, 0]}, name="line")
        self.prior = prior

    def start(self, rows=None):
        return torch.tensor([0.8, 0.4], dtype=torch.float64)

    def residual(self, theta, changes):
        left = self.measured - (theta[0] + theta[1] * self.time).unsqueeze(-1)
        if "mixed" in changes:
            left = left - torch.einsum("nmc,nc->nm", self.mixing, changes["mixed"](self.signals(theta)["mixed"]))
        if "summed" in changes:
            left = left - changes["summed"](self.time.new_zeros(len(self.time), 1)).cumsum(0) / len(self.time)
        return left

    def signals(self, theta, changes=None, near=None):
        level = theta[0] + theta[1] * self.time
        return {"mixed": torch.stack([level, 2.0 * level, level.square()], -1)}


def diagonal_prior():
    return GaussianPrior(torch.tensor([1.0, 0.5]).double(), torch.tensor([4.0, 0.0]).double())


def full_prior():
    return GaussianPrior(torch.tensor([1.0, 0.5]).double(), torch.tensor([[4.0, 1.0], [1.0, 2.0]]).double())
