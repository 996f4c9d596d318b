"""Constants with a tangent of 0 in forward mode."""

import subprocess
import sys

import pytest
import torch

from mkc_torch._support.dual_constants import dual_constants

CONSTANT = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
POINT = torch.tensor([0.7, 1.1, 0.4], dtype=torch.float64)
SCALAR = torch.tensor(2, dtype=torch.int64)
FUNCTIONS = {
    "number times tensor": lambda x: -9.81 * x,
    "tensor over number": lambda x: x / 3,
    "number over tensor": lambda x: 1.5 / x,
    "constant minus tensor": lambda x: CONSTANT - x,
    "tensor times a boolean mask": lambda x: x * (CONSTANT > 0),
    "broadcast": lambda x: CONSTANT[:, None] * x + x.sum() * SCALAR,
    "power of a tensor": lambda x: x**CONSTANT,
    "power of a number": lambda x: 2.0**x - x**3,
    "functions of two": lambda x: torch.atan2(CONSTANT, x) + torch.maximum(x, CONSTANT) * torch.hypot(x, CONSTANT),
    "rounding mode": lambda x: torch.div(x, CONSTANT, rounding_mode="floor") + x,
    "neither depends on the point": lambda x: 2.0 * CONSTANT + 0.0 * x,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_and_derivatives_are_those_of_the_function(name):
    function = FUNCTIONS[name]
    torch.testing.assert_close(dual_constants(function)(POINT), function(POINT), rtol=0, atol=0)
    jacobian = torch.func.jacfwd(dual_constants(function))(POINT)
    torch.testing.assert_close(jacobian, torch.func.jacrev(function)(POINT), rtol=1e-14, atol=0)


def test_a_precision_is_kept():
    value, slope = torch.func.jvp(dual_constants(lambda x: 0.1 * x), (POINT.float(),), (torch.ones(3),))
    assert value.dtype == slope.dtype == torch.float32
    assert torch.equal(value, 0.1 * POINT.float())


def test_second_derivatives_are_exact():
    inner = dual_constants(lambda x: (3.0 * x**2 * CONSTANT / (1.0 + x)).sum())
    hessian = torch.func.jacfwd(dual_constants(torch.func.jacfwd(inner)))(POINT)
    torch.testing.assert_close(hessian, torch.func.hessian(inner)(POINT))


def test_no_operation_with_a_constant_imports_the_compiler():
    code = (
        "import sys, torch\n"
        "from mkc_torch._support.dual_constants import dual_constants\n"
        "x, c = torch.ones(3), torch.arange(3.0)\n"
        "torch.func.jacfwd(dual_constants(lambda x: 1.0 - 2.0 * x / c + c * x.abs() - 1.0 / x))(x)\n"
        "print('torch._dynamo' in sys.modules)\n"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
