"""The proof of differential equations."""

from __future__ import annotations

from pathlib import Path

from mkc_torch.challenge.dynamics import generator
from mkc_torch.challenge.dynamics.second import ratio_to_oracle
from mkc_torch.challenge.dynamics.thresholds import THRESHOLDS
from mkc_torch.challenge.subject import Case, Subject


def dynamics() -> Subject:
    """Return the subject: recordings of seven systems, each compared with its nominal simulation."""
    return Subject(
        name="dynamics",
        cases=100,
        empty=150,
        draw=_draw,
        ratio=ratio_to_oracle,
        thresholds=THRESHOLDS,
        simulations=Path(__file__).with_name("nominal_models.py"),
    )


def simulation_class(recording: Path) -> str:
    """Return the class of simulation for a recording, by the name of its file.

    Example:
        >>> simulation_class(Path("cart_pole_00012.csv"))
        'CartPole'
    """
    return "".join(word.capitalize() for word in recording.stem.split("_")[:-1])


def _draw(seed: int, index: int, empty: bool) -> Case:
    return generator.draw(seed, index, empty=empty)
