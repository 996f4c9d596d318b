"""Contexts made by hand: what an effect sees of a recording."""

import torch

from mkc_torch.effects import Context

UNITS = {"temperature": ("°C",), "current": ("A",), "position": ("m", "m", "m"), "any": ("V",)}


def make_context(effect, N=60, channels=("x", "y", "z")):
    """A context with random drivers of the effect's first role, and a random signal of 30 µT; times are uneven."""
    generator = torch.Generator().manual_seed(3)
    units = UNITS[effect.roles[0]] if effect.roles else ()
    time = 5.0 + 0.5 * torch.rand(N, generator=generator, dtype=torch.float64).cumsum(0)
    drivers = torch.randn(N, len(units), generator=generator, dtype=torch.float64)
    signal = 30.0 * torch.randn(N, len(channels), generator=generator, dtype=torch.float64)
    return Context(time, drivers - drivers.mean(0), units, signal, "µT", channels)


def size_of(effect, shape, context):
    return sum(quantity.size for quantity in effect.quantities(shape, context))
