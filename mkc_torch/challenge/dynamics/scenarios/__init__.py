"""Scenarios of differential equations: process noise, held inputs, far starting values, and wrong simulations."""

from __future__ import annotations

from functools import partial

from mkc_torch.challenge import aims
from mkc_torch.challenge.dynamics.scenarios.disturbances import LASTING_ALONE, LASTING_RUNS
from mkc_torch.challenge.dynamics.scenarios.draw import SLOW_SENSOR, draw, draw_useless
from mkc_torch.challenge.scenario import Scenario, Scenarios
from mkc_torch.challenge.thresholds import Threshold

__all__ = ["dynamics_scenarios"]


def dynamics_scenarios() -> Scenarios:
    """Return twelve scenarios of the systems with states. Noise is white except in ``coloured`` and ``slow_sensor``.

    Example:
        >>> [scenario.name for scenario in dynamics_scenarios().scenarios][:3]
        ['white', 'coloured', 'pushed_white']
    """
    return Scenarios(
        "dynamics",
        (
            _scenario("white", "white sensor noise", aims.WHITE, aims.QUIET),
            _scenario("coloured", "sensor noise correlated from sample to sample", aims.ORDINARY, aims.NAMELESS),
            _scenario("pushed_white", "white process noise in one state", aims.DISTURBED_STATE, aims.DISTURBED),
            _scenario("pushed_slowly", "slow process noise in one state", aims.DISTURBED_STATE, aims.DISTURBED),
            _scenario("gusts", "gusts in the rate of one state", aims.DISTURBED_STATE, aims.DISTURBED),
            _scenario(
                "held", "inputs held between samples; the simulation assumes linear ones", aims.WHITE, aims.QUIET
            ),
            _scenario(
                "far_starts", "starting values of the parameters ten times too large or small", aims.WHITE, aims.QUIET
            ),
            _scenario("runs", "three to five runs", aims.WHITE, aims.QUIET),
            Scenario(
                SLOW_SENSOR,
                "white noise, and a drift of the sensor with a correlation time of 1 to 10 % of a run",
                partial(draw, SLOW_SENSOR),
                aims.ORDINARY,
                right_to_say="nothing hidden: no name, and the drift attributed to the sensor; else the hidden physics",
                wrong_to_say=aims.CLAIMED,
                half=True,
            ),
            Scenario(
                LASTING_ALONE,
                "one run; process noise in one state with a correlation time of 0.3 to 1 of the run",
                partial(draw, LASTING_ALONE),
                aims.LASTING,
                right_to_say="undecided: unexplained, or a name with alternatives; a second run would decide",
                wrong_to_say="a single name other than the hidden one; unfit",
                half=True,
                apart=True,
            ),
            Scenario(
                LASTING_RUNS,
                "four runs; process noise in one state with a correlation time of 0.3 to 1 of a run, new in each",
                partial(draw, LASTING_RUNS),
                aims.DISTURBED_STATE,
                right_to_say=aims.DISTURBED,
                wrong_to_say=aims.CLAIMED,
                half=True,
            ),
            Scenario(
                "useless",
                "an unusable simulation, whose best fit explains at most a quarter of any output",
                draw_useless,
                aims.USELESS,
                hides=False,
                right_to_say="unfit",
                wrong_to_say="adequate",
            ),
        ),
        aims.TOTALS,
    )


def _scenario(name: str, sentence: str, asked: tuple[Threshold, ...], right: str) -> Scenario:
    return Scenario(name, sentence, partial(draw, name), asked, right_to_say=right, wrong_to_say=aims.CLAIMED)
