"""Forward mode with constant inputs does not load torch's compiler, which takes a second."""

import subprocess
import sys
import textwrap

import pytest

pytestmark = pytest.mark.process

CODE = """
import sys

import torch

from mkc_torch._support.dual_constants import dual_constants
from mkc_torch.diagnosis.findings.curve import curve_of_effect
from mkc_torch.diagnosis.model.term import Term
from mkc_torch.effects import CATALOGUE, Context
from mkc_torch.nonlinear import load_forward_mode

load_forward_mode()
place = torch.rand(20, 3, dtype=torch.float64)
channels = ("strength",) if "{what}" == "pole" else ("x", "y", "z")
context = Context(torch.arange(20.0), place, ("m",) * 3, place, "µT", channels)
if "{what}" == "pole":
    (pole,) = [effect for effect in CATALOGUE if type(effect).__name__ == "MagneticPole"]

    def change(at):
        shape = dict(zip(("place_x", "place_y", "place_z"), at.unbind()), radius=0.1)
        return pole.change(torch.ones(3).double(), shape, context)

    at = torch.tensor([2.0, 0.0, 1.0]).double()
    slope = torch.func.vmap(lambda way: torch.func.jvp(dual_constants(change), (at,), (way,))[1])(torch.eye(3).double())
else:
    (cubic,) = [effect for effect in CATALOGUE if effect.id == "cubic_nonlinearity"]
    curve = curve_of_effect(Term(cubic, None, {{}}), torch.ones(3).double(), torch.eye(3).double(), context)
    slope = curve.band
assert bool((slope != 0).any())
print("torch._dynamo" in sys.modules)
"""


@pytest.mark.parametrize("what", ["pole", "curve"])
def test_no_compiler_is_loaded(what):
    code = textwrap.dedent(CODE).format(what=what)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "False"
