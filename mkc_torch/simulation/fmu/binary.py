"""The binary of an FMU, evaluated at rows of time, states and inputs.

FMPy loads, instantiates and initialises it. The functions that are called for each row are taken from the library
directly, with addresses in place of arrays: a call through FMPy takes ten times as long as the model's equations.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from ctypes import c_double, c_int, c_size_t, c_uint, c_void_p
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mkc_torch.simulation.fmu.description import Description, FmuError, the_library
from mkc_torch.simulation.parameter import SimulationError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]

_WARNING = 1
"""Status of a warning; with a higher status there is no value."""

_FATAL = 4
"""Status of a fatal error, after which no function may be called."""

_MOST_ITERATIONS = 50
"""Largest number of iterations of the discrete equations at an event."""

_KEPT = 5
"""Number of the last messages of an FMU that errors quote."""


class Binary:
    """A loaded FMU for model exchange, in continuous-time mode.

    With event indicators, its discrete equations are solved again at each row, so that variables that switch with time,
    states and inputs are correct there. A model with memory, such as a hysteresis, or with jumps of its states cannot
    be evaluated at moments in any order and is refused.

    Args:
        description: description of the FMU.

    Raises:
        FmuError: no binary for this platform, or one that cannot be loaded.
    """

    def __init__(self, description: Description) -> None:
        self.description = description
        self.messages: list[str] = []
        self.folder = _extracted(description)
        self.model = self._loaded()
        self._parameters: tuple[float, ...] | None = None
        self._begun = False
        self.timed = True
        self._prepare_functions()

    # evaluation

    def begin(self, parameters: Sequence[float]) -> bool:
        """Initialise the FMU with these parameters; False if it fails."""
        values = tuple(parameters)
        if values == self._parameters:
            return True
        model, self._parameters = self.model, None
        try:
            if self._begun:
                model.reset()
            self._begun = True
            if self.description.version == 2:
                model.setupExperiment(startTime=0.0)
            references = [variable.reference for variable in self.description.parameters]
            if references:
                (model.setReal if self.description.version == 2 else model.setFloat64)(references, list(values))
            model.enterInitializationMode()
            model.exitInitializationMode()
            self._settle_first()
            model.enterContinuousTimeMode()
        except Exception as error:  # of FMPy: an Exception for FMI 3, an error with a status for FMI 2
            if getattr(error, "status", 0) >= _FATAL:
                raise self._failed("could not be initialised") from None
            return False
        self._parameters = values
        return True

    def first_states(self) -> Array:
        """The initial states, (n,)."""
        states = np.zeros(len(self.description.states))
        if self._get_states(self.model.component, states.ctypes.data, len(states)) > _WARNING:
            raise SimulationError("The FMU does not return its states; export it again.")
        return states

    def values(self, outputs: bool, time: Array, states: Array, inputs: Array) -> Array:
        """The rates of the states, or the outputs, (S, k); NaN where the FMU fails.

        Args:
            outputs: return outputs instead of rates.
            time: (S,), in s.
            states: (S, n).
            inputs: (S, m).
        """
        count = len(self.description.outputs if outputs else self.description.rates)
        found = np.empty((len(time), count))
        set_time, set_states, set_inputs, component = self._set_time, self._set_states, self._set_reals, self._component
        n, m, references = states.shape[1], inputs.shape[1], self._input_references
        rows = zip(time.tolist(), _addresses(states), _addresses(inputs), _addresses(found), strict=True)
        bad, settle = 0, self._settle if self.description.events else None
        timed = self.timed
        get, wanted = self._get_rates, self._output_references
        simple = m > 0 and not outputs and not timed and settle is None
        for t, x, u, f in rows:
            if simple:  # the usual case
                status = set_states(component, x, n) | set_inputs(component, references, m, u, m) | get(component, f, n)
            else:
                status = set_states(component, x, n)
                if timed:
                    status |= set_time(component, t)
                if m:
                    status |= set_inputs(component, references, m, u, m)
                if settle is not None:
                    status |= settle()
                if outputs:
                    status |= self._get_reals(component, wanted, count, f, count)
                else:
                    status |= get(component, f, n)
            if status > _WARNING:
                bad = max(bad, status)
                found[(f - found.ctypes.data) // (8 * count)] = np.nan
        self._recover(bad)
        return found

    def slopes(self, outputs: bool, time: Array, states: Array, inputs: Array, by: Sequence[int]) -> Array:
        """Derivatives of rates or outputs by the variables of these references, (S, len(by), k)."""
        wanted = self._output_references if outputs else self._rate_references
        count = len(self.description.outputs if outputs else self.description.rates)
        found = np.empty((len(time), len(by), count))
        known = (c_uint * len(by))(*by)
        unit = c_double(1.0)
        seed = ctypes.addressof(unit)
        first = ctypes.addressof(known)
        columns = range(first, first + 4 * len(by), 4)
        set_time, set_states, set_inputs, component = self._set_time, self._set_states, self._set_reals, self._component
        n, m, references = states.shape[1], inputs.shape[1], self._input_references
        rows = zip(time.tolist(), _addresses(states), _addresses(inputs), _addresses(found), strict=True)
        bad, settle = 0, self._settle if self.description.events else None
        timed = self.timed
        directional, three = self._directional, self.description.version == 3
        width = 8 * count
        for t, x, u, f in rows:
            status = set_states(component, x, n)
            if timed:
                status |= set_time(component, t)
            if m:
                status |= set_inputs(component, references, m, u, m)
            if settle is not None:
                status |= settle()
            to = f
            for column in columns:
                if three:
                    status |= directional(component, wanted, count, column, 1, seed, 1, to, count)
                else:
                    status |= directional(component, wanted, count, column, 1, seed, to)
                to += width
            if status > _WARNING:
                bad = max(bad, status)
                found[(f - found.ctypes.data) // (width * len(by))] = np.nan
        self._recover(bad)
        return found

    # loading

    def _loaded(self) -> Any:
        description, fmpy = self.description, the_library()
        from fmpy import fmi2, fmi3

        binaries = self.folder / "binaries"
        library = binaries / _platform(description.version) / f"{description.identifier}{fmpy.sharedLibraryExtension}"
        if not library.is_file():
            raise FmuError(f"{description.path}: {_no_binary(self.folder, _platform(description.version))}")
        kind = fmi2.FMU2Model if description.version == 2 else fmi3.FMU3Model
        try:
            model = kind(
                guid=description.token,
                modelIdentifier=description.identifier,
                unzipDirectory=str(self.folder),
                instanceName=description.name,
                libraryPath=str(library),
            )
            if description.version == 2:
                model.instantiate(callbacks=self._callbacks(fmi2))
            else:
                model.instantiate(logMessage=self._log_of_3)
        except Exception as error:  # of FMPy, or of loading the binary
            reason = " ".join(str(error).split())
            raise FmuError(
                f"{description.path}: its binary cannot be used ({reason}{self._quoted_messages()}). Export it again."
            ) from None
        return model

    def _callbacks(self, fmi2: Any) -> Any:
        found = fmi2.fmi2CallbackFunctions()
        default = fmi2.defaultCallbacks
        found.logger = fmi2.fmi2CallbackLoggerTYPE(self._log_of_2)
        found.allocateMemory, found.freeMemory = default.allocateMemory, default.freeMemory
        return found

    def _log_of_2(self, _environment: Any, _name: bytes, _status: int, _category: bytes, message: bytes) -> None:
        self._log(message)

    def _log_of_3(self, _environment: Any, _status: int, _category: bytes, message: bytes) -> None:
        self._log(message)

    def _log(self, message: bytes | None) -> None:
        self.messages = [*self.messages[1 - _KEPT :], (message or b"").decode("utf-8", errors="replace").strip()]

    def _quoted_messages(self) -> str:
        return f"; its messages: {'; '.join(self.messages)}" if self.messages else ""

    def _failed(self, what: str) -> SimulationError:
        return SimulationError(f"{self.description.path}: the FMU {what}{self._quoted_messages()}.")

    def _recover(self, status: int) -> None:
        """Reset the FMU after an error; no other call is allowed then."""
        if status >= _FATAL:
            raise self._failed("failed with a fatal error")
        if status > _WARNING + 1:
            parameters, self._parameters = self._parameters, None
            self.begin(parameters or ())

    def _prepare_functions(self) -> None:
        description, library = self.description, self.model.dll
        address, two = c_void_p, description.version == 2

        def function(name: str, *types: Any) -> Any:
            found = library[f"fmi{description.version}{name}"]
            found.argtypes, found.restype = types, c_int
            return found

        component: Any = self.model.component
        self._component: int = getattr(component, "value", component)
        self._set_time = function("SetTime", address, c_double)
        self._set_states = function("SetContinuousStates", address, address, c_size_t)
        self._get_states = function("GetContinuousStates", address, address, c_size_t)
        self._get_rates = function(
            "GetDerivatives" if two else "GetContinuousStateDerivatives", address, address, c_size_t
        )
        real = "Real" if two else "Float64"
        # FMI 3.0 takes a second count, which a function of FMI 2.0 ignores
        self._set_reals = function(f"Set{real}", address, address, c_size_t, address, c_size_t)
        self._get_reals = function(f"Get{real}", address, address, c_size_t, address, c_size_t)
        if description.derivatives:
            ends = (address, address) if two else (address, c_size_t, address, c_size_t)
            self._directional = function(
                "GetDirectionalDerivative", address, address, c_size_t, address, c_size_t, *ends
            )
        self._enter_event = function("EnterEventMode", address)
        self._enter_continuous = function("EnterContinuousTimeMode", address)
        self._update = _updater(function, self._component, two)
        self._kept = [_references(group) for group in (description.inputs, description.outputs, description.rates)]
        self._input_references, self._output_references, self._rate_references = map(ctypes.addressof, self._kept)

    # events

    def _settle_first(self) -> None:
        for _ in range(_MOST_ITERATIONS):
            status, again, _, _ = self._update()
            if status > _WARNING or not again:
                return

    def _settle(self) -> int:
        """Solve the discrete equations at the current moment; returns the status."""
        status: int = self._enter_event(self._component)
        for _ in range(_MOST_ITERATIONS):
            more, again, jumped, ended = self._update()
            status |= more
            if jumped or ended:
                raise self._failed(
                    f"{'resets its states' if jumped else 'ends its simulation'} at an event, which a diagnosis cannot "
                    "follow: let its tool simulate the recording, and give its output with `--simulator-output "
                    "SIM.csv`"
                )
            if not again:
                break
        settled: int = status | self._enter_continuous(self._component)
        return settled


def _updater(function: Callable[..., Any], component: int, two: bool) -> Callable[[], tuple[int, bool, bool, bool]]:
    """A function that returns the status, and whether to call it again, states have jumped, or the simulation ends."""
    if two:
        from fmpy.fmi2 import fmi2EventInfo

        info = fmi2EventInfo()
        update = function("NewDiscreteStates", c_void_p, c_void_p)
        place = ctypes.addressof(info)

        def updated_2() -> tuple[int, bool, bool, bool]:
            status = update(component, place)
            return (
                status,
                bool(info.newDiscreteStatesNeeded),
                bool(info.valuesOfContinuousStatesChanged),
                bool(info.terminateSimulation),
            )

        return updated_2
    flags = (ctypes.c_bool * 5)()
    following = c_double()
    update = function("UpdateDiscreteStates", *[c_void_p] * 7)
    first = ctypes.addressof(flags)
    places = [*range(first, first + 5), ctypes.addressof(following)]

    def updated_3() -> tuple[int, bool, bool, bool]:
        status = update(component, *places)
        again, ended, _, jumped, _ = flags
        return status, again, jumped, ended

    return updated_3


def _references(quantities: Sequence[Any]) -> Any:
    return (c_uint * max(1, len(quantities)))(*(variable.reference for variable in quantities))


def _addresses(rows: Array) -> range:
    """The address of each row of a contiguous table."""
    start, step = rows.ctypes.data, 8 * max(1, rows[0].size) if len(rows) else 8
    return range(start, start + step * len(rows), step)


def _platform(version: int) -> str:
    fmpy = the_library()
    return str(fmpy.platform if version == 2 else fmpy.platform_tuple)


def _no_binary(folder: Path, platform: str) -> str:
    """The available binaries in place of the missing binary for this platform, and the remedy."""
    binaries = folder / "binaries"
    platforms = sorted(path.name for path in binaries.iterdir() if path.is_dir()) if binaries.is_dir() else []
    available = f"it has binaries for {', '.join(platforms)} only" if platforms else "it has no binaries"
    if (folder / "sources").is_dir():
        return (
            f"{available}, and none for {platform}, but it contains sources; compile them with `fmpy compile "
            "MODEL.fmu`."
        )
    return f"{available}, and none for {platform}; export it for {platform}, or with its sources."


def _extracted(description: Description) -> Path:
    """A temporary folder with the FMU's files, which is removed when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix="mkc_fmu_"))
    atexit.register(_remove, folder, os.getpid())
    try:
        the_library().extract(str(description.path), str(folder))
    except Exception as error:  # of FMPy or zipfile, over a damaged archive
        reason = " ".join(str(error).split())
        raise FmuError(f"{description.path}: the FMU cannot be unpacked ({reason}). Export it again.") from None
    return folder


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
