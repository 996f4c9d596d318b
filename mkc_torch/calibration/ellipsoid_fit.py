"""Ellipsoid fit to points in space, for the calibration of magnetometers and accelerometers.

A triaxial sensor in a constant field that turns through all directions draws an ellipsoid. Its centre is the offset
(hard iron), its shape the gains and cross-couplings (soft iron). The fit is linear regression on the nine monomials of
(36) of Li et al., "Multi-kernel Correntropy Regression" (2023), appendix A, by any estimator of ``mkc_torch.linear``; a
finish by maximum likelihood in the unit of the points can follow.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, refuse_bad_weight, refuse_not_real, refuse_other_type
from mkc_torch._support.arrays import Data, as_tensor
from mkc_torch._support.order_statistic import order_statistic, robust_scale
from mkc_torch.calibration.coverage import Coverage, coverage
from mkc_torch.calibration.ellipsoid import (
    Ellipsoid,
    axes_of,
    coefficients_from_ellipsoid,
    distance_along,
    ellipsoid_from_coefficients,
    ellipsoid_from_root,
    monomials,
    sampson_distance,
    symmetric_root,
)
from mkc_torch.calibration.not_identifiable import (
    NotIdentifiableError,
    middle_of,
    not_identifiable,
    told_of_equal,
    told_of_flat,
)
from mkc_torch.linear import MKCRegression, RankDeficientError
from mkc_torch.linear._estimator import Fitted, LinearEstimator
from mkc_torch.linear._problem import common_batch
from mkc_torch.nonlinear import NonlinearFit
from mkc_torch.nonlinear import fit as nonlinear_fit

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["MAX_SCATTER", "MAX_STANDARD_ERROR", "MIN_INFORMATION", "MIN_POINTS", "EllipsoidFit"]

MIN_POINTS = 9
MIN_INFORMATION = 0.003
"""Least information, as a share of even coverage, that identifies an ellipsoid."""

MAX_STANDARD_ERROR = 0.05
"""Largest standard error of the centre or a semi-axis, as a share of the radius, that identifies an ellipsoid."""

MAX_SCATTER = 0.2
"""Largest scatter of the points about the surface, as a share of its shortest semi-axis: the square of it is the bias
of the fit. A ball of noise scatters by half."""

LENT_BY_NOISE = 5.0
"""Information that points on two circles, which determine no ellipsoid, seem to have by their scatter alone, over its
square as a share of the shortest semi-axis: 1 to 7 by how their planes lie; from 5 on, they come out."""

_EXACT = 1e4
"""Roundings by which a point may be off a surface that it is on."""


class EllipsoidFit(Fitted):
    """Ellipsoid through points by robust linear regression: the linear head for magnetometers.

    Args:
        estimator: any estimator of ``mkc_torch.linear``; default ``MKCRegression()``. Give it ``covariance="hac"``
            when the points are a time series in the order of time.
        finish: None keeps the algebraic fit; "maximum_likelihood" goes on from it to the maximum of the MKC likelihood
            of the points' distances to the surface, :func:`sampson_distance`, with σ and d learned again, in the unit
            of the points. It is what the algebraic fit is an approximation of where the noise of the points is the
            same in all directions: the algebraic residual weighs a point by its distance to the centre and is biased
            by the square of the noise over the radius.
        max_scatter: share of the shortest semi-axis by which the points may scatter about the surface, in (0, ∞]; inf
            takes any, as a place to start from where something else moves the points.

    Attributes, after ``fit`` (``*`` batch dimensions, lengths in the unit of the points):
        center_: (*, 3), the offset.
        semi_axes_: (*, 3), ascending.
        rotation_: (*, 3, 3), columns along the semi-axes, determinant +1.
        calibration_matrix_: (*, 3, 3), symmetric, with ``|calibration_matrix_ @ (p - center_)| = radius_`` on the
            ellipsoid: applied to points less their centre it makes the ellipsoid a sphere of the same volume.
        radius_: (*,), geometric mean of the semi-axes.
        coef_: (*, 9), coefficients of (36) in the points' own coordinates.
        residual_: (*, N), calibrated norm less ``radius_``.
        weights_: (*, N), the weight in [0, 1] with which each point entered.
        center_se_, semi_axes_se_, calibration_matrix_se_: standard errors of the same shapes, where the estimator
            has a ``covariance_``; infinite where nine points leave none to tell errors from. After a finish they are
            those of the finish, of the estimator's kind ("sandwich" where it has none).
        coverage_: one :class:`mkc_torch.calibration.coverage.Coverage`, or a list of them, of the points in use.
        root_se_: standard errors of ``calibration_matrix_ / radius_``, which makes the ellipsoid a unit sphere.
        estimator_: the fitted estimator; its residual is algebraic, about twice the relative error of the norm.
        finish_: the :class:`mkc_torch.nonlinear.NonlinearFit` of the finish, or None: residual, d and bound are in the
            unit of the points, ``theta`` is about the median of the points in units of their median distance from it.

    Raises:
        TypeError: ``estimator`` is none of ``mkc_torch.linear``, or ``max_scatter`` is no number.
        ValueError: ``finish`` is something else, or ``max_scatter`` is out of range.

    References:
        Li et al., "Multi-kernel Correntropy Regression" (2023), appendix A, (36)-(41).

    Example:
        >>> from mkc_torch.calibration.coverage import fibonacci_sphere
        >>> points = fibonacci_sphere(100) * torch.tensor([40.0, 50.0, 60.0]) + torch.tensor([1.0, 2.0, 3.0])
        >>> points[:20] += 25.0
        >>> fit = EllipsoidFit().fit(points.double())
        >>> [round(v, 3) for v in (*fit.center_.tolist(), *fit.semi_axes_.tolist())]
        [1.0, 2.0, 3.0, 40.0, 50.0, 60.0]
    """

    _fit_takes = "points"

    def __init__(
        self,
        estimator: LinearEstimator | None = None,
        *,
        finish: Literal["maximum_likelihood"] | None = None,
        max_scatter: float = MAX_SCATTER,
    ) -> None:
        if finish not in (None, "maximum_likelihood"):
            raise ValueError(f"Expected argument `finish` to be None or 'maximum_likelihood' but got {finish!r}.")
        if estimator is not None:
            what = "an estimator of mkc_torch.linear"
            refuse_other_type("estimator", estimator, LinearEstimator, what, "None takes MKCRegression()")
        self.estimator = MKCRegression() if estimator is None else estimator
        self.finish = finish
        self.max_scatter = checked_number("max_scatter", max_scatter, ends="(]", advice=f"{MAX_SCATTER:g} is usual")

    def fit(
        self, points: Float[Tensor, "*batch N 3"] | Data, sample_weight: Float[Tensor, "*batch N"] | Data | None = None
    ) -> EllipsoidFit:
        """Fit an ellipsoid to points.

        Args:
            points: (*, N, 3) with N >= 9, in any unit of length or field; a tensor, a NumPy array or a DataFrame, of
                which :meth:`calibrate` then takes one with the same columns alone.
            sample_weight: non-negative weights (*, N); 0 leaves a point out.

        Raises:
            TypeError: not a floating tensor, or an array of something else than real numbers.
            ValueError: wrong shape, too few or non-finite points.
            NotIdentifiableError: the points lie on a plane, cover too few directions (the message names those that are
                missing), or draw no surface: they scatter about it by more than ``max_scatter``.
        """
        self._forget()
        weight = None if sample_weight is None else as_tensor("sample_weight", sample_weight)
        used, weight = _prepared(as_tensor("points", points), weight)
        self._keep_columns_of(points)
        try:
            self._fit(used, weight)
        except NotIdentifiableError:
            self._forget()
            raise
        return self

    def _forget(self) -> None:
        """Drop the results of an earlier fit."""
        for name in [n for n in self.__dict__ if n.endswith("_")]:
            del self.__dict__[name]

    def _fit(self, points: Tensor, weight: Tensor | None) -> None:
        used = None if weight is None else (weight > 0).to(points.dtype).unsqueeze(-1)
        half = 0.5 * points.shape[-2]
        origin = order_statistic(points, used, half).unsqueeze(-2)
        radius = torch.linalg.vector_norm(points - origin, dim=-1, keepdim=True)
        size = order_statistic(radius, used, half).unsqueeze(-2)
        if bool((size <= 0).any()):
            raise not_identifiable(told_of_equal(points), points - origin)
        X = monomials((points - origin) / size).unsqueeze(-2)
        Y = torch.ones_like(X[..., 0])
        self.estimator_ = copy.copy(self.estimator)
        try:
            self.estimator_.fit(X, Y, None if weight is None else weight.unsqueeze(-1))
        except RankDeficientError:
            raise not_identifiable(told_of_flat(points), points - middle_of(points)) from None
        local = ellipsoid_from_coefficients(self.estimator_.coef_)
        self._refuse_unbounded(local, points)
        scale = size.squeeze(-1)
        self.weights_ = self.estimator_.weights_.squeeze(-1)
        self.finish_: NonlinearFit | None = None
        parameters = self.estimator_.coef_
        covariance = getattr(self.estimator_, "covariance_", None)
        ellipsoid_of: Callable[[Tensor], Ellipsoid] = ellipsoid_from_coefficients
        if self.finish is not None:
            self.finish_ = self._finished(local, (points - origin) / size, scale, weight)
            parameters, covariance = self.finish_.theta, self.finish_.covariance
            ellipsoid_of = ellipsoid_from_root
            self.weights_ = self.finish_.weights.squeeze(-1)
            local = ellipsoid_from_root(parameters)
            self._refuse_unbounded(local, points)
        self._keep(points, Ellipsoid(origin.squeeze(-2) + scale * local.center, local.shape / size.square()))
        if covariance is not None:
            self._standard_errors(local, scale, parameters, covariance, ellipsoid_of)
        self._refuse_uncovered(self.calibrate(points), weight)
        scatter = self._scatter(self.calibrate(points), weight)
        self._refuse_scattered(self.calibrate(points), scatter)
        if self.max_scatter < math.inf:
            self._refuse_lent(self.calibrate(points), scatter)

    def _finished(self, local: Ellipsoid, points: Tensor, scale: Tensor, weight: Tensor | None) -> NonlinearFit:
        """The maximum of the likelihood of the distances that is nearest to an ellipsoid, all in local coordinates."""
        root = symmetric_root(local.shape)
        row, column = torch.triu_indices(3, 3)

        def distance(theta: Tensor, data: tuple[Tensor, Tensor]) -> Tensor:
            near, unit = data
            return (unit * sampson_distance(theta, near)).unsqueeze(-1)

        return nonlinear_fit(
            distance,
            torch.cat([local.center, root[..., row, column]], -1),
            data=(points, scale),
            weight=None if weight is None else weight.unsqueeze(-1),
            graduate=False,
            covariance=getattr(self.estimator, "covariance", "sandwich"),
            bandwidth=getattr(self.estimator, "bandwidth", None),
        )

    def calibrate(self, points: Float[Tensor, "*batch M 3"] | Data) -> Float[Tensor, "*batch M 3"]:
        """``calibration_matrix_ @ (p - center_)`` of each point: the field in the unit of the points.

        Raises:
            NotFittedError: before ``fit``.
            TypeError: not a floating tensor, or an array of something else than real numbers.
            ValueError: another shape, or other batch dimensions or columns than those of the fit.
        """
        matrix = self.calibration_matrix_
        self._refuse_other_columns("points", points)
        points = as_tensor("points", points, like=matrix)
        _refuse_no_points(points)
        common_batch("points", points.shape[:-2], "calibration_matrix_", matrix.shape[:-2])
        return torch.einsum("...ij,...kj->...ki", self.calibration_matrix_, points - self.center_.unsqueeze(-2))

    def _refuse_unbounded(self, local: Ellipsoid, points: Tensor) -> None:
        values = torch.linalg.eigvalsh(local.shape.nan_to_num(0.0, 0.0, 0.0))
        # a surface a hundred times longer than wide is a cylinder to these points
        bounded = (values[..., 0] > 1e-4 * values[..., -1]).reshape(-1)
        if not bool(bounded.all()):
            index = int((~bounded).nonzero()[0, 0])
            vectors = (points - middle_of(points)).reshape(-1, *points.shape[-2:])[index]
            where = f"Problem {index}: " if points.dim() > 2 else ""
            seen = " They are seen from the middle of the samples, for the centre is not known; the gaps may be wider."
            raise not_identifiable(
                f"{where}Not identifiable: the quadric that fits the points is no ellipsoid.", vectors, seen=seen
            )

    def _keep(self, points: Tensor, ellipsoid: Ellipsoid) -> None:
        self.center_ = ellipsoid.center
        self.semi_axes_, self.rotation_ = axes_of(ellipsoid.shape)
        self.radius_ = self.semi_axes_.log().mean(-1).exp()
        self.calibration_matrix_ = self.radius_[..., None, None] * symmetric_root(ellipsoid.shape)
        self.coef_ = coefficients_from_ellipsoid(ellipsoid)
        self.residual_ = torch.linalg.vector_norm(self.calibrate(points), dim=-1) - self.radius_.unsqueeze(-1)

    def _standard_errors(
        self,
        local: Ellipsoid,
        scale: Tensor,
        parameters: Tensor,
        covariance: Tensor,
        ellipsoid_of: Callable[[Tensor], Ellipsoid],
    ) -> None:
        """First-order propagation from the parameters; the calibration matrix W solves dW W + W dW = dA₁."""

        def quantities(theta: Tensor) -> Tensor:
            center, shape = ellipsoid_of(theta)
            axes = torch.linalg.eigvalsh(shape).flip(-1).rsqrt()
            return torch.cat([center, axes, shape.flatten()])

        jacobian = torch.func.vmap(torch.func.jacrev(quantities))(parameters.reshape(-1, 9))
        root = symmetric_root(local.shape).reshape(-1, 3, 3)
        eye = torch.eye(3, dtype=root.dtype, device=root.device)
        lyapunov = torch.stack([torch.kron(w, eye) + torch.kron(eye, w) for w in root])
        d_root = torch.linalg.solve(lyapunov, jacobian[:, 6:])
        # the matrix is radius · root, and the radius is det(A₁)^(-1/6)
        inverse = torch.linalg.inv(local.shape.reshape(-1, 3, 3)).flatten(1)
        d_log_radius = -torch.einsum("bi,bij->bj", inverse, jacobian[:, 6:]) / 6.0
        radius = torch.linalg.det(local.shape.reshape(-1, 3, 3)).pow(-1 / 6)
        d_matrix = radius[:, None, None] * (d_root + root.flatten(1).unsqueeze(-1) * d_log_radius.unsqueeze(1))
        rows = torch.cat([jacobian[:, :6], d_matrix, d_root], 1)
        variance = torch.einsum("bij,bjk,bik->bi", rows, covariance.reshape(-1, 9, 9), rows)
        errors = variance.nan_to_num(torch.inf).clamp(min=0.0).sqrt().reshape(*scale.shape[:-1], 24)
        self.center_se_ = errors[..., :3] * scale
        self.semi_axes_se_ = errors[..., 3:6] * scale
        self.calibration_matrix_se_ = errors[..., 6:15].unflatten(-1, (3, 3))
        self.root_se_ = errors[..., 15:].unflatten(-1, (3, 3)) / scale.unsqueeze(-1)

    def _refuse_uncovered(self, field: Tensor, weight: Tensor | None) -> None:
        # which of the points on the surface itself a trimmed fit keeps is a matter of rounding
        on_it = self.residual_.abs() <= _EXACT * torch.finfo(field.dtype).eps * self.radius_.unsqueeze(-1)
        in_use = (self.weights_ >= 0.5) | on_it
        if weight is not None:
            in_use = in_use & (weight > 0)
        flat = field.detach().reshape(-1, *field.shape[-2:])
        directions = [f[use] for f, use in zip(flat, in_use.reshape(flat.shape[0], -1), strict=True)]
        found = [coverage(d) for d in directions]
        self.coverage_: Coverage | list[Coverage] = found[0] if field.dim() == 2 else found
        largest = self._largest_standard_error()
        for index, one in enumerate(found):
            where = f"Problem {index}: " if field.dim() > 2 else ""
            if one.information < MIN_INFORMATION:
                raise not_identifiable(
                    f"{where}Not identifiable: too few directions are covered to tell the offset from the shape "
                    f"({one.information:.1e} of the information of an even coverage; {MIN_INFORMATION:g} is needed).",
                    directions[index],
                )
            if largest is not None and MAX_STANDARD_ERROR < float(largest[index]) < math.inf:
                raise not_identifiable(
                    f"{where}Not identifiable: the centre or a semi-axis has a standard error of "
                    f"{100.0 * float(largest[index]):.0f} % of the radius, more than "
                    f"{100.0 * MAX_STANDARD_ERROR:.0f} %.",
                    directions[index],
                )

    @torch.no_grad()
    def _scatter(self, field: Tensor, weight: Tensor | None) -> Tensor:
        """Of the points about the surface, as a share of its shortest semi-axis, for each problem."""
        radius = self.radius_[..., None, None]
        distance = distance_along(field / radius, self.calibration_matrix_ / radius).unsqueeze(-1)
        used = None if weight is None else (weight > 0).to(field).unsqueeze(-1)
        return (robust_scale(distance, used) / self.semi_axes_[..., :1]).reshape(-1)

    def _refuse_lent(self, field: Tensor, scatter: Tensor) -> None:
        """Refuse directions that seem to be covered because the points scatter: the ellipsoid is that of the noise."""
        found = self.coverage_ if isinstance(self.coverage_, list) else [self.coverage_]
        for index, one in enumerate(found):
            lent = LENT_BY_NOISE * float(scatter[index]) ** 2
            if one.information < MIN_INFORMATION + lent:
                where = f"Problem {index}: " if field.dim() > 2 else ""
                raise not_identifiable(
                    f"{where}Not identifiable: too few directions are covered for points that scatter about the "
                    f"ellipsoid by {100.0 * float(scatter[index]):.0f} % of its shortest semi-axis "
                    f"({one.information:.1e} of the information of an even coverage; {MIN_INFORMATION + lent:.1e} is "
                    "needed, for the scatter alone seems to cover as much).",
                    field.detach().reshape(-1, *field.shape[-2:])[index],
                )

    def _refuse_scattered(self, field: Tensor, scatter: Tensor) -> None:
        """Refuse a surface that the points do not draw: that of a ball of noise is as wide as the noise."""
        wide = (scatter > self.max_scatter).nonzero().flatten()
        if len(wide) > 0:
            where = f"Problem {int(wide[0])}: " if field.dim() > 2 else ""
            raise NotIdentifiableError(
                f"{where}Not identifiable: the points draw no surface. They scatter about the ellipsoid by "
                f"{100.0 * float(scatter[wide[0]]):.0f} % of its shortest semi-axis, more than "
                f"{100.0 * self.max_scatter:.0f} %, as the noise of a sensor that hardly turns does. Turn the sensor "
                "through all directions."
            )

    def _largest_standard_error(self) -> Tensor | None:
        """Of centre and semi-axes as a share of the radius, for each problem; infinite where it is unknown."""
        if "center_se_" not in self.__dict__:
            return None
        errors = torch.cat([self.center_se_, self.semi_axes_se_], -1).amax(-1) / self.radius_
        return errors.detach().reshape(-1)


def _refuse_no_points(points: Tensor) -> None:
    refuse_not_real("points", points)
    if points.dim() < 2 or points.shape[-1] != 3:
        mend = "; a point is a row, so try points.mT" if points.dim() > 1 and points.shape[-2] == 3 else ""
        if points.shape == (3,):
            mend = "; one point is points[None]"
        raise ValueError(f"Expected argument `points` of shape (*, N, 3) but got {tuple(points.shape)}{mend}.")


def _prepared(points: Tensor, sample_weight: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Checked points and weights; what a point of weight 0 holds is replaced, so that it can be anything."""
    _refuse_no_points(points)
    if points.dtype in (torch.float16, torch.bfloat16):
        raise TypeError(f"Expected argument `points` of dtype float32 or float64 but got {points.dtype}; use .float().")
    weight = None
    if sample_weight is not None:
        refuse_bad_weight(sample_weight, "sample_weight")
        if sample_weight.shape != points.shape[:-1] and sample_weight.shape != points.shape[-2:-1]:
            raise ValueError(
                f"Expected argument `sample_weight` of shape {tuple(points.shape[:-1])} "
                f"but got {tuple(sample_weight.shape)}; it has one weight for each point."
            )
        weight = sample_weight.to(points).expand(points.shape[:-1])
    count = points.shape[-2] if weight is None else int((weight > 0).sum(-1).min())
    if count < MIN_POINTS:
        raise ValueError(
            f"Expected at least {MIN_POINTS} points, one for each coefficient of an ellipsoid, but got {count}; record "
            "more, in all directions."
        )
    finite = torch.isfinite(points)
    if weight is not None:
        finite = finite | (weight == 0).unsqueeze(-1)
    if not bool(finite.all()):
        first = tuple((~finite).nonzero()[0].tolist())
        raise ValueError(
            f"Expected argument `points` to be finite but got {points[first].item()} at index {first} "
            f"({int((~finite).sum())} such values); drop those points."
        )
    if weight is None:
        return points, None
    first_used = (weight > 0).to(torch.int64).argmax(-1)[..., None, None].expand(*points.shape[:-2], 1, 3)
    return torch.where((weight > 0).unsqueeze(-1), points, points.gather(-2, first_used)), weight
