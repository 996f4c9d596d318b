"""The oracle: power of the best possible test to detect a hidden effect, and to separate it from its best rival.

``z² = (1 − ε) δᵀ M δ`` with δ the effect's trace in the residual, M the inverse of the noise's true covariance with the
calibration's tangents projected out in its metric, and ε the share of outliers; for ``z_sep`` the best rival's
tangents are projected out too. Without attitude the residual is that of the calibrated length. With a gyro it counts
as such too, which makes its z a lower bound. Effects enter to first order.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from examples.blind_proof.key import Key
from examples.blind_proof.magnetometer.families import EffectFamily
from examples.blind_proof.magnetometer.noise import Noise
from examples.blind_proof.magnetometer.process import Process, whitened
from examples.blind_proof.magnetometer.scene import Scene

if TYPE_CHECKING:
    from jaxtyping import Float


_RANK = 1e-9


@dataclass(frozen=True)
class Rival:
    """Another explanation, and its separability from the hidden effect."""

    effect: str
    drivers: tuple[str, ...]
    z_sep: float


@dataclass(frozen=True)
class Power:
    """Standard errors: ``z`` against no effect, ``z_sep`` against the best of ``rivals``, sorted, best first.

    ``coefficients`` are the best coefficients of the effect's own linear family, and ``missed`` the z of their
    residual; without such a family, None and infinity.
    """

    z: float
    z_sep: float
    rivals: tuple[Rival, ...]
    coefficients: tuple[float, ...] = ()
    missed: float = math.inf

    def scaled(self, size: float) -> Power:
        """Return the power for another size of the effect."""
        rivals = tuple(Rival(rival.effect, rival.drivers, size * rival.z_sep) for rival in self.rivals)
        coefficients = tuple(size * value for value in self.coefficients)
        missed = size * self.missed if self.coefficients else math.inf
        return Power(size * self.z, size * self.z_sep, rivals, coefficients, missed)


@dataclass(frozen=True)
class Question:
    """An effect's trace (N, 3) in the measurement's axes, its rivals, and its own linear family."""

    trace: Float[Tensor, "N 3"]
    rivals: Sequence[EffectFamily]
    own: EffectFamily | None = None


@dataclass(frozen=True)
class Metric:
    """The metric of the residual: the projection of a trace of the measurement to it, and its noise."""

    scene: Scene
    noise: Noise
    vector: bool

    def residual(self, traces: Float[Tensor, "N 3 p"]) -> Float[Tensor, "N c p"]:
        """Return the residual of the calibrated length (c = 1), or of the measured vector (c = 3), µT."""
        if self.vector:
            return traces
        return torch.einsum("ni,nip->np", self.scene.sensitivity, traces)[:, None]

    def nuisance(self) -> Float[Tensor, "N c q"]:
        """Return tangents of the calibration: offset, gains and couplings, and with attitude the world's field."""
        field, eye = self.scene.field, torch.eye(3, dtype=torch.float64)
        count = len(field)
        offset = eye.expand(count, 3, 3)
        coupling = torch.einsum("ij,nk->nijk", eye, field).reshape(count, 3, 9)
        tangents = [offset, coupling]
        if self.vector:
            tangents.append(self.scene.sensor.soft @ self.scene.motion.rotation.mT)
        return self.residual(torch.cat(tangents, -1))

    def white_variance(self) -> Float[Tensor, "N c"]:
        variance = torch.tensor(self.noise.white, dtype=torch.float64).square()
        if self.vector:
            return variance.expand(len(self.scene.time), 3)
        return (self.scene.sensitivity.square() @ variance)[:, None]

    def coloured(self) -> tuple[Float[Tensor, "N c s"], list[Process]]:
        """Return the noise processes and their gains in the residual."""
        count = len(self.scene.time)
        gains = torch.zeros(count, 3, 0, dtype=torch.float64)
        processes: list[Process] = []
        for known in (self.noise.axes, self.noise.walks):
            if known is not None:
                gains = torch.cat([gains, torch.eye(3, dtype=torch.float64).expand(count, 3, 3)], -1)
                processes += known
        if self.noise.ambient is not None:
            gains = torch.cat([gains, self.scene.along[:, :, None]], -1)
            processes.append(self.noise.ambient)
        if self.vector and self.noise.attitude is not None:
            gains = torch.cat([gains, attitude_gains(self.scene)], -1)
            processes += [self.noise.attitude] * 3
        return self.residual(gains), processes

    def whitened(self, traces: Float[Tensor, "N c p"], keep: Float[Tensor, " N"] | None = None) -> Float[Tensor, "M p"]:
        """Return whitened columns; their inner products are those of the inverse covariance."""
        gains, processes = self.coloured()
        return whitened(traces, self.white_variance(), gains, processes, keep)


