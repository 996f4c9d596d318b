"""A kind of proof: its scenarios, how their cases are drawn, and their thresholds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from examples.blind_proof.aims import Threshold
from examples.blind_proof.draws import generator
from examples.blind_proof.key import Key
from mkc_torch.recording.recording import Recording

Ratio = Callable[[Mapping[str, Tensor], Recording, Key], float]
"""Returns the residual relative to the oracle's, given the corrected second recording, the recording and its key."""

Baseline = Callable[[Path], Mapping[str, Any] | None]
"""Returns the content of ``diagnosis.json`` by a simple method, given the recording's file; None if it fails."""


@dataclass(frozen=True)
class Case:
    """A drawn case.

    Attributes:
        recording: the recording.
        key: its key.
        second: another recording of the same sensor with the same effect; None without hidden physics.
        simulation: Python source or a model of MuJoCo that is given to the diagnosis; "" for a magnetometer.
    """

    recording: Recording
    key: Key
    second: Recording | None = None
    simulation: str = ""


Draw = Callable[[int, int, bool, int], Case]
"""Returns a case, given the seed, the index, whether physics is hidden, and the number in the recording's name."""


@dataclass(frozen=True)
class Scenario:
    """A kind of noise and inputs. ``draw`` is a top-level function, so that other processes can import it.

    Attributes:
        name: value of ``--only``.
        sentence: description.
        draw: draws a case.
        aims: thresholds for its diagnoses.
        hides: whether physics may be hidden in it.
        right, wrong: right and wrong results, for the page.
        share: recordings with hidden physics over those without, by default.
        apart: its claims are left out of the row of all scenarios.
    """

    name: str
    sentence: str
    draw: Draw
    aims: Sequence[Threshold]
    hides: bool = True
    right: str = ""
    wrong: str = ""
    share: float = 1 / 3
    apart: bool = False

    def hidden(self, empty: int, asked: int | None = None) -> int:
        """Return the number of recordings with hidden physics, given the number without; ``asked`` overrides it.

        Example:
            >>> Scenario("white", "", lambda *_: None, ()).hidden(60)
            20
        """
        if not self.hides:
            return 0
        return int(empty * self.share + 1e-9) if asked is None else asked


@dataclass(frozen=True)
class Address:
    """Address of a case. ``number`` is part of the recording's name, and reveals nothing."""

    scenario: Scenario
    index: int
    hidden: bool
    number: int


@dataclass(frozen=True)
class Proof:
    """A kind of proof.

    Attributes:
        name: value of the command's argument.
        scenarios: its scenarios, each of which is scored separately.
        empty: default number of recordings without hidden physics, in each scenario.
        totals: thresholds of all usable recordings together; empty if there is a single scenario.
        ratio: residual of a corrected second recording, relative to the oracle's; None without second recordings.
        baselines: simple methods to compare with, by name.
        settings: settings that are printed with the result.
    """

    name: str
    scenarios: Sequence[Scenario]
    empty: int
    totals: Sequence[Threshold] = ()
    ratio: Ratio | None = None
    baselines: Mapping[str, Baseline] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)

    def only(self, names: Sequence[str]) -> Proof:
        """Return the proof with the scenarios of these names, or all without names.

        Raises:
            ValueError: a name is unknown.
        """
        known = [scenario.name for scenario in self.scenarios]
        for name in names:
            if name not in known:
                raise ValueError(f"--only {name} is no scenario of {self.name}; choose from {', '.join(known)}.")
        return replace(self, scenarios=[item for item in self.scenarios if not names or item.name in names])

    def sizes(self, cases: int | None, empty: int | None) -> Iterator[tuple[Scenario, int, int]]:
        """Yield each scenario with its numbers of recordings with hidden physics and without.

        Args:
            cases: recordings with hidden physics; default: in proportion to those without.
            empty: recordings without hidden physics; default: in proportion to ``cases``, or that of the proof.
        """
        for scenario in self.scenarios:
            without = empty
            if without is None:
                without = self.empty if cases is None else round(cases / scenario.share)
            yield scenario, scenario.hidden(without, cases), without

    def addresses(self, seed: int, cases: int | None = None, empty: int | None = None) -> list[Address]:
        """Return all cases in a random order, so that names reveal nothing."""
        listed = [
            (scenario, index, hides)
            for scenario, hidden, without in self.sizes(cases, empty)
            for hides, total in ((False, without), (True, hidden))
            for index in range(total)
        ]
        if not self.totals:
            return self._by_number(seed, listed)
        order = torch.randperm(len(listed), generator=generator(seed, "worlds", "order")).tolist()
        shuffled = enumerate(listed[place] for place in order)
        return [Address(scenario, index, hides, number) for number, (scenario, index, hides) in shuffled]

    def _by_number(self, seed: int, listed: Sequence[tuple[Scenario, int, bool]]) -> list[Address]:
        """Return the cases of a single scenario, which are drawn by their number whether physics is hidden or not."""
        hidden = sum(hides for *_, hides in listed)
        order = torch.randperm(len(listed), generator=generator(seed, "order")).tolist()
        return [Address(self.scenarios[0], number, place < hidden, number) for number, place in enumerate(order)]
