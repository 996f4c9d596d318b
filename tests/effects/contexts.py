"""Artificial contexts for effects."""

import torch

from mkc_torch.effects import DYNAMICS, PAIRED, Context
from mkc_torch.effects.context import SEVERAL
from mkc_torch.simulation.outputs import ALL, output_ports
from mkc_torch.simulation.ports import SignalSizes

UNITS = {"temperature": ("°C",), "current": ("A",), "position": ("m", "m", "m"), "any": ("V",), "spin": ("rad/s",)}


def make_context(effect, N=60, channels=("x", "y", "z")):
    """Return a context with uneven times, random drivers of the effect's first role, and a random signal of 30 µT."""
    generator = torch.Generator().manual_seed(3)
    units = UNITS.get(effect.roles[0], ("V",)) if effect.roles else ()
    time = 5.0 + 0.5 * torch.rand(N, generator=generator, dtype=torch.float64).cumsum(0)
    drivers = torch.randn(N, len(units), generator=generator, dtype=torch.float64)
    signal = 30.0 * torch.randn(N, len(channels), generator=generator, dtype=torch.float64)
    return Context(time, drivers - drivers.mean(0), units, signal, "µT", channels)


def heading_context(N=60):
    """Return a context of a recorded heading with two resets."""
    time = 0.1 * torch.arange(N, dtype=torch.float64)
    since = torch.stack([time > 1.0, time > 4.0], -1).double()
    return Context(time, time.new_zeros(N, 0), (), since, "°", ("heading",), ("since_1", "since_2"))


def dynamic_context(effect, N=80, driven=False):
    """Return a context with uneven times at a port that has all parts an effect may need.

    With ``driven``, or if the effect needs a driver, the context has one, with a mean of 2.
    """
    generator = torch.Generator().manual_seed(1)
    time = 0.02 + 0.05 * torch.rand(N, generator=generator, dtype=torch.float64).cumsum(0)
    drivers, driver_units, means = time.new_zeros(N, 0), (), ()
    if driven or needs_driver(effect):
        drivers, driver_units, means = torch.cos(3.0 * time).unsqueeze(-1), UNITS[effect.roles[0]], (2.0,)
    if effect.port in ("input", "output", "single output"):
        parts, units = {"own": "force", "pace": "force"}, {"own": "N", "pace": "N/s"}
        signal = oscillating(N, 1)
        return Context(time, drivers, driver_units, signal, "N", ("force",), (), parts, units, None, means)
    if effect.port == "parameter":
        signal = time.new_full((N, 1), 1.7)
        parts, units = {"own": "drag"}, {"own": "1/m"}
        return Context(time, drivers, driver_units, signal, "1/m", ("drag",), (), parts, units, None, means)
    names = ("angle", "speed", "other", "load", "rate")
    parts = {
        "own": "speed", "position": "angle", "angle": "angle", "deflection": "angle", "reversing": "speed",
        "temperature": "speed", "level": "speed", "other": "other", "other level": "other", "load": "load",
        "rate": "rate", "height": "angle", "sideways": "other", "surroundings": "other",
    }  # fmt: skip
    of = {"angle": "rad", "speed": "rad/s", "other": "rad/s", "load": "rad/s/s", "rate": "rad/s/s"}
    units = {part: of[name] for part, name in parts.items()}
    if "temperature" in effect.needs:
        units |= dict.fromkeys(("own", "temperature", "surroundings"), "°C")
    channels = ("speed", "other") if effect.port == "exchange" else ("speed",)
    signal = oscillating(N, len(names))
    signal[:, 3] = signal[:, 3].abs()
    return Context(time, drivers, driver_units, signal, "rad/s/s", channels, names, parts, units, None, means)


def needs_driver(effect):
    """Return whether an effect is tried with a driver only."""
    return bool(effect.roles) and not effect.driver_optional


def oscillating(N, count):
    """Components of both signs, with a standard deviation of 2."""
    return 2.0 * torch.randn(N, count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def paired_context(effect, N=120):
    """Return the context of an output in V that is compared with a simulated output."""
    time = torch.arange(N, dtype=torch.float64) / 10.0
    names = ("y", "z") if SEVERAL in effect.needs else ("y",)
    signal = torch.stack([2.0 * torch.sin((1.3 + 0.4 * k) * time) + 0.2 for k, _ in enumerate(names)], -1)
    unit = "rad" if "angle" in effect.needs else "V"
    ports = output_ports(names, dict.fromkeys(names, unit), unit, signal, names, names)
    port = ports[ALL if effect.port == "outputs" else "output y"]
    assert set(effect.needs) <= set(port.parts)
    count = 0 if not effect.roles else 2 if "pair" in effect.roles else 1
    drivers = (
        torch.stack([torch.cos((0.7 + 0.4 * k) * time) for k in range(count)], -1) if count else time[:, None][:, :0]
    )
    return Context(time, drivers, ("A", "m")[:count], signal, unit, names, (), port.parts, port.part_units)


def contexts_of(effect):
    """Return every kind of context of an effect of the catalogue or of a user's own sensor effect."""
    if effect.port == "heading":
        return (heading_context(),)
    if effect in PAIRED or any(type(known.simpler) is type(effect) for known in PAIRED if known.simpler):
        return (paired_context(effect),)
    if effect in DYNAMICS or any(type(known.simpler) is type(effect) for known in DYNAMICS if known.simpler):
        return (dynamic_context(effect), *([dynamic_context(effect, driven=True)] if effect.driver_optional else []))
    return make_context(effect), make_context(effect, channels=("strength",))


def within(effect, shape, context):
    """Return the shape with ranges scaled by the lowest and highest value of their part."""
    shape = dict(shape)
    for name, (part, which) in effect.relative.items():
        if which in ("lowest", "highest"):
            values = context.part("own") - context.part(part) if part == "surroundings" else context.part(part)
            shape[name] *= getattr(SignalSizes.of(values), which)
    return shape


def kinds_of_shapes(effect, context):
    """Return the first and the last shape of an effect of each set of shape parameters."""
    kinds = {}
    for shape in (within(effect, shape, context) for shape in effect.shapes(context.time)):
        kinds.setdefault(tuple(sorted(shape)), []).append(shape)
    return [shape for alike in kinds.values() for shape in (alike[0], *alike[1:][-1:])]


def size_of(effect, shape, context):
    """Return the number of amplitudes."""
    return sum(quantity.size for quantity in effect.quantities(shape, context))
