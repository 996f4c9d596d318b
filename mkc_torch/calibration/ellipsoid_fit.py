"""Ellipsoid fit to points in space, for the calibration of magnetometers and accelerometers.

The readings of a triaxial sensor that turns through all directions in a constant field lie on an ellipsoid. Its centre
is the offset (hard iron), its shape the gains and cross-couplings (soft iron). The fit is linear regression on the nine
monomials of (36) of Li et al., "Multi-kernel Correntropy Regression" (2023), appendix A, by any estimator of
``mkc_torch.linear``. A refinement by maximum likelihood in the unit of the points can follow.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mkc_torch._support.arguments import checked_number, refuse_other_type
from mkc_torch._support.arrays import Data, as_tensor
from mkc_torch._support.order_statistic import order_statistic, robust_scale
from mkc_torch._support.side_by_side import side_by_side
from mkc_torch._support.small_factors import symmetric_eigenvalues
from mkc_torch.calibration.coverage import Coverage, CoverageOfEach, least_information, least_of_each, tangents
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
from mkc_torch.calibration.ellipsoid_errors import derived_slopes
from mkc_torch.calibration.noise_effect import Bias, algebraic_rows, bias_by_noise, distance_rows, moments_of
from mkc_torch.calibration.not_identifiable import (
    LESS_NOISE,
    NotIdentifiableError,
    equal_points_message,
    flat_points_message,
    middle_of,
    not_identifiable,
)
from mkc_torch.calibration.points import MIN_POINTS, prepared, refuse_no_points
from mkc_torch.linear import MKCRegression, RankDeficientError
from mkc_torch.linear._estimator import Fitted, LinearEstimator
from mkc_torch.linear._problem import common_batch
from mkc_torch.nonlinear import NonlinearFit
from mkc_torch.nonlinear import fit as nonlinear_fit

if TYPE_CHECKING:
    from jaxtyping import Float

__all__ = ["MAX_SCATTER", "MAX_STANDARD_ERROR", "MIN_INFORMATION", "MIN_POINTS", "EllipsoidFit"]

MIN_INFORMATION = 0.003
"""Smallest information, as a share of even coverage, that identifies an ellipsoid."""

MAX_STANDARD_ERROR = 0.05
"""Largest standard error of the centre or a semi-axis, as a share of the radius, that identifies an ellipsoid; it
includes the bias by noise."""

MAX_SCATTER = 0.2
"""Largest scatter of the points about the surface, as a share of its shortest semi-axis; the bias of the fit is its
square. A ball of noise scatters by half."""

LENT_UNSURE = 0.1
"""Relative uncertainty of the spurious information by noise, because the noise may differ between directions."""

LENT_UNSURE_OF_ONE = 4.0
"""Statistical uncertainty of the spurious information by noise, relative, times the root of the number of points. Its
standard deviation is 1.7 to 1.8 for two circles of 1000 points each at noise of 8 and 14 %."""

_UNEVEN = 10.0
"""Ratio of the relative bias to the squared relative scatter above which missing directions are the reason of the bias;
for even coverage it is 4 to 5."""

_EXACT = 1e4
"""Largest distance of a point on the surface from it, in units of machine precision times the radius."""


class EllipsoidFit(Fitted):
    """Ellipsoid through points by robust linear regression: the linear head for magnetometers.

    Args:
        estimator: any estimator of ``mkc_torch.linear``; default ``MKCRegression()``. Use ``covariance="hac"`` if the
            points are a time series in the order of time.
        finish: None keeps the algebraic fit. "maximum_likelihood" refines it to the maximum of the MKC likelihood of
            the points' distances to the surface, :func:`sampson_distance`, with σ and d learned again, in the unit of
            the points. The algebraic fit approximates it for isotropic noise: its residual weighs a point by its
            distance to the centre and is biased by the square of the noise over the radius.
        max_scatter: largest scatter of the points about the surface, as a share of the shortest semi-axis, in (0, ∞];
            inf accepts any scatter, for a starting point if other effects than noise move the points.

    Attributes, after ``fit`` (``*`` batch dimensions, lengths in the unit of the points):
        center_: (*, 3), the offset.
        semi_axes_: (*, 3), ascending.
        rotation_: (*, 3, 3), columns along the semi-axes, determinant +1.
        calibration_matrix_: (*, 3, 3), symmetric, with ``|calibration_matrix_ @ (p - center_)| = radius_`` on the
            ellipsoid: applied to centred points it maps the ellipsoid to a sphere of the same volume.
        radius_: (*,), geometric mean of the semi-axes.
        coef_: (*, 9), coefficients of (36) in the points' own coordinates.
        residual_: (*, N), calibrated norm minus ``radius_``.
        weights_: (*, N), weight in [0, 1] of each point.
        center_se_, semi_axes_se_, calibration_matrix_se_: standard errors of the same shapes, if the estimator has a
            ``covariance_``; infinite for nine points, which leave no degrees of freedom. After a finish they are those
            of the finish, of the estimator's kind ("sandwich" if it has no kind). They include the bias by the noise
            of the points, as the root of the sum of squares, so that intervals cover it; except for
            ``max_scatter=inf``, where the scatter is not noise.
        coverage_: :class:`mkc_torch.calibration.coverage.Coverage` of the points in use; a sequence for a batch.
        root_se_: standard errors of ``calibration_matrix_ / radius_``, which maps the ellipsoid to a unit sphere.
        estimator_: the fitted estimator; its residual is algebraic, about twice the relative error of the norm.
        finish_: the :class:`mkc_torch.nonlinear.NonlinearFit` of the finish, or None: residual, d and bound are in the
            unit of the points, ``theta`` is about the median of the points in units of their median distance from it.

    Raises:
        TypeError: ``estimator`` is not an estimator of ``mkc_torch.linear``, or ``max_scatter`` is not a number.
        ValueError: ``finish`` is unknown, or ``max_scatter`` is out of range.

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
            points: (*, N, 3) with N >= 9, in any unit of length or field; a tensor, a NumPy array or a DataFrame.
                After a DataFrame, :meth:`calibrate` accepts only DataFrames with the same columns.
            sample_weight: non-negative weights (*, N); 0 leaves a point out.

        Raises:
            TypeError: not a floating tensor, or an array that does not hold real numbers.
            ValueError: wrong shape, too few or non-finite points.
            NotIdentifiableError: the points lie on a plane, cover too few directions (the message lists the missing
                directions), cover them only by their noise, scatter about the surface by more than ``max_scatter``, or
                their noise biases the result by more than the largest accepted standard error.
        """
        self._forget()
        weight = None if sample_weight is None else as_tensor("sample_weight", sample_weight)
        used, weight = prepared(as_tensor("points", points), weight)
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
            raise not_identifiable(equal_points_message(points), points - origin)
        X = monomials((points - origin) / size).unsqueeze(-2)
        Y = torch.ones_like(X[..., 0])
        self.estimator_ = copy.copy(self.estimator)
        try:
            self.estimator_.fit(X, Y, None if weight is None else weight.unsqueeze(-1))
        except RankDeficientError:
            raise not_identifiable(flat_points_message(points), points - middle_of(points)) from None
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
        in_use = self._in_use(weight)
        scatter = self._scatter(self.calibrate(points), weight)
        noise = self._noise(scatter, in_use)
        bias = self._bias((points - origin) / size, scale, noise, parameters, weight)
        errors = self._errors(local, scale, parameters, covariance, ellipsoid_of, bias)
        self._refuse_undetermined(points, in_use, scatter, noise, errors)

    def _finished(self, local: Ellipsoid, points: Tensor, scale: Tensor, weight: Tensor | None) -> NonlinearFit:
        """Maximise the likelihood of the distances, starting from an ellipsoid, in local coordinates."""
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
        refuse_no_points(points)
        common_batch("points", points.shape[:-2], "calibration_matrix_", matrix.shape[:-2])
        return torch.einsum("...ij,...kj->...ki", self.calibration_matrix_, points - self.center_.unsqueeze(-2))

    def _refuse_unbounded(self, local: Ellipsoid, points: Tensor) -> None:
        values = symmetric_eigenvalues(local.shape.nan_to_num(0.0, 0.0, 0.0))
        # a surface a hundred times longer than wide is indistinguishable from a cylinder
        bounded = (values[..., 0] > 1e-4 * values[..., -1]).reshape(-1)
        if not bool(bounded.all()):
            index = int((~bounded).nonzero()[0, 0])
            vectors = (points - middle_of(points)).reshape(-1, *points.shape[-2:])[index]
            seen = " These are relative to the middle of the samples, as the centre is unknown; the gaps may be wider."
            raise not_identifiable(
                f"{_problem(index, points.dim() > 2)}Not identifiable: the quadric that fits the points is not an "
                "ellipsoid.",
                vectors,
                seen=seen,
            )

    def _keep(self, points: Tensor, ellipsoid: Ellipsoid) -> None:
        self.center_ = ellipsoid.center
        self.semi_axes_, self.rotation_ = axes_of(ellipsoid.shape)
        self.radius_ = self.semi_axes_.log().mean(-1).exp()
        self.calibration_matrix_ = self.radius_[..., None, None] * symmetric_root(ellipsoid.shape)
        self.coef_ = coefficients_from_ellipsoid(ellipsoid)
        self.residual_ = torch.linalg.vector_norm(self.calibrate(points), dim=-1) - self.radius_.unsqueeze(-1)

    def _errors(
        self,
        local: Ellipsoid,
        scale: Tensor,
        parameters: Tensor,
        covariance: Tensor | None,
        ellipsoid_of: Callable[[Tensor], Ellipsoid],
        bias: Bias | None,
    ) -> tuple[list[float], list[float]]:
        """Set the standard errors; return the largest of centre and semi-axes over the radius, without and with bias.

        The bias enters as a standard error, so that intervals cover it.
        """
        slopes = derived_slopes(local, parameters, ellipsoid_of)
        bias_shift = alone = total = torch.zeros_like(slopes[..., 0])

        def spread(rows: Tensor, covariance: Tensor) -> Tensor:
            variance = torch.einsum("bij,bjk,bik->bi", rows, covariance.reshape(-1, 9, 9), rows)
            return torch.where(variance.isnan(), torch.inf, variance).clamp(min=0.0)

        if bias is not None:
            bias_shift = torch.einsum("bij,bj->bi", slopes, bias.offset)
        if covariance is not None:
            alone = total = spread(slopes, covariance)
            if bias is not None:
                total = spread(slopes @ bias.growth, covariance)
        total = total + bias_shift.square()
        if covariance is not None:
            kept = total.sqrt().reshape(*scale.shape[:-1], 24)
            self.center_se_ = kept[..., :3] * scale
            self.semi_axes_se_ = kept[..., 3:6] * scale
            self.calibration_matrix_se_ = kept[..., 6:15].unflatten(-1, (3, 3))
            self.root_se_ = kept[..., 15:].unflatten(-1, (3, 3)) / scale.unsqueeze(-1)
        share = (scale / self.radius_.unsqueeze(-1)).reshape(-1).detach()
        first, second = (share * variance[:, :6].amax(-1).sqrt() for variance in (alone, total))
        return first.tolist(), second.tolist()

    def _in_use(self, weight: Tensor | None) -> Tensor:
        """Mask of the points in use, (*, N)."""
        # rounding decides which of the points exactly on the surface a trimmed fit keeps: count them all
        eps = torch.finfo(self.residual_.dtype).eps
        in_use = (self.weights_ >= 0.5) | (self.residual_.abs() <= _EXACT * eps * self.radius_.unsqueeze(-1))
        return in_use if weight is None else in_use & (weight > 0)

    def _bias(
        self, points: Tensor, scale: Tensor, noise: Tensor | None, parameters: Tensor, weight: Tensor | None
    ) -> Bias | None:
        """The bias of the parameters by the noise of the points; points are in the parameters' coordinates."""
        if noise is None:
            return None
        near = points.reshape(-1, *points.shape[-2:])
        theta = parameters.reshape(-1, 9)
        share = self.weights_ if weight is None else self.weights_ * weight
        rows = algebraic_rows(theta) if self.finish is None else distance_rows(theta)
        return bias_by_noise(moments_of(rows, near, share.reshape(near.shape[:2]), noise / scale.reshape(-1)))

    def _refuse_undetermined(
        self,
        points: Tensor,
        in_use: Tensor,
        scatter: Tensor,
        noise: Tensor | None,
        errors: tuple[list[float], list[float]],
    ) -> None:
        field = self.calibrate(points).detach()
        flat = field.reshape(-1, *field.shape[-2:])
        each = CoverageOfEach(flat, in_use.reshape(flat.shape[:2]))
        suspects: Sequence[int] = range(len(flat))
        found: Sequence[Coverage] = each
        if field.dim() > 2 and side_by_side(field):
            # of many problems only those near the limits are examined one by one
            low = (each.information() < 2.0 * MIN_INFORMATION).tolist()
            suspects = [i for i, error in enumerate(errors[0]) if low[i] or error > MAX_STANDARD_ERROR]
        else:
            found = each[:]
        self.coverage_: Coverage | Sequence[Coverage] = found[0] if field.dim() == 2 else found
        for index in suspects:
            covered, where = found[index], _problem(index, field.dim() > 2)
            if covered.information < MIN_INFORMATION:
                raise not_identifiable(
                    f"{where}Not identifiable: too few directions are covered to separate the offset from the shape "
                    f"({covered.information:.1e} of the information of even coverage; {MIN_INFORMATION:g} is needed).",
                    each.directions(index),
                )
            if MAX_STANDARD_ERROR < errors[0][index] < math.inf:
                raise not_identifiable(
                    f"{where}Not identifiable: the centre or a semi-axis has a standard error of "
                    f"{100.0 * errors[0][index]:.0f} % of the radius, more than {100.0 * MAX_STANDARD_ERROR:.0f} %.",
                    each.directions(index),
                )
        self._refuse_scattered(field, scatter)
        if noise is not None:
            self._refuse_lent(points, in_use, scatter, noise, each)
            self._refuse_biased(scatter.tolist(), errors[1], each)

    @torch.no_grad()
    def _scatter(self, field: Tensor, weight: Tensor | None) -> Tensor:
        """Scatter of the points about the surface as a share of its shortest semi-axis, for each problem, (B,)."""
        radius = self.radius_[..., None, None]
        distance = distance_along(field / radius, self.calibration_matrix_ / radius).unsqueeze(-1)
        used = None if weight is None else (weight > 0).to(field).unsqueeze(-1)
        return (robust_scale(distance, used) / self.semi_axes_[..., :1]).reshape(-1)

    def _noise(self, scatter: Tensor, in_use: Tensor) -> Tensor | None:
        """Standard deviation of the points in their unit, for each problem, (B,); None for ``max_scatter=inf``."""
        if self.max_scatter == math.inf:
            return None
        count = in_use.reshape(len(scatter), -1).sum(-1).to(scatter)
        # nine coefficients absorb nine degrees of freedom
        free = (count / (count - MIN_POINTS).clamp(min=1.0)).sqrt()
        return scatter * self.semi_axes_[..., 0].detach().reshape(-1) * free

    @torch.no_grad()
    def _refuse_lent(
        self, points: Tensor, in_use: Tensor, scatter: Tensor, noise: Tensor, each: CoverageOfEach
    ) -> None:
        """Raise an error if the directions seem covered only because of the scatter of the points."""
        flat = points.reshape(-1, *points.shape[-2:])
        use = in_use.reshape(flat.shape[:2]).to(flat)
        center, root = self.center_.reshape(-1, 1, 3), (self.calibration_matrix_ / self.radius_[..., None, None])
        root = root.reshape(-1, 3, 3)
        moments = moments_of(lambda p: tangents((p - center) @ root), flat, use, noise)
        counts, suspects = use.sum(-1).tolist(), list(range(len(flat)))
        if points.dim() > 2 and side_by_side(flat):
            # twice the largest share of spurious information that is subtracted below
            most = 2.0 * (LENT_UNSURE + LENT_UNSURE_OF_ONE * min(counts) ** -0.5)
            least_each, worst = least_of_each(moments.found - moments.lent)
            lent_each = torch.einsum("bi,bij,bj->b", worst, moments.lent, worst).clamp(min=0.0)
            suspects = (least_each < 2.0 * MIN_INFORMATION + most * lent_each).nonzero()[:, 0].tolist()
        for index in suspects:
            least, along = least_information(moments.found[index] - moments.lent[index])
            lent = float(along @ moments.lent[index].double().cpu() @ along)
            needed = MIN_INFORMATION + (LENT_UNSURE + LENT_UNSURE_OF_ONE * counts[index] ** -0.5) * max(lent, 0.0)
            if least < needed:
                raise not_identifiable(
                    f"{_problem(index, points.dim() > 2)}Not identifiable: too few directions are covered for points "
                    f"that scatter about the ellipsoid by {100.0 * float(scatter[index]):.0f} % of its shortest "
                    f"semi-axis. Without the spurious coverage by the scatter, {least:.1e} of the information of an "
                    f"even coverage remains; {needed:.1e} is needed.",
                    each.directions(index),
                )

    def _refuse_biased(self, scatter: list[float], errors: list[float], each: CoverageOfEach) -> None:
        """Raise an error if the bias by noise exceeds the largest accepted standard error."""
        for index, (wide, error) in enumerate(zip(scatter, errors, strict=True)):
            if MAX_STANDARD_ERROR < error < math.inf:
                even = error <= _UNEVEN * wide**2
                what = "there is too much noise in" if even else "too few directions are covered for"
                raise not_identifiable(
                    f"{_problem(index, len(errors) > 1)}Not identifiable: {what} points that scatter about the "
                    f"ellipsoid by {100.0 * wide:.0f} % of its shortest semi-axis. Including the bias by that scatter, "
                    f"the centre or a semi-axis has an error of {100.0 * error:.0f} % of the radius, more than "
                    f"{100.0 * MAX_STANDARD_ERROR:.0f} %.",
                    each.directions(index),
                    covered=LESS_NOISE,
                )

    def _refuse_scattered(self, field: Tensor, scatter: Tensor) -> None:
        """Raise an error if the points scatter too much about the surface, as a ball of noise does."""
        wide = (scatter > self.max_scatter).nonzero().flatten()
        if len(wide) > 0:
            raise NotIdentifiableError(
                f"{_problem(int(wide[0]), field.dim() > 2)}Not identifiable: the points do not form a surface. They "
                f"scatter about the ellipsoid by {100.0 * float(scatter[wide[0]]):.0f} % of its shortest semi-axis, "
                f"more than {100.0 * self.max_scatter:.0f} %, like the noise of a sensor that hardly turns. Turn the "
                "sensor through all directions."
            )


def _problem(index: int, several: bool) -> str:
    return f"Problem {index}: " if several else ""
