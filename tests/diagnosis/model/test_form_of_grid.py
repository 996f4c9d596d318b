"""The form of an effect, such as the width of a smoothed sign, by joint fits along its grid."""

import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.shapes import candidate_terms, with_form_of_grid
from mkc_torch.effects import DYNAMICS
from mkc_torch.simulation import Dynamics

STEP = 0.02


class Disc(Dynamics):
    states = ("speed",)
    inputs = ("torque",)
    units = {"speed": "rad/s"}
    parameters = {"gain": 1.0, "damping": 0.5}

    def derivative(self, time, x, u, p):
        return {"speed": p.gain * u.torque - p.damping * x.speed}


def test_the_width_of_dry_friction_moves_to_where_it_is_most_likely():
    time = STEP * torch.arange(400, dtype=torch.float64)
    torque = 3.0 * torch.sin(2.0 * time) + torch.sin(5.1 * time)
    speed, speeds = 0.0, []
    for now in torque.tolist():
        speeds.append(speed)
        for _ in range(20):
            speed += STEP / 20 * (now - 0.5 * speed - torch.tensor(speed / 0.08).tanh().item())
    noise = 0.002 * torch.randn(400, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prepared = Disc().prepare(
        Recording({"time": time, "torque": torque, "speed": torch.tensor(speeds).double() + noise})
    )
    friction = next(effect for effect in DYNAMICS if effect.id == "coulomb_friction")
    widest, *_, narrowest = sorted(candidate_terms(prepared, (), (friction,)), key=lambda term: -term.shape["width"])
    found = []
    for term in (widest, narrowest):
        start = fitted(JointModel(prepared, (term,)), torch.cat([prepared.start(), prepared.start().new_ones(1)]))
        moved = with_form_of_grid(start)
        assert moved.log_likelihood > start.log_likelihood + 30.0
        assert abs(float(moved.parameters[-1]) - 1.0) < 0.03
        found.append(moved.model.terms[-1].shape["width"])
    assert found[0] == found[1]
    assert 0.04 < found[0] < 0.16
