"""A user's own simulation from a Python file."""

from __future__ import annotations

import importlib.util
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkc_torch.simulation.fmu import load_fmu

if TYPE_CHECKING:
    from types import ModuleType

    from mkc_torch.simulation.protocol import Simulation

__all__ = ["SimulationFileError", "base_class", "file_of", "load_simulation", "raised_in"]

_PREFIX = "_simulation_"
"""Of the modules that files are loaded as."""


class SimulationFileError(ValueError):
    """A file of a simulation that cannot be used; the text says why, with the lines in which its code raised."""


def load_simulation(source: str) -> Simulation:
    """The simulation that ``FILE.py:NAME`` names: a class, which is called without arguments, or an instance.

    The file is run, as a script would be: it can import modules beside it, and those of the folder it is called in.
    ``MODEL.fmu`` is the simulation in an FMU, whose binary is run.

    Raises:
        SimulationFileError: no such file or name, a file or class that raises, or something that is no simulation.
        FmuError: an FMU that cannot be used.
        ImportError: of an FMU, FMPy is not installed.

    Example:
        >>> load_simulation("nowhere.py:Pendulum")
        Traceback (most recent call last):
        mkc_torch.simulation.load.SimulationFileError: nowhere.py: there is no such file ...
    """
    if _is_fmu(source):
        return load_fmu(source)
    path, name = _parts(source)
    if not path.is_file():
        raise SimulationFileError(f"{path}: there is no such file for --simulation {source}.")
    module = _module(path)
    if not hasattr(module, name):
        known = [key for key, value in vars(module).items() if _own(value, module)]
        raise SimulationFileError(f"{path}: it defines no `{name}`; simulations in it: {', '.join(known) or 'none'}.")
    found = getattr(module, name)
    if isinstance(found, type):
        try:
            found = found()
        except Exception as error:
            raise SimulationFileError(f"{path}: {name}() raised an error of its own.\n{_told(error, path)}") from None
    if not _is_simulation(found):
        raise SimulationFileError(
            f"{path}: `{name}` is no simulation, for it has no `prepare`; derive it from mkc_torch.simulation.Dynamics "
            "or Static."
        )
    return found


def base_class(source: str, file: str) -> type[Any]:
    """The class that a ``corrected.py`` corrects, from the file it was defined in, which is run.

    Args:
        source: ``FILE.py:NAME``, by the way from the folder of ``file``. Where that has been moved the file is sought
            beside ``file``, then in the folder of the call.
        file: the one that asks, its ``__file__``.

    Raises:
        SimulationFileError: there is no such file or class, or the file raises.

    Example:
        >>> base_class("../pendulum.py:Pendulum", "results/corrected.py")
        Traceback (most recent call last):
        mkc_torch.simulation.load.SimulationFileError: results/corrected.py: it corrects Pendulum of ...
    """
    path, name = _parts(source)
    asking = Path(file).resolve()
    places = [asking.parent / path, asking.parent / path.name, Path.cwd() / path.name]
    there = [one for one in places if one.is_file() and one.resolve() != asking]
    if not there:
        raise SimulationFileError(
            f"{file}: it corrects {name} of {path.name}, which is neither at {path.as_posix()} from there, nor beside "
            f"it, nor in the folder of the call; put {path.name} beside it."
        )
    module = _module(there[0].resolve())
    kind = getattr(module, name, None)
    if not isinstance(kind, type):
        raise SimulationFileError(f"{there[0]}: it defines no class `{name}`, which {file} corrects.")
    return kind


def file_of(kind: type) -> Path | None:
    """The file that a class was loaded from by :func:`load_simulation`; None for any other class.

    Example:
        >>> file_of(dict)
    """
    module = sys.modules.get(kind.__module__)
    return Path(module.__file__) if kind.__module__.startswith(_PREFIX) and module and module.__file__ else None


