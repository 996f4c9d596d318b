"""Worlds of the magnetometer: noise of the world, disturbances, resting orientations, and misfits."""

from __future__ import annotations

from functools import partial

from mkc_torch.challenge import aims
from mkc_torch.challenge.magnetometer.motion import DURATION
from mkc_torch.challenge.magnetometer.scenarios.draw import draw, draw_useless
from mkc_torch.challenge.scenario import Scenario, Scenarios
from mkc_torch.challenge.thresholds import Threshold

__all__ = ["magnetometer_worlds"]


def magnetometer_worlds(duration: float = DURATION) -> Scenarios:
    """Recordings of a magnetometer in six worlds, each so many seconds long; white noise in all but ``coloured``.

    Example:
        >>> [world.name for world in magnetometer_worlds().worlds]
        ['white', 'coloured', 'wander', 'bursts', 'orientations', 'useless']
    """

    def world(name: str, sentence: str, asked: tuple[Threshold, ...], right: str) -> Scenario:
        return Scenario(
            name, sentence, partial(draw, name, duration), asked, right_to_say=right, wrong_to_say=aims.CLAIMED
        )

    useless = partial(draw_useless, duration)
    return Scenarios(
        "magnetometer",
        (
            world("white", "white sensor noise", aims.WHITE, aims.QUIET),
            world("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY, aims.NAMELESS),
            world("wander", "an offset that wanders", aims.ORDINARY, aims.NAMELESS),
            world("bursts", "disturbances in some stretches", aims.ORDINARY, aims.NAMELESS),
            world("orientations", "the sensor rests in one orientation after another", aims.WHITE, aims.QUIET),
            Scenario(
                "useless",
                "the view cannot follow the recording",
                useless,
                aims.USELESS,
                hides=False,
                right_to_say="unfit",
                wrong_to_say="adequate",
            ),
        ),
        aims.TOTALS,
        {"duration_s": duration},
    )
