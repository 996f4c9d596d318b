"""Lines of Python that effects write are what the effects do."""

from types import SimpleNamespace

import pytest
import torch

from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.diagnosis.model import Term
from mkc_torch.diagnosis.python_source import SourceError
from mkc_torch.effects import DYNAMICS
from mkc_torch.effects.dynamics.thermal_loss import ThermalLoss
from mkc_torch.effects.paired.between import shifted
from mkc_torch.effects.protocol import CodedEffect, Context, lagged
from mkc_torch.simulation import Dynamics

N = 200
NAMES = ("speed", "angle", "other", "load")
EXPRESSIONS = {
    "own": "x.speed", "position": "x.angle", "angle": "x.angle", "deflection": "x.angle", "other": "x.other",
    "load": "x.load", "zero": "0.0",
}  # fmt: skip
PARTS = {
    "own": "speed", "position": "angle", "angle": "angle", "deflection": "angle", "other": "other", "load": "load",
    "temperature": "speed", "reversing": "speed", "level": "speed",
}  # fmt: skip


@pytest.mark.parametrize("effect", DYNAMICS, ids=lambda e: e.id)
def test_the_line_is_the_change(effect):
    assert isinstance(effect, CodedEffect)
    time = torch.arange(N, dtype=torch.float64) / 10.0
    signal = torch.stack([torch.sin((k + 1) * time + k) for k in range(4)], -1)
    outputs = effect.port == "output"
    channels = ("speed",) if outputs or effect.port != "exchange" else ("speed", "other")
    carried = signal[:, :1] if outputs else signal
    seen = Context(time, time.new_zeros(N, 0), (), carried, "", channels, () if outputs else NAMES, PARTS)
    shape = effect.shapes(time)[-1]
    size = sum(q.size for q in effect.quantities(shape, seen))
    gamma = torch.linspace(0.3, 0.7, size, dtype=torch.float64)
    names = {"speed": "x.speed"} if outputs else EXPRESSIONS
    x = SimpleNamespace(**dict(zip(NAMES, signal.unbind(-1), strict=True)))
    known = {"x": x, "torch": torch, "time": time, "lagged": lagged, "shifted": shifted}
    written = [eval(line, known) + torch.zeros_like(time) for line in effect.code(gamma.tolist(), shape, names)]
    torch.testing.assert_close(torch.stack(written, -1), effect.change(gamma, shape, seen), rtol=1e-9, atol=1e-9)


class Vessel(Dynamics):
    states = ("level",)
    parameters = {"drain": 0.5}  # noqa: RUF012

    def derivative(self, time, x, u, p):  # noqa: ARG002
        return (-p.drain * x.level,)


def model(effect, source):
    theta, gamma = torch.tensor([0.25, 1.0]).double(), torch.tensor([0.125]).double()
    return DiagnosedModel("Vessel", {}, theta, [Term(effect, None, {}, "rate of level")], [gamma], source)


def test_what_a_person_reads():
    text = model(ThermalLoss(), Vessel()).to_python("vessels")
    assert text.count("\n") < 30
    for line in (
        "from vessels import Vessel",
        '"drain": 0.25,',
        "# thermal_loss: δṪ",
        "class CorrectedVessel(Vessel):",
    ):
        assert line in text
    compile(text, "corrected.py", "exec")


def test_what_cannot_be_written_out():
    with pytest.raises(SourceError, match="give its simulation with `simulation=`"):
        model(ThermalLoss(), None).to_python()

    class Silent(ThermalLoss):
        id = "silent"
        code = None

    with pytest.raises(SourceError, match="silent cannot be written out as Python: it has no `code` method"):
        model(Silent(), Vessel()).to_python()
