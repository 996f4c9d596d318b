"""The checks before the search in diagnosis.json."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from mkc_torch.simulation.start_checks import StartCheck


def checks_json(check: StartCheck) -> dict[str, Any]:
    """Return a check of the simulation's parameters before the search; keys that do not apply are absent.

    Example:
        >>> checks_json(StartCheck("no output", ("bias",), "`bias` changes no output in this recording."))
        {'kind': 'no output', 'parameters': ['bias'], 'sentence': '`bias` changes no output in this recording.'}
    """
    content = {**asdict(check), "parameters": list(check.parameters), "combination": check.combination or None}
    return {name: value for name, value in content.items() if value is not None}
