"""Worlds of differential equations: pushes, inputs as controllers send them, starts far off, and misfits."""

from __future__ import annotations

from functools import partial

from mkc_torch.challenge import aims
from mkc_torch.challenge.dynamics.scenarios.disturbances import LASTING_ALONE, LASTING_RUNS
from mkc_torch.challenge.dynamics.scenarios.draw import SLOW_SENSOR, draw, draw_useless
from mkc_torch.challenge.scenario import Scenario, Scenarios
from mkc_torch.challenge.thresholds import Threshold

__all__ = ["dynamics_worlds"]


def dynamics_worlds() -> Scenarios:
    """The systems with states, each in twelve worlds; noise is white in all but ``coloured`` and ``slow_sensor``.

    Example:
        >>> [world.name for world in dynamics_worlds().worlds][:3]
        ['white', 'coloured', 'pushed_white']
    """
    return Scenarios(
        "dynamics",
        (
            _world("white", "white sensor noise", aims.WHITE, aims.QUIET),
            _world("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY, aims.NAMELESS),
            _world("pushed_white", "white force noise in the rate of one state", aims.PUSHED, aims.DISTURBED),
            _world("pushed_slowly", "a slow push of the rate of one state", aims.PUSHED, aims.DISTURBED),
            _world("gusts", "pushes of the rate of one state in some stretches", aims.PUSHED, aims.DISTURBED),
            _world(
                "held", "inputs held between samples, which the simulation takes to be linear", aims.WHITE, aims.QUIET
            ),
            _world("far_starts", "the simulation's parameters begin ten times off", aims.WHITE, aims.QUIET),
            _world("runs", "three to five runs", aims.WHITE, aims.QUIET),
            Scenario(
                SLOW_SENSOR,
                "an error of the sensor that lasts 1 to 10 % of a run, beside white noise",
                partial(draw, SLOW_SENSOR),
                aims.ORDINARY,
                right_to_say="no name where nothing is hidden, but a slow error told as that; else what is hidden",
                wrong_to_say=aims.CLAIMED,
                half=True,
            ),
            Scenario(
                LASTING_ALONE,
                "a push of the rate of one state that lasts .3 to 1 of the recording, which is one run",
                partial(draw, LASTING_ALONE),
                aims.LASTING,
                right_to_say="unexplained, or a name with alternatives: it cannot be told, a second run would tell",
                wrong_to_say="a name alone, unless it is what is hidden; unfit",
                half=True,
                apart=True,
            ),
            Scenario(
                LASTING_RUNS,
                "a push of the rate of one state that lasts .3 to 1 of a run, and is another in each of four runs",
                partial(draw, LASTING_RUNS),
                aims.PUSHED,
                right_to_say=aims.DISTURBED,
                wrong_to_say=aims.CLAIMED,
                half=True,
            ),
            Scenario(
                "useless",
                "the simulation cannot follow the recording: its best fit explains at most a quarter of any output",
                draw_useless,
                aims.USELESS,
                hides=False,
                right_to_say="unfit",
                wrong_to_say="adequate",
            ),
        ),
        aims.TOTALS,
    )


def _world(name: str, sentence: str, asked: tuple[Threshold, ...], right: str) -> Scenario:
    return Scenario(name, sentence, partial(draw, name), asked, right_to_say=right, wrong_to_say=aims.CLAIMED)
