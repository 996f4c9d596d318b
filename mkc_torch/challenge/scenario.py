"""One world of a proof: what noise and inputs are like in it, how its cases are drawn, and what is asked there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mkc_torch.challenge.key import Key
from mkc_torch.challenge.thresholds import Threshold
from mkc_torch.recording.recording import Recording


@dataclass(frozen=True)
class KeyDisturbance:
    """What disturbs without being recorded.

    Attributes:
        kind: name of the world that has such disturbances.
        at: the state whose rate is pushed, or the sensor.
        size: standard deviation in ``unit``; of white force noise the root of its spectral density.
        over_noise: what it leaves in the fitted free run over the sensor's noise, root mean square.
        words: its times in s and the like.
    """

    kind: str
    at: str
    size: float
    unit: str
    over_noise: float
    words: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ScenarioKey:
    """What the diagnosis of a case is not told.

    Attributes:
        world: its name.
        index: of the case among those of its world, with something hidden or with nothing.
        key: what was hidden, if anything, and how well it could be seen.
        push: what disturbs.
        useless: why the simulation is of no use; "" where it is of use.
        follows: of a useless one, the largest share of an output's variation that its best fit explains.
    """

    world: str
    index: int
    key: Key
    push: KeyDisturbance | None = None
    useless: str = ""
    follows: float | None = None

    @property
    def name(self) -> str:
        """Of the recording."""
        return self.key.name


@dataclass(frozen=True)
class ScenarioCase:
    """``simulation`` is the text of the Python file that the diagnosis is given; "" for the family's own."""

    recording: Recording
    simulation: str
    key: ScenarioKey


Draw = Callable[[int, int, bool, int], ScenarioCase]
"""From the seed, the index, whether something is hidden, and the number in the recording's name."""


@dataclass(frozen=True)
class Scenario:
    """One world. Its function is that of a module, which other processes can import.

    Attributes:
        name: as a user asks for it.
        sentence: what it is like.
        draw: a case of it.
        aims: what is asked of diagnoses there.
        hides: something may be hidden in it.
        right_to_say, wrong_to_say: what is right to say in it, and what is not.
        half: by default as many recordings have something hidden as have nothing; else a third as many.
        apart: what is claimed in it is counted apart, and not in the row of all worlds.
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
        """How many recordings have something hidden, beside so many that have nothing, unless a number is asked for.

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
    """All worlds of a family; ``totals`` are the aims of all of its useful recordings together."""

    family: str
    worlds: Sequence[Scenario]
    totals: Sequence[Threshold]
    settings: Mapping[str, Any] = field(default_factory=dict)
