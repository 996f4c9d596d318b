"""Options and outcome of a diagnosis on the command line. This file needs no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

MAGNETOMETER = "magnetometer"
SIMULATIONS = (MAGNETOMETER,)
"""Simulations that `--simulation` accepts by name."""

# the same as in mkc_torch.diagnosis, which cannot be imported without torch; a test compares them
INPUT_HOLDS = ("held", "linear", "smooth")
LEVEL = 0.05
SURROGATES = 99
MAX_FINDINGS = 3

SUSPECTED = "coulomb_friction@speed + input_lag@command"
"""An example of ``--suspect``."""

TOGETHER = "together"
"""Folder of the results of ``--together``."""


@dataclass(frozen=True)
class Request:
    """Options for diagnosing each recording.

    A recording is compared with ``simulation``, or with the table ``simulator_output``. With neither of them, a
    recording of a magnetometer is compared with :class:`~mkc_torch.simulation.Magnetometer`.
    """

    simulation: str = MAGNETOMETER
    simulator_output: Path | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    sensor: str | None = None
    noise: Mapping[str, float] = field(default_factory=dict)
    input_hold: Mapping[str, str] = field(default_factory=dict)
    fit: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    suspect: tuple[str, ...] = ()
    level: float = LEVEL
    surrogates: int = SURROGATES
    max_findings: int = MAX_FINDINGS
    seed: int = 0
    quick: bool = False
    time_limit: float | None = None
    force: bool = False
    report: bool = True
    read_with: tuple[str, ...] = ()

    @property
    def undecided(self) -> bool:
        """Whether the recording's columns select the simulation."""
        return not self.simulation and self.simulator_output is None


@dataclass(frozen=True)
class Outcome:
    """Result for a recording, or for one run of it.

    Attributes:
        text: the summary, or the error.
        failed: whether ``text`` is an error.
        note: a sentence on a choice made for the user.
        interrupted: whether the user stopped the search.
        doubtful: whether the result must be looked at before it is used.
    """

    text: str
    failed: bool
    note: str = ""
    interrupted: bool = False
    doubtful: bool = False


def is_file_of_a_simulation(name: str) -> bool:
    """Whether ``--simulation`` names a file: ``FILE.py:CLASS``, ``FILE.py``, ``MODEL.fmu``, or a model of MuJoCo.

    Example:
        >>> is_file_of_a_simulation("my.py:Pendulum"), is_file_of_a_simulation("arm.fmu")
        (True, True)
        >>> is_file_of_a_simulation("magnetometer")
        False
    """
    return ".py:" in name or name.casefold().endswith((".py", ".fmu")) or is_model_of_mujoco(name)


def is_model_of_mujoco(name: str) -> bool:
    """Whether ``--simulation`` names a model of MuJoCo, MJCF or URDF.

    Example:
        >>> is_model_of_mujoco("arm.xml"), is_model_of_mujoco("my.py:Pendulum")
        (True, False)
    """
    return name.casefold().endswith((".xml", ".urdf", ".mjcf"))
