"""Propagate errors of an ellipsoid's parameters to centre, semi-axes and calibration matrix, to first order."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch._support.small_factors import solve, symmetric_eigenvalues
from mkc_torch.calibration.ellipsoid import Ellipsoid, symmetric_root
from mkc_torch.linear._implicit.layer import needs_derivatives

if TYPE_CHECKING:
    from jaxtyping import Float


def derived_slopes(
    local: Ellipsoid, parameters: Float[Tensor, "*batch 9"], ellipsoid_of: Callable[[Tensor], Ellipsoid]
) -> Float[Tensor, "B 24 9"]:
    """Jacobian of centre (3), semi-axes (3), calibration matrix (9) and that matrix over its radius (9).

    Args:
        local: the ellipsoid, in the coordinates of the parameters.
        parameters: parameters of each problem.
        ellipsoid_of: makes an ellipsoid of the parameters of a problem.
    """

    def quantities(theta: Tensor) -> Tensor:
        center, shape = ellipsoid_of(theta)
        axes = symmetric_eigenvalues(shape).flip(-1).rsqrt()
        return torch.cat([center, axes, shape.flatten(-2)], -1)

    jacobian = _jacobian(quantities, parameters.reshape(-1, 9))
    shape = local.shape.reshape(-1, 3, 3)
    root = symmetric_root(shape)
    eye = torch.eye(3, dtype=root.dtype, device=root.device)
    # the root W solves dW W + W dW = dA₁
    both = torch.einsum("bij,kl->bikjl", root, eye) + torch.einsum("kl,bij->bkilj", eye, root)
    d_root = solve(both.reshape(-1, 9, 9), jacobian[:, 6:])
    # the matrix is radius · root, and the radius is det(A₁)^(-1/6)
    inverse = torch.linalg.inv(shape).flatten(1)
    d_log_radius = -torch.einsum("bi,bij->bj", inverse, jacobian[:, 6:]) / 6.0
    radius = torch.linalg.det(shape).pow(-1 / 6)
    d_matrix = radius[:, None, None] * (d_root + root.flatten(1).unsqueeze(-1) * d_log_radius.unsqueeze(1))
    return torch.cat([jacobian[:, :6], d_matrix, d_root], 1)


def _jacobian(function: Callable[[Tensor], Tensor], theta: Float[Tensor, "B p"]) -> Float[Tensor, "B q p"]:
    """Jacobian for each problem of a function that takes all problems at once."""
    if needs_derivatives(theta):
        return torch.func.vmap(torch.func.jacrev(function))(theta)
    # bitwise the same result; torch.func, and autograd.grad with grad_outputs, import torch's compiler and sympy, which
    # takes longer than a calibration
    with torch.inference_mode(False), torch.enable_grad():
        width = function(theta[0]).shape[-1]
        leaf = theta.unsqueeze(1).repeat(1, width, 1).requires_grad_()
        values = function(leaf).diagonal(dim1=-2, dim2=-1).sum()
        (slopes,) = torch.autograd.grad(values, leaf, create_graph=True)
    return slopes.detach()
