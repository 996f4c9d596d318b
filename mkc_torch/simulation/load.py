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
from mkc_torch.simulation.stepped.mujoco.stepper import load_mjcf

if TYPE_CHECKING:
    from types import ModuleType

    from mkc_torch.simulation.protocol import Simulation

_PREFIX = "_simulation_"
"""Prefix of the names of modules that are loaded from files."""


class SimulationFileError(ValueError):
    """A simulation file that cannot be used; the message states why, with the user's part of a traceback."""


def load_simulation(source: str, fitted: Sequence[str] = ()) -> Simulation:
    """Load the simulation ``FILE.py:NAME``: a class, which is called without arguments, or an instance.

    ``FILE.py`` is its only simulation.

    The file is run like a script: it can import modules from its folder and from the current folder. ``MODEL.fmu`` is
    the simulation in an FMU, whose binary is run. ``MODEL.xml`` and ``MODEL.urdf`` are models of MuJoCo.

    Args:
        source: of the simulation.
        fitted: for a model of MuJoCo, patterns of the numbers to fit; empty for those that the file gives.

    Raises:
        SimulationFileError: no such file or name, a file or class that raises, or an object that is not a simulation.
        FmuError: the FMU cannot be used.
        MjcfError: the model of MuJoCo cannot be used.
        ImportError: FMPy or MuJoCo is not installed, which an FMU or a model of MuJoCo requires.

    Example:
        >>> load_simulation("nowhere.py:Pendulum")
        Traceback (most recent call last):
        mkc_torch.simulation.load.SimulationFileError: nowhere.py: there is no such file ...
    """
    if _is_fmu(source):
        return load_fmu(source)
    if is_mujoco_model(source):
        return load_mjcf(source, fitted or None)
    if fitted:
        raise SimulationFileError(f"--fit applies only to a model of MuJoCo, unlike {source}; leave it out.")
    path, name = _parts(source)
    if not path.is_file():
        raise SimulationFileError(f"{path}: there is no such file for --simulation {source}.")
    module = _module(path)
    known = [key for key, value in vars(module).items() if _own(value, module)]
    if not name:
        if len(known) != 1:
            choices = " or ".join(f"--simulation {path}:{key}" for key in known)
            advice = f"it defines {len(known)} simulations; give {choices}" if known else "it defines no simulation"
            raise SimulationFileError(f"{path}: {advice}.")
        name = known[0]
    if not hasattr(module, name):
        raise SimulationFileError(f"{path}: it defines no `{name}`; simulations in it: {', '.join(known) or 'none'}.")
    found = getattr(module, name)
    if isinstance(found, type):
        try:
            found = found()
        except Exception as error:
            raise SimulationFileError(
                f"{path}: {name}() raised an error of its own.\n{_user_traceback(error, path)}"
            ) from None
    if not _is_simulation(found):
        raise SimulationFileError(
            f"{path}: `{name}` is not a simulation: it has no `prepare`; derive it from mkc_torch.simulation.Dynamics "
            "or Static."
        )
    return found


def base_class(source: str, file: str) -> type[Any]:
    """The class that a ``corrected.py`` corrects; its file is run.

    Args:
        source: ``FILE.py:NAME`` relative to the folder of ``file``; if the file has moved, it is searched in the folder
            of ``file``, then in the current folder.
        file: ``__file__`` of the calling file.

    Raises:
        SimulationFileError: there is no such file or class, or the file raises.

    Example:
        >>> base_class("../pendulum.py:Pendulum", "results/corrected.py")
        Traceback (most recent call last):
        mkc_torch.simulation.load.SimulationFileError: results/corrected.py: it corrects Pendulum of ...
    """
    path, name = _parts(source)
    caller = Path(file).resolve()
    places = [caller.parent / path, caller.parent / path.name, Path.cwd() / path.name]
    found = [place for place in places if place.is_file() and place.resolve() != caller]
    if not found:
        raise SimulationFileError(
            f"{file}: it corrects {name} of {path.name}, which is neither at {path.as_posix()} from there, nor next to "
            f"it, nor in the folder of the call; put {path.name} next to it."
        )
    module = _module(found[0].resolve())
    kind = getattr(module, name, None)
    if not isinstance(kind, type):
        raise SimulationFileError(f"{found[0]}: it defines no class `{name}`, which {file} corrects.")
    return kind


def file_of(kind: type) -> Path | None:
    """The file from which :func:`load_simulation` loaded a class; None for any other class.

    Example:
        >>> file_of(dict)
    """
    module = sys.modules.get(kind.__module__)
    return Path(module.__file__) if kind.__module__.startswith(_PREFIX) and module and module.__file__ else None


