"""Every public entry with valid arguments, and ways to contaminate each argument."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import mkc_torch.covariance
import mkc_torch.density
import mkc_torch.effects
import mkc_torch.linear
import mkc_torch.losses
import mkc_torch.nonlinear
import mkc_torch.simulation
from mkc_torch import functional
from mkc_torch.calibration import Calibration, EllipsoidFit, calibrate
from mkc_torch.diagnosis import diagnose
from mkc_torch.metrics import MKCNegativeLogLikelihood
from mkc_torch.recording import Recording

INF, NAN = math.inf, math.nan


@dataclass(frozen=True)
class Entry:
    """A public name, a call of it, and valid arguments.

    Attributes:
        names: public names that the call covers, with their module.
        call: takes the arguments and returns results.
        arguments: valid arguments by name; those of ``fixed`` are not contaminated.
        passes: arguments whose NaN is passed on to the result, by the docstring or by the user's own function.
    """

    names: tuple[str, ...]
    call: Callable[..., Any]
    arguments: dict[str, Any]
    fixed: tuple[str, ...] = field(default=())
    passes: tuple[str, ...] = field(default=())


def data(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


X, Y = data(60, 3), data(60, 2, seed=1)
LINEAR: dict[str, dict[str, Any]] = {
    "LeastSquares": {},
    "Ridge": {"alpha": 0.5},
    "LeastAbsoluteDeviations": {},
    "LeastMedianOfSquares": {"starts": 40},
    "LeastTrimmedSquares": {"starts": 40},
    "SRegression": {"starts": 20, "breakdown": 0.4},
    "MMRegression": {"starts": 20, "efficiency": 0.9},
    "MEstimator": {"tuning": 1.345},
    "ReweightedLeastSquares": {"starts": 40, "threshold": 2.5},
    "FixedPointLinear": {"sigma": 2.0, "d": 1.0},
    "MKCRegression": {"sigma": 2.0, "d": 1.0, "bound": 20.0},
    "MinimumEntropy": {"bandwidth": 1.0},
    "LeastEntropyLike": {},
    "GeneralizedMaximumEntropy": {"coef_support": torch.tensor([-10.0, 0.0, 10.0], dtype=torch.float64)},
}


def fitted(name: str) -> Callable[..., Any]:
    def call(X: Any, Y: Any, sample_weight: Any, **options: Any) -> Any:
        estimator = getattr(mkc_torch.linear, name)(**options)
        taken = {} if name == "GeneralizedMaximumEntropy" else {"sample_weight": sample_weight}
        estimator.fit(X, Y, **taken)
        return estimator.coef_, estimator.predict(X)

    return call


def decay(theta: Tensor, data: Tensor) -> Tensor:
    return (data[..., 1] - theta[..., 0] * torch.exp(-theta[..., 1] * data[..., 0])).unsqueeze(-1)


def _decayed() -> Tensor:
    time = torch.linspace(0.0, 3.0, 40, dtype=torch.float64)
    return torch.stack([time, 2.0 * torch.exp(-time) + 0.01 * data(40)], -1)


def _turned() -> dict[str, Tensor]:
    way = torch.linspace(0.0, 60.0, 400, dtype=torch.float64)
    high = torch.sin(0.37 * way)
    flat = (1.0 - high.square()).sqrt()
    field = 48.0 * torch.stack([flat * way.cos(), flat * way.sin(), high], -1) + data(400, 3)
    return dict(zip(("time", "mag_x", "mag_y", "mag_z"), (way, *(field + 9.0).unbind(-1)), strict=True))


def entries() -> Iterator[Entry]:
    """All entries."""
    positive = {"sigma": torch.tensor([1.0, 2.0]).double(), "d": torch.tensor([0.5, 1.0]).double()}
    bounded = positive | {"bound": 30.0}
    yield Entry(("functional.mkc_energy",), functional.mkc_energy, {"error": Y, **positive}, passes=("error",))
    yield Entry(("functional.mkc_weight",), functional.mkc_weight, {"error": Y, **positive}, passes=("error",))
    yield Entry(("functional.mkc_nll",), functional.mkc_nll, {"error": Y, **bounded}, passes=("error",))
    yield Entry(("functional.log_normalizer",), functional.log_normalizer, bounded)
    density = mkc_torch.density
    yield Entry(
        ("density.MKCDistribution",),
        lambda sigma, d, bound, loc, value: (
            (item := density.MKCDistribution(sigma, d, bound, loc)).log_prob(value),
            item.cdf(value),
            item.mean,
            item.variance,
            item.entropy(),
        ),
        {**bounded, "loc": 0.1, "value": Y},
    )
    yield Entry(
        ("density.fit_density", "density.DensityFit"),
        density.fit_density,
        {"error": Y, "weight": torch.ones_like(Y), "bound": 40.0, "d_min": 1e-3, "max_iter": 30},
    )
    yield Entry(
        ("density.assess_tails", "density.Tails", "density.ChannelTails"),
        density.assess_tails,
        {"error": Y, "weight": torch.ones_like(Y), "bound": 40.0, "d_min": 1e-3, "count": 50.0},
    )
    yield Entry(("density.fit_kernels", "density.KernelsFit"), density.fit_kernels, {"error": Y, "bound": 40.0})
    shares = {"sigma": 2.0, "d": 1.0, "epsilon": 0.3, "zeta": 0.5, "num_samples": 100, "num_inliers": 80}
    yield Entry(("density.error_bound",), density.error_bound, shares)
    yield Entry(("density.error_bound_slope",), density.error_bound_slope, shares)
    yield Entry(
        ("density.least_bandwidth",),
        density.least_bandwidth,
        {"epsilon": 0.3, "num_samples": 100, "num_inliers": 80},
    )
    yield Entry(("density.bandwidth_for_efficiency",), density.bandwidth_for_efficiency, {"efficiency": 0.9})
    yield Entry(
        ("density.breakdown_point",),
        density.breakdown_point,
        {"error": Y[:, 0], "sigma": 2.0, "d": 1.0, "num_coefficients": 2},
    )
    for name in ("gaussian_breakdown", "gaussian_efficiency"):
        yield Entry((f"density.{name}",), getattr(density, name), {"sigma": 2.0, "d": 1.0, "noise": 1.0})
    losses = mkc_torch.losses
    pair = {"input": Y, "target": Y + data(60, 2, seed=2)}
    yield Entry(
        ("losses.MKCLoss",),
        lambda input, target, **options: losses.MKCLoss(2, **options)(input, target),
        {**pair, "sigma": 2.0, "d": 1.0, "bound": 50.0},
    )
    yield Entry(
        ("density.TailsOverInput", "density.NoiseSpread"),
        lambda input, target, features: (
            losses.MKCLoss(2, sigma=2.0, d=1.0, bound=50.0).tails(input, target, features=features).likelihood_ratio
        ),
        {**pair, "features": X},
    )
    yield Entry(("losses.MKCLoss auto",), lambda input, target: losses.MKCLoss(2)(input, target), pair)

    def given() -> Any:
        return losses.MKCLoss(2, sigma=2.0, d=1.0, bound=50.0)

    for name in ("inlier_weight", "outliers", "beyond_bound"):
        yield Entry(
            (f"losses.{name}",),
            lambda input, target, name=name: getattr(losses, name)(given(), input, target),
            pair,
            passes=("input", "target") if name == "inlier_weight" else (),
        )
    yield Entry(
        ("losses.predictive_interval",),
        lambda input, level: losses.predictive_interval(given(), input, level),
        {"input": Y, "level": 0.8},
    )
    yield Entry(
        ("losses.GeneralizedCrossEntropyLoss",),
        lambda sigma, input, target: losses.GeneralizedCrossEntropyLoss(sigma)(input, target),
        {"sigma": 1.2, "input": data(20, 5), "target": torch.arange(20) % 5},
    )
    yield Entry(
        ("losses.HeteroscedasticMKCLoss", "losses.MKCHead", "losses.MKCHeadOutput"),
        lambda bound, d_min, features, target: losses.HeteroscedasticMKCLoss(bound)(
            (item := losses.MKCHead(3, 2, bound=bound, d_min=d_min).double()(features)).location,
            target,
            item.sigma,
            item.d,
        ),
        {"bound": 50.0, "d_min": 0.01, "features": X, "target": Y},
        passes=("features",),
    )
    yield Entry(
        ("losses.MKCConvHead",),
        lambda bound, d_min, features: losses.MKCConvHead(3, 2, bound=bound, d_min=d_min).double()(features),
        {"bound": 50.0, "d_min": 0.01, "features": data(2, 3, 4, 4)},
        passes=("features",),
    )
    yield Entry(("losses.LELoss",), lambda input, target: losses.LELoss()(input, target), pair)
    yield Entry(("losses.entropy_like",), losses.entropy_like, {"residual": Y, "dim": 0, "weight": torch.ones_like(Y)})
    yield Entry(
        ("losses.graduated_sigma",), losses.graduated_sigma, {"progress": 0.2, "start": 1.2, "end": 0.8, "until": 0.5}
    )
    yield Entry(
        ("losses.least_entropy_like",),
        lambda starts, max_iter: (
            losses.least_entropy_like(lambda p: Y[:, 0].to(p) - X[:, :2].to(p) @ p, starts, max_iter=max_iter).theta
        ),
        {"starts": data(2, 2), "max_iter": 20},
    )
    yield Entry(
        ("metrics.MKCNegativeLogLikelihood",),
        lambda input, target: (item := MKCNegativeLogLikelihood(given())).update(input, target) or item.compute(),
        pair,
    )
    for name, options in LINEAR.items():
        weighted = {"X": X, "Y": Y[:, 0], "sample_weight": torch.ones(60).double()}
        yield Entry((f"linear.{name}",), fitted(name), weighted | options, ("starts",))
    nonlinear = mkc_torch.nonlinear
    for name in ("fit", "minimise"):
        yield Entry(
            (f"nonlinear.{name}",),
            lambda name=name, **options: getattr(nonlinear, name)(decay, **options).theta,
            {
                "start": torch.tensor([1.0, 0.5]).double(),
                "data": _decayed(),
                "sigma": 2.0,
                "d": 0.05,
                "lower": torch.tensor([0.0, 0.0]).double(),
                "upper": torch.tensor([9.0, 9.0]).double(),
                "weight": torch.ones(40, 1).double(),
            },
            passes=("data",),
        )
    yield Entry(
        ("nonlinear.GaussianPrior",),
        lambda mean, precision: (
            nonlinear.minimise(
                decay,
                torch.tensor([1.0, 0.5]).double(),
                data=_decayed(),
                prior=nonlinear.GaussianPrior(mean, precision),
            ).theta
        ),
        {"mean": torch.ones(2).double(), "precision": torch.eye(2).double()},
    )
    covariance = mkc_torch.covariance
    yield Entry(
        ("covariance.MinimumCovarianceDeterminant",),
        lambda X, **options: covariance.MinimumCovarianceDeterminant(starts=20, **options).fit(X).covariance_,
        {"X": X, "support_fraction": 0.7, "cutoff": 0.975},
    )
    yield Entry(
        ("covariance.outlier_map", "covariance.OutlierMap"),
        lambda X, Y, cutoff: covariance.outlier_map(
            mkc_torch.linear.LeastTrimmedSquares(starts=40).fit(X, Y), X, Y,
            estimator=covariance.MinimumCovarianceDeterminant(starts=20), cutoff=cutoff,
        ).distances,
        {"X": X, "Y": Y[:, 0], "cutoff": 0.975},
    )  # fmt: skip
    turned = _turned()
    yield Entry(
        ("calibration.EllipsoidFit",),
        lambda points, sample_weight: EllipsoidFit().fit(points, sample_weight).center_,
        {
            "points": torch.stack([turned[f"mag_{axis}"] for axis in "xyz"], -1),
            "sample_weight": torch.ones(400).double(),
        },
    )
    yield Entry(
        ("calibration.calibrate", "calibration.Calibration", "recording.Recording"),
        lambda field_strength, **columns: (
            Calibration.from_json(calibrate(Recording(columns), field_strength=field_strength).to_json()).center
        ),
        {**turned, "field_strength": 48.0},
    )
    yield Entry(("simulation.Parameter",), mkc_torch.simulation.Parameter, {"value": 1.0, "lower": 0.0, "upper": 2.0})
    yield Entry(
        ("diagnosis.diagnose",),
        lambda simulation, recording, **options: diagnose(simulation, recording, **options).p_value,
        {
            "level": 0.05,
            "surrogates": 19,
            "seed": 0,
            "quick": False,
            "time_limit": 60.0,
            "simulation": "wrong",
            "recording": "wrong",
        },
    )


def contaminated(value: Any) -> Iterator[tuple[str, Any]]:
    """Invalid replacements of a value: a name, and the value."""
    yield "text", "contaminated"
    yield "object", object()
    if isinstance(value, Tensor):
        yield from _corrupted_tensors(value)
    elif isinstance(value, (int, float)):
        whole = isinstance(value, int)
        numbers = (NAN, INF, -INF, -1, 0, 1e308, 1e-308, 10**400, 1j, True)
        yield from ((f"{number!r}"[:9], number) for number in numbers)
        yield "half", value + 0.5 if whole else torch.tensor([[value]] * 3)


def _corrupted_tensors(value: Tensor) -> Iterator[tuple[str, Any]]:
    yield "None", None
    if not value.is_floating_point():
        yield "negative", -1 - value
        yield "huge", value + 2**40
        yield "float", value.double()
        return
    for name, number in (
        ("nan", NAN),
        ("inf", INF),
        ("-inf", -INF),
        ("1e300", 1e300 if value.dtype == torch.float64 else 1e38),
        ("-1", -1.0),
        ("0", 0.0),
    ):
        item = value.clone()
        item.view(-1)[min(3, item.numel() - 1)] = number
        yield f"one {name}", item
        yield f"all {name}", torch.full_like(value, number)
    yield "times 1e200", value * 1e200
    yield "times 1e-200", value * 1e-200
    yield "times 1e30 float32", (value * 1e30).float()
    yield "whole", value.long()
    yield "complex", value + 1j
    yield "bool", value > 0
    yield "half", value.half()
    yield "list", value.tolist()
    if value.dim():
        yield "empty", value[:0]
        yield "one row", value[:1]
        yield "two rows", value[:2]
        yield "twice as long", torch.cat([value, value])
        yield "without a dimension", value[0]
        yield "with a dimension", value[None]
        yield "equal rows", value[:1].expand_as(value)
        yield "transposed", value.mT if value.dim() > 1 else value.flip(0)
