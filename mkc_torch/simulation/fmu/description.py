"""What an FMU's modelDescription.xml says, as a diagnosis needs it, or why it cannot be used."""

from __future__ import annotations

import math
import re
import tempfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mkc_torch.simulation.fmu.units import unit_of
from mkc_torch.simulation.parameter import Parameter

__all__ = ["Description", "FmuError", "FmuVariable", "read_description", "the_library"]

_REAL = ("Real", "Float64")
_EXTRA = 'FMUs are read by FMPy, which is not installed; install it with `pip install "mkc-torch[fmu]"`.'


class FmuError(ValueError):
    """An FMU that cannot be used; the sentence says why, and what to do."""


@dataclass(frozen=True)
class FmuVariable:
    """A real number of the FMU.

    Attributes:
        name: as an attribute, letters, digits and _ alone.
        label: as the FMU calls it, such as "body.phi[1]".
        reference: by which the FMU knows it.
        unit: in the notation of this package.
    """

    name: str
    label: str
    reference: int
    unit: str


@dataclass(frozen=True)
class Description:
    """An FMU for model exchange, or for co-simulation alone.

    Attributes:
        path: of the file.
        version: of FMI, 2 or 3.
        name: of the model, as an identifier.
        token, identifier: by which its binary is instantiated and found.
        exchange: whether it is for model exchange: without, its tool's own solver is in it.
        states, inputs, outputs: continuous real numbers; rates: those of the states, in their order.
        parameters: the fixed and tunable ones, with what each starts from.
        events: number of its event indicators.
        derivatives: whether it gives directional derivatives.
        timeless: whether it says of all rates and outputs what they depend on, and time is not among it.
    """

    path: Path
    version: int
    name: str
    token: str
    identifier: str
    exchange: bool
    states: tuple[FmuVariable, ...]
    rates: tuple[FmuVariable, ...]
    inputs: tuple[FmuVariable, ...]
    outputs: tuple[FmuVariable, ...]
    parameters: Mapping[FmuVariable, Parameter]
    events: int
    derivatives: bool
    timeless: bool


