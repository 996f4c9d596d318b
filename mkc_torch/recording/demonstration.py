"""A SIMULATED magnetometer for the demonstration: turned by hand while a magnet passes, or next to a cable."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mkc_torch.recording.recording import Recording

if TYPE_CHECKING:
    from jaxtyping import Float

RATE = 50.0  # Hz
SECONDS = 90.0
FIELD = 48.0  # µT
DIP = math.radians(64.0)
OFFSET = (12.0, -7.5, 21.0)  # µT
RESPONSE = ((1.06, 0.03, -0.02), (0.03, 0.95, 0.015), (-0.02, 0.015, 1.01))  # gains and cross-axis, no unit
NOISE = 0.5  # µT, white
RESOLUTION = 0.15  # µT a count
PASSING = 40.0  # s, when the dipole is nearest
MOMENT = (1.6, 1.6, -2.4)  # A·m², a large loudspeaker
NEAREST = 0.17  # m
SPEED = 0.24  # m/s
MU0_OVER_4PI = 0.1  # µT·m³/(A·m²)

FIELD_PER_AMPERE = (0.3, -0.2, 0.4)  # µT/A, field of a cable next to the sensor
_CABLE_RATE = 20.0  # Hz
_CABLE_SECONDS = 60.0  # s
_OUTLIERS = 0.05  # share of samples
_OUTLIER = 8.0  # µT, standard deviation


@dataclass(frozen=True)
class Truth:
    """True values: offset and semi-axes in µT, and the interval in s in which the disturbance exceeds 1 µT."""

    center: tuple[float, float, float]
    semi_axes: tuple[float, float, float]
    disturbed: tuple[float, float]


def simulated_recording(seed: int = 0) -> tuple[Recording, Truth]:
    """Ninety seconds of ``time``, ``mag_x``, ``mag_y``, ``mag_z`` at 50 Hz, and their true parameters.

    A hand turns the sensor through all directions in a field of 48 µT while a loudspeaker is carried past it. The
    sensor has an offset, unequal gains, cross-axis coupling, white noise and a resolution of 0.15 µT.

    Example:
        >>> recording, truth = simulated_recording()
        >>> len(recording), truth.center
        (4500, (12.0, -7.5, 21.0))
    """
    generator = torch.Generator().manual_seed(seed)
    time = torch.arange(round(RATE * SECONDS), dtype=torch.float64) / RATE
    to_body = _hand_rotation(time)
    earth = FIELD * torch.tensor([math.cos(DIP), 0.0, -math.sin(DIP)], dtype=torch.float64)
    dipole = passing_dipole(time)
    field = torch.einsum("nij,nj->ni", to_body, earth + dipole)
    response = torch.tensor(RESPONSE, dtype=torch.float64)
    measured = field @ response.mT + torch.tensor(OFFSET, dtype=torch.float64)
    measured = measured + NOISE * torch.randn(measured.shape, generator=generator, dtype=torch.float64)
    counts = torch.round(measured / RESOLUTION)
    disturbed = time[torch.linalg.vector_norm(dipole, dim=-1) > 1.0]
    semi_axes = sorted((FIELD * torch.linalg.svdvals(response)).tolist())
    columns = {"time": time} | {f"mag_{axis}": RESOLUTION * counts[:, i] for i, axis in enumerate("xyz")}
    truth = Truth(OFFSET, (semi_axes[0], semi_axes[1], semi_axes[2]), (float(disturbed[0]), float(disturbed[-1])))
    return Recording(columns, name="simulated_sensor"), truth


def concealed_recording(seed: int = 0) -> Recording:
    """A minute of ``time``, ``mag_x`` to ``mag_z``, ``current`` and ``temperature`` at 20 Hz, with a hidden effect.

    The same sensor is next to a cable, whose current adds :data:`FIELD_PER_AMPERE`, less than the noise. One sample in
    twenty is an outlier. The temperature rises without an effect.

    Example:
        >>> concealed_recording().names
        ('time', 'mag_x', 'mag_y', 'mag_z', 'current', 'temperature')
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    time = torch.arange(round(_CABLE_RATE * _CABLE_SECONDS), dtype=torch.float64) / _CABLE_RATE
    begin, *phase = (50.0 * torch.rand(4, generator=generator, dtype=torch.float64)).tolist()
    waves = 1.2 * torch.sin(0.9 * time + phase[0]) + 0.8 * torch.sin(2.3 * time + phase[1])
    current = 3.0 + waves + 0.6 * torch.sign(torch.sin(0.35 * time + phase[2]))
    temperature = 24.0 + 2.5 * time / _CABLE_SECONDS + 0.05 * normal(len(time))
    earth = FIELD * torch.tensor([math.cos(DIP), 0.0, -math.sin(DIP)], dtype=torch.float64)
    response = torch.tensor(RESPONSE, dtype=torch.float64)
    measured = _hand_rotation(begin + time) @ earth @ response.mT + torch.tensor(OFFSET, dtype=torch.float64)
    measured = measured + current.unsqueeze(-1) * torch.tensor(FIELD_PER_AMPERE, dtype=torch.float64)
    outlier = torch.rand(len(time), 1, generator=generator, dtype=torch.float64) < _OUTLIERS
    measured = measured + NOISE * normal(*measured.shape) + outlier * _OUTLIER * normal(*measured.shape)
    columns = {"time": time} | {f"mag_{axis}": measured[:, i] for i, axis in enumerate("xyz")}
    return Recording(columns | {"current": current, "temperature": temperature}, name="concealed")


def passing_dipole(time: Float[Tensor, " N"]) -> Float[Tensor, "N 3"]:
    """Field in µT of a dipole that is carried past the sensor on a straight line, in the room's axes."""
    along = SPEED * (time - PASSING)
    r = torch.stack([along, torch.full_like(time, NEAREST), 0.3 * along], -1)
    distance = torch.linalg.vector_norm(r, dim=-1, keepdim=True)
    unit = r / distance
    moment = torch.tensor(MOMENT, dtype=torch.float64)
    return MU0_OVER_4PI * (3.0 * unit * (unit @ moment).unsqueeze(-1) - moment) / distance.pow(3)


def _hand_rotation(time: Tensor) -> Tensor:
    """Rotations (N, 3, 3) from the room to the sensor: slow turns about two axes with a wobble, by Euler angles."""
    yaw = 2.0 * math.pi * time / 2.9 + 0.4 * torch.sin(1.1 * time)
    pitch = 2.0 * math.pi * time / 37.0 + 0.3 * torch.sin(0.7 * time + 1.0)
    roll = 2.0 * math.pi * time / 17.0 + 0.3 * torch.sin(0.43 * time)
    return _turn(yaw, 2) @ _turn(pitch, 1) @ _turn(roll, 0)


def _turn(angle: Tensor, axis: int) -> Tensor:
    """Rotations by an angle about a coordinate axis."""
    c, s = torch.cos(angle), torch.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = torch.eye(3, dtype=angle.dtype).repeat(len(angle), 1, 1)
    matrix[:, i, i], matrix[:, j, j], matrix[:, i, j], matrix[:, j, i] = c, c, s, -s
    return matrix
