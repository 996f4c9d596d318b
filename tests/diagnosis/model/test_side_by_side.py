"""Fits side by side: none sees what another one left in the simulation's memory, and all come back whole."""

import io
from functools import partial

import torch

from mkc_torch._parallel.fork import _Receiver, _Sender
from mkc_torch.diagnosis.model.drivers import Driver
from mkc_torch.diagnosis.model.fit import fitted
from mkc_torch.diagnosis.model.joint import JointModel
from mkc_torch.diagnosis.model.side_by_side import each, fitted_each, known_of, memory_kept
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import GainEffect
from mkc_torch.recording.recording import Recording
from mkc_torch.simulation import Dynamics
from mkc_torch.simulation.protocol import Remembering
from tests.diagnosis.line import Line


class Along(GainEffect):
    """One of several effects of the same name, which differ in the number that their shape has."""

    id = "along"
    port = "mixed"
    roles = ("any",)

    def __init__(self, number):
        self.number = number

    def course(self, shape, context):
        return shape[self.number] * context.drivers[:, 0]


class Recalling(Line):
    """A line that remembers what it was asked."""

    def __init__(self):
        super().__init__()
        self.memory = []

    @property
    def newest(self):
        return self.memory[-1] if self.memory else None

    def learn(self, newest):
        self.memory = [*self.memory, newest]

    def residual(self, theta, changes):
        self.memory = [*self.memory, round(float(theta.detach()[0]), 9)]
        return super().residual(theta, changes)


def asked(prepared, value):
    prepared.residual(torch.tensor([value, 0.0]), {})
    return list(prepared.memory)


def test_each_begins_with_the_memory_of_the_fit_and_leaves_its_newest():
    prepared = Recalling()
    fit = fitted(JointModel(prepared), prepared.start())
    assert isinstance(prepared, Remembering)
    prepared.memory = []
    own = round(float(fit.parameters[0]), 9)
    seen = each(fit, [partial(asked, prepared, 7.0), partial(asked, prepared, 8.0), partial(asked, prepared, 9.0)])
    assert seen == [[own, 7.0], [own, 8.0], [own, 9.0]]
    assert prepared.memory == [own, 7.0, 8.0, 9.0]


def test_what_a_simulation_remembers_is_put_back_after_an_error():
    prepared = Recalling()
    try:
        with memory_kept(prepared):
            asked(prepared, 1.0)
            raise ArithmeticError
    except ArithmeticError:
        assert prepared.memory == []


def test_a_fit_is_the_newest_that_is_remembered_though_others_came_after_it():
    prepared = Recalling()
    fit = fitted(JointModel(prepared), prepared.start())

    def wanders_off():
        asked(prepared, 99.0)
        return fit

    fitted_each(fit, [wanders_off], [])
    assert prepared.memory[-1] == round(float(fit.parameters[0]), 9)


def test_a_fit_comes_back_with_its_own_effect_and_driver():
    line = Line()
    driver = Driver(("load",), "any", torch.sin(3.0 * line.time).unsqueeze(-1), torch.tensor([7.0]).double(), ("kg",))
    terms = [Term(Along("one"), driver, {"one": 1.0}), Term(Along("other"), driver, {"other": 2.0})]
    fits = []
    for term in terms:
        model = JointModel(line, [term])
        fits.append(fitted(model, torch.cat([line.start(), torch.zeros(3)])))
    known = {id(one): one for one in known_of(line, terms)}
    _Sender(sent := io.BytesIO(), known).dump(fits)
    for fit, back in zip(fits, _Receiver(io.BytesIO(sent.getvalue()), known).load(), strict=True):
        assert back.model.prepared is line
        assert back.model.terms[0].effect is fit.model.terms[0].effect
        assert back.model.terms[0].driver is driver
        assert back.model.terms[0].shape == fit.model.terms[0].shape
        assert torch.equal(back.parameters, fit.parameters)
        assert torch.equal(back.model.residual(back.parameters), fit.residual)


class Decay(Dynamics):
    states = ("level",)
    parameters = {"rate": 1.0}  # noqa: RUF012

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return {"level": -p.rate * x.level}


def test_trajectories_are_put_back_and_learned():
    time = torch.linspace(0.0, 3.0, 61, dtype=torch.float64)
    prepared = Decay().prepare(Recording({"time": time, "level": torch.exp(-1.5 * time)}))
    assert isinstance(prepared, Remembering)
    near, far = (torch.tensor([rate, 1.0], dtype=torch.float64) for rate in (1.5, 3.0))
    prepared.residual(near, {})
    known = prepared.newest
    with memory_kept(prepared):
        prepared.residual(far, {})
        found = prepared.newest
        assert found[0] != known[0]
    assert prepared.newest is not None
    assert prepared.newest[0] == known[0]
    prepared.learn(found)
    assert prepared.newest[0] == found[0]
    torch.testing.assert_close(found[1][:, 0], torch.exp(-3.0 * time), rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(prepared.simulated(far, {})[:, 0], torch.exp(-3.0 * time), rtol=1e-5, atol=1e-7)
