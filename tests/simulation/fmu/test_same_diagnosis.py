"""The blind proof's nominal models as FMUs: the same equations, and the same diagnoses."""

import pytest
import torch

pytest.importorskip("fmpy")

from mkc_torch.simulation import Parameter, load_fmu
from mkc_torch.simulation.dynamics.user_functions import namespace
from mkc_torch.simulation.names import Names
from tests.benchmarks import fmu
from tests.simulation.fmu.made import COMPILER

pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no compiler of C (cc, gcc or clang)")


@pytest.mark.parametrize("system", fmu.RATES)
def test_the_fmus_have_the_nominal_equations(tmp_path, system):
    model, loaded = fmu.NOMINAL[system](), load_fmu(fmu.as_fmu(system, tmp_path))
    assert (model.states, model.inputs, list(model.parameters)) == (
        loaded.states,
        loaded.inputs,
        list(loaded.parameters),
    )
    generator = torch.Generator().manual_seed(0)
    states, inputs = (
        torch.rand(9, len(names), generator=generator, dtype=torch.float64) - 0.1
        for names in (model.states, model.inputs)
    )
    values = {k: p.value if isinstance(p, Parameter) else p for k, p in model.parameters.items()}
    p = Names(**{name: torch.tensor(1.3 * value, dtype=torch.float64) for name, value in values.items()})
    given = torch.zeros(9), namespace(model.states, states), namespace(model.inputs, inputs), p
    expected, found = model.derivative(*given), loaded.derivative(*given)
    for state in model.states:
        torch.testing.assert_close(found[state], expected[state], rtol=1e-12, atol=1e-14)


@pytest.mark.slow
def test_the_diagnosis_of_an_fmu_equals_that_of_its_equations(monkeypatch):
    """A throw, the fastest of the systems; `python -m tests.benchmarks.fmu` runs all systems."""
    monkeypatch.setattr(fmu, "FIRST", 18)
    (pair,) = fmu.pairs(1)
    assert pair.name.startswith("projectile")
    assert pair.same
    assert pair.off < 0.01
