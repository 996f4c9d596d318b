"""Scenarios of the magnetometer: noise, drift, bursts, resting orientations, and unusable recordings."""

from __future__ import annotations

from functools import partial

from mkc_torch.challenge import aims
from mkc_torch.challenge.magnetometer.motion import DURATION
from mkc_torch.challenge.magnetometer.scenarios.draw import draw, draw_useless
from mkc_torch.challenge.scenario import Scenario, Scenarios
from mkc_torch.challenge.thresholds import Threshold

__all__ = ["magnetometer_scenarios"]


def magnetometer_scenarios(duration: float = DURATION) -> Scenarios:
    """Return six scenarios of a magnetometer, for recordings of a duration in s. Noise is white except in ``coloured``.

    Example:
        >>> [scenario.name for scenario in magnetometer_scenarios().scenarios]
        ['white', 'coloured', 'wander', 'bursts', 'orientations', 'useless']
    """

    def scenario(name: str, sentence: str, asked: tuple[Threshold, ...], right: str) -> Scenario:
        return Scenario(
            name, sentence, partial(draw, name, duration), asked, right_to_say=right, wrong_to_say=aims.CLAIMED
        )

    useless = partial(draw_useless, duration)
    return Scenarios(
        "magnetometer",
        (
            scenario("white", "white sensor noise", aims.WHITE, aims.QUIET),
            scenario("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY, aims.NAMELESS),
            scenario("wander", "a drifting offset", aims.ORDINARY, aims.NAMELESS),
            scenario("bursts", "bursts of disturbance", aims.ORDINARY, aims.NAMELESS),
            scenario("orientations", "the sensor rests in one orientation after another", aims.WHITE, aims.QUIET),
            Scenario(
                "useless",
                "a recording that the magnetometer cannot explain",
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
