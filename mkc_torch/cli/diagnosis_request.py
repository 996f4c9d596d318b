"""What a diagnosis can be asked for on the command line, and its outcome; nothing here needs torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

__all__ = [
    "BETWEEN",
    "LEVEL",
    "MAGNETOMETER",
    "SIMULATIONS",
    "SURROGATES",
    "TOGETHER",
    "Outcome",
    "Request",
    "is_file_of_a_simulation",
]

MAGNETOMETER = "magnetometer"
SIMULATIONS = (MAGNETOMETER,)
"""Simulations that are known by name."""

# those of mkc_torch.diagnosis, which cannot be imported without torch; a test holds them together
BETWEEN = ("held", "linear", "smooth")
LEVEL = 0.05
SURROGATES = 99

TOGETHER = "together"
"""Folder of what is diagnosed with ``--together``."""


@dataclass(frozen=True)
class Request:
    """What is asked of each recording: to be compared with a simulation, or with what ``simulated`` holds of one.

    Where there is neither, it is compared with the magnetometer if it is of one.
    """

    simulation: str = MAGNETOMETER
    simulated: Path | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sensor: str | None = None
    noise: Mapping[str, float] = field(default_factory=dict)
    input_hold: Mapping[str, str] = field(default_factory=dict)
    level: float = LEVEL
    surrogates: int = SURROGATES
    seed: int = 0
    quick: bool = False
    time_limit: float | None = None
    force: bool = False
    report: bool = True

    @property
    def undecided(self) -> bool:
        """Whether the recording's columns decide what it is compared with."""
        return not self.simulation and self.simulated is None


@dataclass(frozen=True)
class Outcome:
    """A recording, or one experiment of it: its summary, or the sentence that says why there is none.

    ``note`` is a sentence on what was decided for the user; ``interrupted`` says that the user stopped it.
    """

    text: str
    failed: bool
    note: str = ""
    interrupted: bool = False


def is_file_of_a_simulation(name: str) -> bool:
    """Whether ``--simulation`` names a file, whose code is run: ``FILE.py:CLASS`` or ``MODEL.fmu``.

    Example:
        >>> is_file_of_a_simulation("my.py:Pendulum"), is_file_of_a_simulation("arm.fmu")
        (True, True)
        >>> is_file_of_a_simulation("magnetometer")
        False
    """
    return ".py:" in name or name.casefold().endswith(".fmu")