def attitude_gains(scene: Scene) -> Float[Tensor, "N 3 3"]:
    """Return the change of the residual by a small rotation of the attitude about each world axis, µT/rad."""
    eye = torch.eye(3, dtype=torch.float64)
    turned = torch.linalg.cross(eye, scene.field_world.expand(3, 3))  # rows: e_k × h
    return scene.sensor.soft @ scene.motion.rotation.mT @ turned.mT


def powers(metric: Metric, questions: Sequence[Question], share: float) -> list[Power]:
    """Return the power of several effects at once; for each effect the forms of the others are known.

    Args:
        metric: metric of the residual.
        questions: a question for each effect; families are compared by identity.
        share: share of outliers.
    """
    families = [family for question in questions for family in (*question.rivals, question.own) if family is not None]
    union = list({id(family): family for family in families}.values())
    place = {id(family): k for k, family in enumerate(union)}
    projection = Projection(metric, [q.trace[..., None] for q in questions], [family.traces for family in union])
    kept = math.sqrt(1.0 - share)
    found = []
    for k, question in enumerate(questions):
        others = [j for j in range(len(questions)) if j != k]
        z = kept * projection.left(k, others, ())
        ranked = _best_of_each(
            [
                Rival(family.effect, family.drivers, kept * projection.left(k, others, (place[id(family)],)))
                for family in question.rivals
            ]
        )
        power = Power(z, min([z, *(rival.z_sep for rival in ranked)]), tuple(ranked))
        if question.own is not None:
            coefficients, missed = projection.coefficients(k, place[id(question.own)])
            power = replace(power, coefficients=tuple(coefficients.tolist()), missed=kept * missed)
        found.append(power)
    return found


def _best_of_each(rivals: Sequence[Rival]) -> list[Rival]:
    """Return the best rival of each family, sorted, best first."""
    best: dict[tuple[str, tuple[str, ...]], Rival] = {}
    for rival in sorted(rivals, key=lambda rival: rival.z_sep):
        best.setdefault((rival.effect, rival.drivers), rival)
    return list(best.values())