def raised_in(source: str, error: BaseException) -> SimulationFileError | None:
    """What to tell of an error that the code of ``FILE.py:NAME`` raised while it simulated; None for another's error.

    Example:
        >>> raised_in("my.py:Pendulum", ValueError("of somebody else's"))
    """
    if _is_fmu(source):
        return None
    path, name = _parts(source)
    frames = traceback.extract_tb(error.__traceback__)
    if not any(_same(frame.filename, path) for frame in frames):
        return None
    return SimulationFileError(f"{path}: {name} raised an error of its own.\n{_told(error, path)}")


def _is_fmu(source: str) -> bool:
    return source.casefold().endswith(".fmu")


def _parts(source: str) -> tuple[Path, str]:
    file, _, name = source.rpartition(":")
    if not file.endswith(".py") or not name:
        raise SimulationFileError(
            f"{source}: this names no simulation; write FILE.py:NAME, as in my.py:Pendulum, or MODEL.fmu."
        )
    return Path(file), name


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(_free_name(path), path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    _loading.append(module.__name__)
    try:
        with _beside(path), _not_itself(path):
            spec.loader.exec_module(module)
    except SimulationFileError:  # of the file of a base class
        del sys.modules[module.__name__]
        raise
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise SimulationFileError(
            f"{path}: the file raised an error of its own.\n{_told(error, path)}{_where_to_call(error)}"
        ) from None
    finally:
        _loading.pop()
    return module


def _free_name(path: Path) -> str:
    """A name for a file's module, not that of one that asks for it: a corrected.py may correct another corrected.py."""
    name = f"{_PREFIX}{path.stem}"
    while name in _loading:
        name += "_"
    return name


_loading: list[str] = []
"""Modules that are being loaded, each for the one before it."""


def _where_to_call(error: BaseException) -> str:
    """Advice where a module is missing, such as the one with the class that a corrected.py corrects."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return ""
    name = error.name.partition(".")[0]
    return (
        f"\nModules are sought beside the file and in the folder of the call: put {name}.py there, or call from there."
    )


@contextmanager
def _beside(path: Path) -> Iterator[None]:
    """The file's folder is searched for modules first, then the one that the command was given in."""
    folders = [str(path.resolve().parent), str(Path.cwd())]
    sys.path[:0] = folders
    try:
        yield
    finally:
        for folder in folders:
            sys.path.remove(folder)


class _Others(MetaPathFinder):
    """Finds a module of the same name as a file, but never that file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def find_spec(
        self,
        fullname: str,
        path: Sequence[str] | None,
        target: ModuleType | None = None,
    ) -> ModuleSpec | None:
        if fullname != self.path.stem or path is not None:
            return None
        folders = [folder for folder in sys.path if Path(folder).resolve() != self.path.resolve().parent]
        return PathFinder.find_spec(fullname, folders, target)


@contextmanager
def _not_itself(path: Path) -> Iterator[None]:
    """A corrected.py that was made of another corrected.py imports the other one."""
    known = sys.modules.get(path.stem)
    itself = known is not None and _same(getattr(known, "__file__", None) or "", path)
    if itself:
        del sys.modules[path.stem]
    finder = _Others(path)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


def _told(error: BaseException, path: Path) -> str:
    """The user's own part of a traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [k for k, frame in enumerate(frames) if _same(frame.filename, path)]
    lines = traceback.format_list(frames[own[0] :] if own else [])
    return "".join([*lines, *traceback.format_exception_only(error)]).rstrip()


def _same(filename: str, path: Path) -> bool:
    return Path(filename).resolve() == path.resolve()


def _own(value: object, module: ModuleType) -> bool:
    """Whether a value of a module is a simulation that was defined there."""
    kind = value if isinstance(value, type) else type(value)
    return _is_simulation(value) and kind.__module__ == module.__name__


def _is_simulation(value: object) -> bool:
    return callable(getattr(value, "prepare", None))