def the_library() -> Any:
    """FMPy.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import fmpy
    except ImportError as error:
        raise ImportError(_EXTRA) from error
    return fmpy


def read_description(path: Path) -> Description:
    """What an FMU says of itself.

    Raises:
        FmuError: no file, a damaged one, one of another version of FMI, one without equations, or parameters without a
            value to start from.
        ImportError: FMPy is not installed.
    """
    told = _read(path)
    version = int(told.fmiVersion.partition(".")[0])
    kind = told.modelExchange or told.coSimulation
    if kind is None:
        raise FmuError(
            f"{path}: this FMU is for scheduled execution only; export it for model exchange, or for co-simulation."
        )
    exchange = told.modelExchange is not None
    variables = told.modelVariables
    names = _names([one for one in variables if one.type in _REAL])
    rates = [one.variable for one in told.derivatives if one.variable is not None]
    states = [one.derivative for one in rates]
    if exchange and not states:
        raise FmuError(
            f"{path}: this FMU has no continuous states, so there is no differential equation in it; let its tool "
            "simulate the recording, and give what it wrote with `--simulator-output SIM.csv`."
        )
    if any(one is None or one.dimensions or one.type not in _REAL for one in [*rates, *states]):
        raise FmuError(f"{path}: a state of this FMU is no single real number; export its states one by one.")
    inputs = [one for one in variables if one.causality == "input" and _single(one)]
    outputs = [one for one in variables if one.causality == "output" and _single(one) and not _same(one, rates)]
    return Description(
        path=path,
        version=version,
        name=re.sub(r"\W", "_", told.modelName or path.stem).lstrip("0123456789") or "Model",
        token=told.guid,
        identifier=kind.modelIdentifier,
        exchange=exchange,
        states=_quantities(states, names),
        rates=_quantities(rates, names),
        inputs=_quantities(inputs, names),
        outputs=_quantities(outputs, names),
        parameters=dict(_parameters(path, variables, names)),
        events=len(told.eventIndicators) if version == 3 else int(told.numberOfEventIndicators or 0),
        derivatives=bool(getattr(kind, "providesDirectionalDerivative", False)
                         or getattr(kind, "providesDirectionalDerivatives", False)),
        timeless=all(one.dependencies is not None and not any(by.causality == "independent" for by in one.dependencies)
                     for one in (*told.outputs, *told.derivatives)),
    )  # fmt: skip


def _read(path: Path) -> Any:
    fmpy = the_library()
    if not path.is_file():
        raise FmuError(f"{path}: there is no such file.")
    try:
        version = _version(path)
        if version not in ("2", "3"):
            raise FmuError(
                f"{path}: this FMU is of FMI {version}; FMI 2.0 and 3.0 are read. Export it as one of these, or let "
                "its tool simulate the recording, and give what it wrote with `--simulator-output SIM.csv`."
            )
        # from a folder: of an archive that it fails to read it leaves the file open
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(path) as archive:
            archive.extract("modelDescription.xml", folder)
            return fmpy.read_model_description(folder, validate=False)
    except FmuError:
        raise
    except zipfile.BadZipFile:
        raise FmuError(f"{path}: this is no FMU, or a damaged one: it is no zip archive. Export it again.") from None
    except OSError:
        raise
    except Exception as error:  # whatever the parser meets
        told = " ".join(str(error).split())
        raise FmuError(
            f"{path}: its modelDescription.xml cannot be understood ({told[:200]}). Export the FMU again."
        ) from None


def _version(path: Path) -> str:
    """The major version of FMI, or what stands in its place."""
    with zipfile.ZipFile(path) as archive:
        if "modelDescription.xml" not in archive.namelist():
            raise FmuError(
                f"{path}: this is no FMU, or a damaged one: it has no modelDescription.xml. Export it again."
            )
        with archive.open("modelDescription.xml") as file:
            head = file.read(4096).decode("utf-8", errors="replace")
    found = re.search(r"fmiVersion\s*=\s*[\"']\s*([^\"']*)", head)
    text = found[1] if found else "no version that it tells"
    return text.partition(".")[0] if text.startswith(("2.", "3.")) else text


def _single(variable: Any) -> bool:
    return variable.type in _REAL and not variable.dimensions


def _same(variable: Any, others: Iterable[Any]) -> bool:
    return any(variable is other for other in others)


def _names(variables: Sequence[Any]) -> dict[int, str]:
    """A name that can be an attribute for each variable, by its identity."""
    found: dict[int, str] = {}
    taken: set[str] = set()
    for one in variables:
        plain = re.sub(r"\W+", "_", one.name).strip("_") or "variable"
        name = plain if plain[0].isalpha() or plain[0] == "_" else f"v_{plain}"
        number, first = 2, name
        while name in taken:
            name, number = f"{first}_{number}", number + 1
        taken.add(name)
        found[id(one)] = name
    return found


def _quantities(variables: Sequence[Any], names: Mapping[int, str]) -> tuple[FmuVariable, ...]:
    return tuple(FmuVariable(names[id(one)], one.name, one.valueReference, _told(one, "unit")) for one in variables)


def _told(variable: Any, what: str) -> str:
    value = getattr(variable, what) or getattr(variable.declaredType, what, None)
    return unit_of(value) if what == "unit" else value or ""


def _parameters(
    path: Path, variables: Sequence[Any], names: Mapping[int, str]
) -> Iterable[tuple[FmuVariable, Parameter]]:
    for one in variables:
        if one.causality != "parameter" or one.variability not in ("fixed", "tunable") or not _single(one):
            continue
        if one.start in (None, ""):
            raise FmuError(
                f"{path}: its parameter {one.name} has no start, which FMI asks for; export it with a value, or make "
                "it a constant."
            )
        numbers = [_number(path, one.name, _told(one, what) or other) for what, other in
                   (("min", -math.inf), ("max", math.inf))]  # fmt: skip
        start = _number(path, one.name, one.start)
        if numbers[0] == numbers[1]:
            continue  # it cannot be another
        (quantity,) = _quantities([one], names)
        try:
            parameter = Parameter(start, numbers[0], numbers[1], quantity.unit)
        except ValueError as error:
            raise FmuError(f"{path}: its parameter {one.name} cannot be fitted: {error}") from None
        yield quantity, parameter


def _number(path: Path, name: str, text: Any) -> float:
    try:
        return float(text)
    except ValueError:
        raise FmuError(f"{path}: of its parameter {name} a value is {text!r}, which is no number.") from None
