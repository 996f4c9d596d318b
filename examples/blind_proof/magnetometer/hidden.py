"""The hidden physics: the trace of each effect in the measurement's axes, µT, for size 1.

The forms are realistic and differ from the catalogue: a step takes time and creeps, a nonlinearity saturates, a
gradient comes from a magnet a few metres away.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from examples.blind_proof.draws import choose, direction, happens, log_uniform, normal, uniform
from examples.blind_proof.magnetometer.scene import Scene, lagged

if TYPE_CHECKING:
    from jaxtyping import Float

MU0_4PI = 0.1
"""µ0/4π in µT m/A, which is µT m³/(A m²)."""


@dataclass(frozen=True)
class Hidden:
    """An effect without its size.

    ``trace(scene)`` is the effect on the measurement at size 1; it is linear in the size. ``most`` is the largest
    plausible change of a measurement, µT. ``driver`` is the column, or group of columns, that drives it, "" for none.
    """

    effect: str
    form: str
    trace: Callable[[Scene], Float[Tensor, "N 3"]]
    most: float
    driver: str = ""
    onset: float | None = None


def hard_iron_step(g: Generator, scene: Scene) -> Hidden:
    """A step of the offset within 0.02-0.3 s, followed by creep of a few per cent."""
    way, time = direction(g), scene.time
    first, last = float(time[0]), float(time[-1])
    onset = uniform(g, first + 0.15 * (last - first), last - 0.15 * (last - first))
    rise, creep, constant = uniform(g, 0.02, 0.3), uniform(g, -0.06, 0.06), log_uniform(g, 2.0, 15.0)

    def trace(at: Scene) -> Tensor:
        if at.settled:
            return way.expand(len(at.time), 3)
        x = at.time - onset
        ramp = 0.5 - 0.5 * torch.cos(math.pi * (x / rise + 0.5).clamp(0.0, 1.0))
        return (ramp * (1.0 - creep * torch.exp(-x.clamp(min=0.0) / constant)))[:, None] * way

    return Hidden("hard_iron_step", "finite rise with creep", trace, 50.0, onset=onset)


def offset_drift(g: Generator, scene: Scene) -> Hidden:
    """A drift of the offset: two exponentials with different directions, a stretched one, or a Gompertz curve."""
    way, time = direction(g), scene.time
    first, length = float(time[0]), float(time[-1] - time[0])
    form = choose(g, ("two exponentials", "stretched exponential", "Gompertz"))
    fast, slow = uniform(g, 0.05, 0.2) * length, uniform(g, 0.3, 1.2) * length
    second = torch.nn.functional.normalize(way + 0.5 * normal(g, 3), dim=0) * uniform(g, 0.5, 1.5)
    middle, width = uniform(g, 0.25, 0.6) * length, uniform(g, 0.08, 0.25) * length
    stretch = uniform(g, 0.45, 0.8)

    def shape(x: Tensor) -> Tensor:
        if form == "two exponentials":
            return (1 - torch.exp(-x / fast))[:, None] * way + (1 - torch.exp(-x / slow))[:, None] * second
        if form == "stretched exponential":
            return (1 - torch.exp(-(x / slow).pow(stretch)))[:, None] * way
        return torch.exp(-torch.exp(-(x - middle) / width))[:, None] * way

    def trace(at: Scene) -> Tensor:
        x = torch.full_like(at.time, length) if at.settled else at.time - first
        return shape(x)

    return Hidden("offset_drift", form, trace, 30.0)


def _bend(g: Generator) -> tuple[float, float, float]:
    """Draw the lag of the die in s, the log ratio of its slopes, and its trimming temperature in °C."""
    return uniform(g, 0.0, 0.5), choose(g, (-1.0, 1.0)) * uniform(g, 0.01, 0.1), 25.0


def _warmed(temperature: Tensor, step: float, lag: float) -> Tensor:
    """Return the temperature behind two thermal masses in series, case and die, with this total lag."""
    return lagged(lagged(temperature, step, 0.6 * lag), step, 0.4 * lag)


def temperature_offset(g: Generator, scene: Scene) -> Hidden:
    """An offset exponential in T − T0, at most a tenth steeper at its end; the die lags by at most 0.5 s."""
    way = direction(g)
    lag, bend, center = _bend(g)
    span = float((scene.temperature - center).abs().max())

    def trace(at: Scene) -> Tensor:
        x = _warmed(at.temperature, at.step, lag) - center
        return (torch.expm1(bend * x / span) * span / bend)[:, None] * way

    return Hidden("temperature_offset", "lagged, slightly exponential", trace, 40.0, driver="temperature")


def temperature_gain(g: Generator, scene: Scene) -> Hidden:
    """A gain that follows the temperature of the die."""
    lag, _, center = _bend(g)

    def trace(at: Scene) -> Tensor:
        x = _warmed(at.temperature, at.step, lag) - center
        return x[:, None] * (at.field @ at.sensor.soft.mT) / 50.0

    return Hidden("temperature_gain", "lagged", trace, 10.0, driver="temperature")


def current_field(g: Generator, scene: Scene) -> Hidden:
    """A loop of two straight wires of finite length next to the sensor, by Biot-Savart."""
    unit = two_wire_field(g)

    def trace(at: Scene) -> Tensor:
        return at.current[:, None] * (unit @ at.sensor.soft.mT)

    return Hidden("current_field", "two-wire loop", trace, 60.0, driver="current")


def two_wire_field(g: Generator) -> Float[Tensor, " 3"]:
    """Return the field at the origin of two opposite wires some centimetres away, µT/A."""
    along, aside = direction(g), direction(g)
    distance, spacing, half = uniform(g, 0.03, 0.1), uniform(g, 0.005, 0.03), uniform(g, 0.05, 0.2)
    place = distance * torch.nn.functional.normalize(torch.linalg.cross(along, aside), dim=0)
    shift = 0.5 * spacing * torch.nn.functional.normalize(torch.linalg.cross(along, place) + 0.3 * place, dim=0)
    return wire_field(place + shift, along, half) - wire_field(place - shift, along, half)


def wire_field(place: Float[Tensor, " 3"], along: Float[Tensor, " 3"], half: float) -> Float[Tensor, " 3"]:
    """Return the field at the origin of a straight wire of length ``2 half`` about ``place``, µT/A.

    Example:
        >>> x, y = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.1, 0.0])
        >>> [round(v, 2) for v in wire_field(y, x, 1e4).tolist()]  # long: µ0 I / (2π ρ)
        [0.0, 0.0, -2.0]
    """
    toward = -place
    axial = float(toward @ along)
    radial = toward - axial * along
    rho = float(torch.linalg.vector_norm(radial))
    ends = (axial + half) / math.hypot(axial + half, rho) - (axial - half) / math.hypot(axial - half, rho)
    return MU0_4PI * ends / rho * torch.linalg.cross(along, radial / rho)


def field_gradient(g: Generator, scene: Scene) -> Hidden:
    """A distant magnet or long iron bar: the surrounding field changes with position."""
    middle = scene.motion.position.mean(0)
    reach = float(torch.linalg.vector_norm(scene.motion.position - middle, dim=-1).max())
    source = middle + (reach + log_uniform(g, 1.0, 8.0)) * direction(g)
    moment, axis, bar = direction(g), direction(g), happens(g, 0.5)

    def at_place(place: Tensor) -> Tensor:
        return bar_field(place - source, moment, axis) if bar else dipole_field(place - source, moment)

    def trace(at: Scene) -> Tensor:
        return at.measured(at_place(at.motion.position) - at_place(middle))

    return Hidden("field_gradient", "iron bar" if bar else "dipole", trace, 20.0, driver="position")


def dipole_field(place: Float[Tensor, "N 3"], moment: Float[Tensor, "*N 3"]) -> Float[Tensor, "N 3"]:
    """Return the field of a dipole in A m² at the origin, at places in m, µT.

    Example:
        >>> z = torch.tensor([0.0, 0.0, 1.0])
        >>> dipole_field(0.1 * z, 0.1 * z)  # on its axis: µ0/4π 2m/r³
        tensor([ 0.,  0., 20.])
    """
    distance = torch.linalg.vector_norm(place, dim=-1, keepdim=True)
    unit = place / distance
    return MU0_4PI * (3.0 * (unit * moment).sum(-1, keepdim=True) * unit - moment) / distance**3


def bar_field(place: Float[Tensor, "N 3"], moment: Float[Tensor, " 3"], axis: Float[Tensor, " 3"]) -> Tensor:
    """Return the field of a line of dipoles, 1 A m² per metre, along ``axis`` through the origin, µT."""
    across = place - (place @ axis)[..., None] * axis
    turned = moment - (moment @ axis) * axis
    rho = torch.linalg.vector_norm(across, dim=-1, keepdim=True)
    unit = across / rho
    return 2.0 * MU0_4PI * (2.0 * (unit * turned).sum(-1, keepdim=True) * unit - turned) / rho**2


def cubic_nonlinearity(g: Generator, scene: Scene) -> Hidden:
    """A core that saturates like tanh or the Langevin function; the size is the loss in µT at 50 µT.

    The hard iron is a magnet that acts on the core, or an offset of the electronics that does not.
    """
    form = choose(g, ("tanh", "langevin"))
    knee, magnet = log_uniform(g, 80.0, 250.0), happens(g, 0.3)
    share = torch.tensor([uniform(g, 0.3, 1.0) for _ in range(3)], dtype=torch.float64)
    loss = _tanh_loss if form == "tanh" else _langevin_loss
    scale = loss(torch.tensor(50.0, dtype=torch.float64), knee)

    def trace(at: Scene) -> Tensor:
        core = at.field @ at.sensor.soft.mT
        return -share * loss(core + at.sensor.hard if magnet else core, knee) / scale

    return Hidden("cubic_nonlinearity", f"{form}, {'with' if magnet else 'without'} the hard iron", trace, 3.0)


def _tanh_loss(x: Tensor, knee: float) -> Tensor:
    return x - knee * torch.tanh(x / knee)


def _langevin_loss(x: Tensor, knee: float) -> Tensor:
    y = x / knee
    small = y.abs() < 1e-2
    safe = torch.where(small, 1.0, y)
    return torch.where(small, x * y.square() / 15.0, x - 3.0 * knee * (1.0 / torch.tanh(safe) - 1.0 / safe))


def mains_interference(g: Generator, scene: Scene) -> Hidden:
    """A sinusoid at an alias of the mains frequency."""
    way, frequency, phase = direction(g), uniform(g, 0.3, 20.0), uniform(g, 0.0, 2.0 * math.pi)

    def trace(at: Scene) -> Tensor:
        return torch.cos(2.0 * math.pi * frequency * at.time + phase)[:, None] * way

    return Hidden("mains_interference", "sinusoid", trace, 5.0)


def hysteresis(g: Generator, scene: Scene) -> Hidden:
    """The play operator on each axis: magnetic hysteresis of a core."""
    width = uniform(g, 3.0, 15.0)
    share = torch.tensor([uniform(g, 0.3, 1.0) for _ in range(3)], dtype=torch.float64)

    def trace(at: Scene) -> Tensor:
        core = at.field @ at.sensor.soft.mT + at.sensor.hard
        return share * (play(core, width) - core) / width

    return Hidden("hysteresis", "play operator", trace, 3.0)


def play(x: Float[Tensor, "N k"], width: float) -> Float[Tensor, "N k"]:
    """Apply the play operator with half-width ``width``, starting at the first value.

    Example:
        >>> play(torch.tensor([[0.0], [3.0], [2.5], [-1.0]]), 1.0).ravel()
        tensor([0., 2., 2., 0.])
    """
    out = [x[0]]
    for value in x[1:]:
        out.append(torch.minimum(torch.maximum(out[-1], value - width), value + width))
    return torch.stack(out)


def magnetic_disturbance(g: Generator, scene: Scene) -> Hidden:
    """A dipole, such as a telephone, carried past the sensor in a straight line."""
    time = scene.time
    first, last = float(time[0]), float(time[-1])
    when, speed = uniform(g, first + 0.15 * (last - first), last - 0.15 * (last - first)), uniform(g, 0.15, 0.8)
    way, aside, moment = direction(g), direction(g), direction(g)
    nearest = uniform(g, 0.1, 0.4) * torch.nn.functional.normalize(aside - (aside @ way) * way, dim=0)

    def trace(at: Scene) -> Tensor:
        if at.settled:
            return torch.zeros(len(at.time), 3, dtype=torch.float64)
        path = nearest + speed * (at.time - when)[:, None] * way
        return at.measured(dipole_field(-path, moment))

    return Hidden("magnetic_disturbance", "passing dipole", trace, 40.0, onset=when)


CATALOGUE: Mapping[str, Callable[[Generator, Scene], Hidden]] = MappingProxyType(
    {
        "hard_iron_step": hard_iron_step,
        "offset_drift": offset_drift,
        "temperature_offset": temperature_offset,
        "current_field": current_field,
        "field_gradient": field_gradient,
        "cubic_nonlinearity": cubic_nonlinearity,
    }
)
"""The effects that a diagnosis has to name."""

OUTSIDE: Mapping[str, Callable[[Generator, Scene], Hidden]] = MappingProxyType(
    {
        "mains_interference": mains_interference,
        "hysteresis": hysteresis,
        "magnetic_disturbance": magnetic_disturbance,
        "temperature_gain": temperature_gain,
    }
)
"""Effects that are scored separately, because a short catalogue may not contain them."""
