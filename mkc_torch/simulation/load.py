"""A user's own simulation from a Python file."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

    from mkc_torch.simulation.protocol import Simulation

__all__ = ["SimulationFileError", "load_simulation"]


class SimulationFileError(ValueError):
    """A file of a simulation that cannot be used; the text says why."""


def load_simulation(source: str) -> Simulation:
    """The simulation that ``FILE.py:NAME`` names: a class, which is called without arguments, or an instance.

    The file is run, as ``import`` would.

    Raises:
        SimulationFileError: no such file or name, a file or class that raises, or something that is no simulation.

    Example:
        >>> load_simulation("nowhere.py:Pendulum")
        Traceback (most recent call last):
        mkc_torch.simulation.load.SimulationFileError: nowhere.py: there is no such file ...
    """
    file, _, name = source.rpartition(":")
    path = Path(file)
    if not file.endswith(".py") or not name:
        raise SimulationFileError(f"{source}: this names no simulation; write FILE.py:NAME, as in my.py:Pendulum.")
    if not path.is_file():
        raise SimulationFileError(f"{file}: there is no such file for --simulation {source}.")
    module = _module(path)
    if not hasattr(module, name):
        known = [key for key, value in vars(module).items() if _is_simulation(value) and not key.startswith("_")]
        raise SimulationFileError(f"{file}: it defines no `{name}`; simulations in it: {', '.join(known) or 'none'}.")
    found = getattr(module, name)
    if isinstance(found, type):
        try:
            found = found()
        except Exception as error:
            raise SimulationFileError(f"{file}: {name}() raised an error of its own.\n{_told(error, path)}") from None
    if not _is_simulation(found):
        raise SimulationFileError(
            f"{file}: `{name}` is no simulation, for it has no `prepare`; derive it from mkc_torch.simulation.Dynamics."
        )
    return found


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"_simulation_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[module.__name__]
        raise SimulationFileError(f"{path}: the file raised an error of its own.\n{_told(error, path)}") from None
    return module


def _told(error: Exception, path: Path) -> str:
    """The user's own part of a traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [k for k, frame in enumerate(frames) if Path(frame.filename) == path]
    lines = traceback.format_list(frames[own[0] :] if own else frames)
    return "".join([*lines, *traceback.format_exception_only(error)]).rstrip()


def _is_simulation(value: object) -> bool:
    return callable(getattr(value, "prepare", None))
