"""A delay by a volume over a flow."""

import numpy as np
import pytest
import torch

from mkc_torch import Recording
from mkc_torch.diagnosis.model.shapes import candidate_terms
from mkc_torch.diagnosis.model.term import find_drivers
from mkc_torch.diagnosis.settings import DriverSettings
from mkc_torch.effects import DYNAMICS, Context, travelled
from mkc_torch.effects.dynamics.input_transport_delay import InputTransportDelay
from mkc_torch.simulation import Dynamics

TIME = torch.arange(200, dtype=torch.float64) * 0.1
FLOW = 1.5 + torch.sin(0.5 * TIME)


def context(flow, own):
    mean = float(flow.mean())
    parts = {"own": "dose"}
    return Context(
        TIME, (flow - mean).unsqueeze(-1), ("l/s",), own.unsqueeze(-1), "g", ("dose",), (), parts, driver_means=(mean,)
    )


def test_what_leaves_the_pipe_entered_a_volume_earlier():
    own = torch.sin(0.8 * TIME)
    delay, mean = 1.3, float(FLOW.mean())
    change = InputTransportDelay().waveform({"delay": delay}, context(FLOW, own))
    flow, time = FLOW.numpy(), TIME.numpy()
    filled = np.concatenate([[0.0], np.cumsum(0.5 * (flow[1:] + flow[:-1]) * np.diff(time))])
    entered = np.interp(filled - delay * mean, filled, time)
    late = np.interp(entered, time, own.numpy())
    torch.testing.assert_close(change, torch.as_tensor(late) - own, rtol=0.0, atol=1e-9)


def test_a_constant_flow_is_a_constant_delay():
    own = torch.sin(0.8 * TIME)
    plain = InputTransportDelay.reduces_to.waveform({"delay": 0.7}, context(FLOW, own))
    steady = InputTransportDelay().waveform({"delay": 0.7}, context(torch.full_like(TIME, 3.0), own))
    torch.testing.assert_close(steady, plain, rtol=0.0, atol=1e-9)


def test_a_pipe_stands_still_between_runs():
    time = torch.tensor([0.0, 1.0, 5.0, 6.0])
    assert travelled(torch.ones(4), time, torch.tensor([0, 0, 1, 1])).tolist() == [0.0, 1.0, 1.0, 2.0]
    assert travelled(torch.ones(4), time - 5.0 * (time > 4.0)).tolist() == [0.0, 1.0, 1.0, 2.0]


class Vessel(Dynamics):
    states, inputs, parameters = ("conc",), ("dose", "pump"), {"rate": 0.3}

    def derivative(self, time, x, u, p):
        return {"conc": p.rate * u.pump * (u.dose - x.conc)}


@pytest.mark.parametrize(("sign", "drivers"), [(1.0, {"pump", "drain"}), (-1.0, {"pump"})])
def test_flows_are_columns_and_inputs_that_are_nowhere_negative(sign, drivers):
    columns = {"time": TIME, "dose": TIME.cos(), "pump": FLOW, "conc": TIME.sin(), "drain": 1.0 + sign * FLOW}
    table = Recording(columns)
    prepared = Vessel().prepare(table)
    known = find_drivers(table, frozenset(Vessel().columns), DriverSettings()).drivers
    terms = candidate_terms(prepared, known, [e for e in DYNAMICS if e.id == "input_transport_delay"])
    # `dose` is sometimes negative, and a column that nearly repeats an input is not tried
    expected = {("input dose", "pump")}
    assert {(term.port, *term.columns) for term in terms} >= expected
    assert {term.columns[0] for term in terms} <= drivers
