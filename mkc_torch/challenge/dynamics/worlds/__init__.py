"""Worlds of differential equations: pushes, inputs as controllers send them, starts far off, and misfits."""

from __future__ import annotations

from functools import partial

from mkc_torch.challenge import aims
from mkc_torch.challenge.dynamics.worlds.draw import draw, draw_useless
from mkc_torch.challenge.thresholds import Threshold
from mkc_torch.challenge.world import World, Worlds

__all__ = ["dynamics_worlds"]


def dynamics_worlds() -> Worlds:
    """Six systems, each in nine worlds; in all but ``coloured`` the sensors' noise is white.

    Example:
        >>> [world.name for world in dynamics_worlds().worlds][:3]
        ['white', 'coloured', 'pushed_white']
    """
    return Worlds(
        "dynamics",
        (
            _world("white", "white sensor noise", aims.WHITE),
            _world("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY),
            _world("pushed_white", "white force noise in the rate of one state", aims.PUSHED),
            _world("pushed_slowly", "a slow push of the rate of one state", aims.PUSHED),
            _world("gusts", "pushes of the rate of one state in some stretches", aims.PUSHED),
            _world("held", "inputs held between samples, which the simulation takes to be linear", aims.WHITE),
            _world("far_starts", "the simulation's parameters begin ten times off", aims.WHITE),
            _world("runs", "three to five runs", aims.WHITE),
            World("useless", "the simulation cannot follow the recording", draw_useless, aims.USELESS, hides=False),
        ),
        aims.TOTALS,
    )


def _world(name: str, sentence: str, asked: tuple[Threshold, ...]) -> World:
    return World(name, sentence, partial(draw, name), asked)
