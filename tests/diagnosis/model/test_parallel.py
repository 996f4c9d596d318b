"""Serialization of fits between processes."""

import torch

from mkc_torch._parallel.pool import Serializer
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.term import Driver, Term, common_parts
from mkc_torch.effects import GainEffect
from mkc_torch.recording import Recording
from mkc_torch.simulation import Dynamics
from tests.diagnosis.line import Line


class Along(GainEffect):
    """Effects of the same id that differ in the name of their shape number."""

    id = "along"
    port = "mixed"
    roles = ("any",)

    def __init__(self, number):
        self.number = number

    def waveform(self, shape, context):
        return shape[self.number] * context.drivers[:, 0]


class Decay(Dynamics):
    states = ("level",)
    parameters = {"rate": 1.0}

    def derivative(self, time, x, u, p):
        return {"level": -p.rate * x.level}


def through_serializer(fits, known):
    parcels = Serializer(known)
    return parcels.unpacked(parcels.packed(fits))


def test_a_deserialized_fit_has_the_same_effect_and_driver():
    line = Line()
    driver = Driver(("load",), "any", torch.sin(3.0 * line.time).unsqueeze(-1), torch.tensor([7.0]).double(), ("kg",))
    terms = [Term(Along("first"), driver, {"first": 1.0}), Term(Along("other"), driver, {"other": 2.0})]
    fits = []
    for term in terms:
        model = JointModel(line, [term])
        fits.append(fitted(model, torch.cat([line.start(), torch.zeros(3)])))
    for fit, back in zip(fits, through_serializer(fits, common_parts(line, terms)), strict=True):
        assert back.model.prepared is line
        assert back.model.terms[0].effect is fit.model.terms[0].effect
        assert back.model.terms[0].driver is driver
        assert back.model.terms[0].shape == fit.model.terms[0].shape
        assert torch.equal(back.parameters, fit.parameters)
        assert torch.equal(back.model.residual(back.parameters), fit.residual)


def test_a_deserialized_fit_has_its_trajectory():
    time = torch.linspace(0.0, 3.0, 61, dtype=torch.float64)
    noise = 0.01 * torch.randn(61, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prepared = Decay().prepare(Recording({"time": time, "level": torch.exp(-1.5 * time) + noise}))
    fit = fitted(JointModel(prepared), prepared.start())
    (back,) = through_serializer([fit], common_parts(prepared, ()))
    assert torch.equal(back.model.near.states, fit.model.near.states)
    assert torch.equal(back.model.residual(back.parameters), fit.residual)
