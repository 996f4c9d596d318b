"""A scenario of a proof: its kind of noise and inputs, how its cases are drawn, and its thresholds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mkc_torch.challenge.key import Key
from mkc_torch.challenge.thresholds import Threshold
from mkc_torch.recording.recording import Recording


@dataclass(frozen=True)
class KeyDisturbance:
    """An unrecorded disturbance.

    Attributes:
        kind: name of the scenario with such disturbances.
        at: the state whose rate is disturbed, or ``sensor``.
        size: standard deviation in ``unit``; for white process noise the square root of its spectral density.
        over_noise: RMS of the residual that it causes in the fitted open-loop run, over the sensor's noise.
        words: further numbers by name, such as times in s.
    """

    kind: str
    at: str
    size: float
    unit: str
    over_noise: float
    words: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ScenarioKey:
    """Everything about a case that the diagnosis does not get.

    Attributes:
        scenario: name of the scenario.
        index: number of the case among those of its scenario with hidden physics, or among those without.
        key: the hidden physics, if any, and how detectable it is.
        disturbance: the disturbance, if any.
        useless: why the simulation is unusable; "" for a usable simulation.
        follows: for an unusable simulation, the largest share of an output's variation that its best fit explains.
    """

    scenario: str
    index: int
    key: Key
    disturbance: KeyDisturbance | None = None
    useless: str = ""
    follows: float | None = None

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self.key.name


@dataclass(frozen=True)
class ScenarioCase:
    """A drawn case. ``simulation`` is the Python source given to the diagnosis; "" for the simulation of the family."""

    recording: Recording
    simulation: str
    key: ScenarioKey


Draw = Callable[[int, int, bool, int], ScenarioCase]
"""Returns a case, given the seed, the index, whether physics is hidden, and the number in the recording's name."""


@dataclass(frozen=True)
class Scenario:
    """A scenario. ``draw`` is a top-level function, so that other processes can import it.

    Attributes:
        name: value of ``--only``.
        sentence: description.
        draw: draws a case.
        aims: thresholds for its diagnoses.
        hides: whether physics may be hidden in it.
        right_to_say, wrong_to_say: right and wrong results, for the page.
        half: by default the recordings with hidden physics are as many as those without; otherwise a third.
        apart: its claims are left out of the row of all scenarios.
    """

    name: str
    sentence: str
    draw: Draw
    aims: Sequence[Threshold]
    hides: bool = True
    right_to_say: str = ""
    wrong_to_say: str = ""
    half: bool = False
    apart: bool = False

    def hidden(self, empty: int, asked: int | None = None) -> int:
        """Return the number of recordings with hidden physics, given the number without; ``asked`` overrides it.

        Example:
            >>> Scenario("white", "", lambda *_: None, ()).hidden(60)
            20
        """
        if not self.hides:
            return 0
        if asked is not None:
            return asked
        return empty if self.half else empty // 3


@dataclass(frozen=True)
class Scenarios:
    """All scenarios of a family. ``totals`` are the thresholds of its usable recordings together."""

    family: str
    scenarios: Sequence[Scenario]
    totals: Sequence[Threshold]
    settings: Mapping[str, Any] = field(default_factory=dict)