class Projection:
    """Whitened effects and families with the calibration projected out."""

    def __init__(
        self, metric: Metric, effects: Sequence[Float[Tensor, "N 3 p"]], families: Sequence[Float[Tensor, "N 3 p"]]
    ) -> None:
        blocks = [metric.residual(block) for block in (*effects, *families)]
        nuisance = metric.nuisance()
        columns = torch.cat([nuisance, *blocks], -1)
        # scaled, because the rank decision needs columns of similar size
        size = torch.linalg.vector_norm(columns, dim=(0, 1)).clamp(min=1e-300)
        white = metric.whitened(columns.div_(size))
        q = nuisance.shape[-1]
        self._size = size[q:]
        basis = range_of(white[:, :q])
        rest = white[:, q:]
        rest -= basis @ (basis.mT @ rest)
        self._gram = rest.mT @ rest
        ends = torch.tensor([0, *(block.shape[-1] for block in blocks)]).cumsum(0).tolist()
        self._parts = [list(range(a, b)) for a, b in pairwise(ends)]
        self._effects = len(effects)

    def left(self, effect: int, others: Sequence[int], families: Sequence[int]) -> float:
        """Return the length of the effect's trace, with other effects and families projected out."""
        target = self._parts[effect]
        out = [c for k in others for c in self._parts[k]]
        out += [c for k in families for c in self._parts[self._effects + k]]
        own = self._gram[target][:, target]
        if out:
            inside, cross = self._gram[out][:, out], self._gram[out][:, target]
            own = own - cross.mT @ torch.linalg.pinv(inside, hermitian=True, rtol=1e-10) @ cross
        return math.sqrt(max(float(own), 0.0)) * float(self._size[target])

    def coefficients(self, effect: int, family: int) -> tuple[Float[Tensor, " p"], float]:
        """Return the best coefficients of a family for the effect, and the length of the residual."""
        target, block = self._parts[effect], self._parts[self._effects + family]
        inside, cross = self._gram[block][:, block], self._gram[block][:, target]
        scaled = (torch.linalg.pinv(inside, hermitian=True, rtol=1e-10) @ cross)[:, 0]
        return scaled * self._size[target] / self._size[block], self.left(effect, (), (family,))


def range_of(columns: Float[Tensor, "M q"]) -> Float[Tensor, "M r"]:
    """Return an orthonormal basis of the span of columns."""
    u, s, _ = torch.linalg.svd(columns, full_matrices=False)
    return u[:, s > _RANK * s[0]]


def second_residual(
    metrics: tuple[Metric, Metric],
    traces: Sequence[Sequence[Float[Tensor, "N 3"]]],
    errors: tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]],
    good: tuple[Float[Tensor, " N"], Float[Tensor, " N"]],
) -> float:
    """Return the RMS of the calibrated length about its mean, on the inliers of the second recording, µT.

    Generalised least squares on the inliers of the first recording estimates the calibration and the effects' sizes.
    Its error propagates to the second. All to first order about the truth.

    Args:
        metrics: metric of the calibrated length, for the first and the second recording.
        traces: traces of the effects, for each recording.
        errors: errors of the measurement.
        good: masks of inliers.
    """
    tangents = [
        torch.cat([metric.nuisance(), *(metric.residual(trace[..., None]) for trace in group)], -1)
        for metric, group in zip(metrics, traces, strict=True)
    ]
    noise = [metric.residual(error[..., None]) for metric, error in zip(metrics, errors, strict=True)]
    scale = torch.linalg.vector_norm(tangents[0], dim=(0, 1)).clamp(min=1e-300)
    white = _for_the_mean(metrics[0]).whitened(torch.cat([tangents[0] / scale, noise[0]], -1), good[0])
    error = torch.linalg.pinv(white[:, :-1], rtol=1e-9) @ white[:, -1]
    left = (noise[1][..., 0] - (tangents[1] / scale) @ error)[:, 0][good[1]]
    return float(left.std())


def _for_the_mean(metric: Metric) -> Metric:
    """Remove random walks of the offset: generalised least squares would estimate their start, not their mean."""
    return replace(metric, noise=replace(metric.noise, walks=None))


def ratio_to_oracle(corrected: Mapping[str, Float[Tensor, " N"]], key: Key) -> float:
    """Return the spread of the corrected field's length on inliers, relative to the oracle's residual.

    The scale of a calibrated field is free: the mean length of the inliers is set to the true length.

    Args:
        corrected: ``field_x``, ``field_y``, ``field_z`` of the second recording.
        key: key of the case, with its ``oracle_rms`` and the second recording's outliers.

    Returns:
        The ratio; infinite if the corrected field is not finite.
    """
    length = torch.stack([corrected[f"field_{axis}"].double() for axis in "xyz"], -1).norm(dim=-1)
    good = torch.ones(len(length), dtype=torch.bool)
    good[list(key.second_outliers)] = False
    rms = float((length[good] / length[good].mean()).std()) * key.field_strength
    return rms / key.oracle_rms if math.isfinite(rms) else math.inf
