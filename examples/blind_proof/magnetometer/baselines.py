"""The baseline: an ellipsoid by least squares, then stepwise regression of the residual by BIC."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from examples.blind_proof.magnetometer.families import ONSET_GRID, POSITION, ROLES, TIME_CONSTANTS
from mkc_torch.calibration.ellipsoid_fit import EllipsoidFit
from mkc_torch.calibration.not_identifiable import NotIdentifiableError
from mkc_torch.linear import LeastSquares
from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

MOST_FINDINGS = 3


@dataclass(frozen=True)
class BaselineCandidate:
    """Return columns that an effect would add to the residual of the norm."""

    effect: str
    drivers: tuple[str, ...]
    onset: float | None
    columns: Float[Tensor, "N p"]


def stepwise_bic(recording: Recording) -> dict[str, Any] | None:
    """Return ``diagnosis.json`` of least squares with stepwise BIC; None if no ellipsoid fits."""
    points = recording.magnetometer()
    try:
        fit = EllipsoidFit(LeastSquares(), max_scatter=math.inf).fit(points)
    except (NotIdentifiableError, ValueError):
        return None
    corrected = (points - fit.center_) @ fit.calibration_matrix_.mT
    length = torch.linalg.vector_norm(corrected, dim=-1)
    u = corrected / length[:, None]
    residual = length - length.mean()
    found = _forward(residual, _nuisance(u), candidates(recording, u, corrected))
    findings = [
        {"effect": c.effect, "drivers": list(c.drivers), "onset": c.onset, "parameters": [], "alternatives": []}
        for c in found
    ]
    return {"verdict": "explained" if findings else "adequate", "findings": findings}


def candidates(recording: Recording, u: Float[Tensor, "N 3"], field: Float[Tensor, "N 3"]) -> list[BaselineCandidate]:
    """Offsets that follow a column, a trend, an exponential or a step; the cube of the field; a gradient."""
    time = recording["time"]
    x = time - time[0]
    names = [name for name in recording.names if name != "time" and not name.startswith("mag_")]
    found = [
        BaselineCandidate(ROLES.get(name, "driver_offset"), (name,), None, u * _centred(recording[name]))
        for name in names
    ]
    shapes = (x, *(torch.exp(-x / constant) for constant in TIME_CONSTANTS))
    found += [BaselineCandidate("offset_drift", (), None, u * _centred(shape)) for shape in shapes]
    for k in range(2, int(float(x[-1]) / ONSET_GRID) - 1):
        onset = float(time[0]) + k * ONSET_GRID
        found.append(BaselineCandidate("hard_iron_step", (), onset, u * (time > onset).double()[:, None]))
    found.append(BaselineCandidate("cubic_nonlinearity", (), None, u * field**3))
    if all(name in recording for name in POSITION):
        place = recording.stack(*POSITION)
        found.append(BaselineCandidate("field_gradient", POSITION, None, place - place.mean(0)))
    return found


def _forward(residual: Tensor, nuisance: Tensor, options: list[BaselineCandidate]) -> list[BaselineCandidate]:
    """Add the candidate that lowers BIC most, until no candidate lowers it."""
    basis = torch.linalg.qr(nuisance).Q
    columns = torch.cat([option.columns for option in options], -1)
    columns = columns / torch.linalg.vector_norm(columns, dim=0).clamp(min=1e-300)
    everything = torch.cat([columns, residual[:, None]], -1)
    everything = everything - basis @ (basis.mT @ everything)
    gram = everything.mT @ everything
    ends = torch.tensor([0, *(option.columns.shape[-1] for option in options)]).cumsum(0).tolist()
    parts = [list(range(a, b)) for a, b in pairwise(ends)]
    count, chosen = len(residual), []
    for _ in range(MOST_FINDINGS):
        total = float(gram[-1, -1])
        gains = [_explained(gram, part) for part in parts]
        scores = [
            -count * math.log(max(1.0 - gain / total, 1e-12)) - len(part) * math.log(count)
            for gain, part in zip(gains, parts, strict=True)
        ]
        best = max(range(len(options)), key=scores.__getitem__)
        if scores[best] <= 0.0:
            break
        chosen.append(options[best])
        cross = gram[parts[best]]
        gram = gram - cross.mT @ torch.linalg.pinv(cross[:, parts[best]], hermitian=True, rtol=1e-8) @ cross
    return chosen


def _explained(gram: Tensor, part: list[int]) -> float:
    inside, cross = gram[part][:, part], gram[part, -1]
    if float(inside.diagonal().min()) < 1e-10:
        return 0.0
    return float(cross @ torch.linalg.pinv(inside, hermitian=True, rtol=1e-8) @ cross)


def _nuisance(u: Tensor) -> Tensor:
    x, y, z = u.unbind(-1)
    return torch.stack([x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], -1)


def _centred(values: Tensor) -> Tensor:
    return (values - values.mean())[:, None]