def raised_in(source: str, error: BaseException) -> SimulationFileError | None:
    """The error to report if the code of ``FILE.py:NAME`` raised ``error`` while simulating; None for other errors.

    Example:
        >>> raised_in("my.py:Pendulum", ValueError("raised elsewhere"))
    """
    if _is_fmu(source) or is_mujoco_model(source):
        return None
    path, name = _parts(source)
    frames = traceback.extract_tb(error.__traceback__)
    if not any(_same(frame.filename, path) for frame in frames):
        return None
    text = f"{path}: {name or 'it'} raised an error of its own.\n{_user_traceback(error, path)}"
    return SimulationFileError(f"{text}{_torch_functions(error)}")


_NOT_OF_TORCH = (
    "only one element tensors can be converted",
    "cannot access data pointer of tensor",
    "can't call numpy() on tensor",
    "call to item on a tensor",
    ".item() on a tensor",
    "cannot be converted to scalar",
)
"""Parts of the messages with which torch refuses a function of ``math`` or NumPy."""


def _torch_functions(error: BaseException) -> str:
    """The remedy for a function of ``math`` or NumPy in the equations; else empty."""
    message = str(error).lower()
    if not any(part in message for part in _NOT_OF_TORCH):
        return ""
    return (
        "\nStates, inputs and parameters are tensors: write torch.sin(x), torch.exp(x), abs(x) or torch.where(...) "
        "instead of functions of math and NumPy, float(x) and item()."
    )


def _is_fmu(source: str) -> bool:
    return source.casefold().endswith(".fmu")


def is_mujoco_model(source: str) -> bool:
    """Whether a source is a model for MuJoCo, MJCF or URDF.

    Example:
        >>> is_mujoco_model("arm.xml"), is_mujoco_model("my.py:Pendulum")
        (True, False)
    """
    return source.casefold().endswith((".xml", ".urdf", ".mjcf"))


def _parts(source: str) -> tuple[Path, str]:
    if source.endswith(".py"):
        return Path(source), ""
    file, _, name = source.rpartition(":")
    if not file.endswith(".py") or not name:
        raise SimulationFileError(
            f"{source}: this does not name a simulation; write FILE.py:NAME, as in my.py:Pendulum, MODEL.fmu or "
            "MODEL.xml."
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
        with _importing_from_folder(path), _not_itself(path):
            spec.loader.exec_module(module)
    except SimulationFileError:  # from the file of a base class
        del sys.modules[module.__name__]
        raise
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise SimulationFileError(
            f"{path}: the file raised an error of its own.\n{_user_traceback(error, path)}{_where_to_call(error)}"
        ) from None
    finally:
        _loading.pop()
    return module


def _free_name(path: Path) -> str:
    """A module name for a file, unlike those being loaded: a corrected.py may correct another corrected.py."""
    name = f"{_PREFIX}{path.stem}"
    while name in _loading:
        name += "_"
    return name


_loading: list[str] = []
"""Names of the modules being loaded, each imported by the previous module."""


def _where_to_call(error: BaseException) -> str:
    """The remedy for a missing module, such as the file of the class that a corrected.py corrects; else empty."""
    if not isinstance(error, ModuleNotFoundError) or not error.name:
        return ""
    name = error.name.partition(".")[0]
    return (
        f"\nModules are searched in the folder of the file and in the current folder: put {name}.py there, or change "
        "the folder."
    )


@contextmanager
def _importing_from_folder(path: Path) -> Iterator[None]:
    """Search modules in the file's folder first, then in the current folder, within the block."""
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
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self.path.stem or path is not None:
            return None
        folders = [folder for folder in sys.path if Path(folder).resolve() != self.path.resolve().parent]
        return PathFinder.find_spec(fullname, folders, target)


@contextmanager
def _not_itself(path: Path) -> Iterator[None]:
    """Let a corrected.py of another corrected.py import that file instead of itself, within the block."""
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


def _user_traceback(error: BaseException, path: Path) -> str:
    """The user's part of a traceback."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [k for k, frame in enumerate(frames) if _same(frame.filename, path)]
    lines = traceback.format_list(frames[own[0] :] if own else [])
    return "".join([*lines, *traceback.format_exception_only(error)]).rstrip()


def _same(filename: str, path: Path) -> bool:
    return Path(filename).resolve() == path.resolve()


def _own(value: object, module: ModuleType) -> bool:
    """Whether a value of a module is a simulation defined there."""
    kind = value if isinstance(value, type) else type(value)
    return _is_simulation(value) and kind.__module__ == module.__name__


def _is_simulation(value: object) -> bool:
    return callable(getattr(value, "prepare", None))
