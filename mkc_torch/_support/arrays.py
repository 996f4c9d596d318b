"""Conversion of arrays and data frames to tensors, without importing the libraries that made them.

An array is an object with ``__array__`` or ``to_numpy``; a data frame is an array with ``columns``, of pandas, polars
or a compatible library.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from mkc_torch._support.arguments import refuse_no_tensor


class ArrayLike(Protocol):
    """A NumPy array, a pandas or polars DataFrame or Series, or another object that converts to a NumPy array."""

    def __array__(self) -> np.ndarray: ...


Data: TypeAlias = Tensor | ArrayLike

_NUMBERS = "biuf"
"""NumPy dtype kinds of real numbers and booleans."""

_TIMES = "mM"
"""NumPy dtype kinds of times."""

_TEXT = "UST"
"""NumPy dtype kinds of text."""


def is_array(value: object) -> bool:
    """Whether a value is an array or a data frame but not a tensor."""
    return not isinstance(value, Tensor) and (hasattr(value, "__array__") or hasattr(value, "to_numpy"))


def is_frame(value: object) -> bool:
    """Whether a value is a data frame."""
    # a lazy frame has no to_numpy, and so its columns are not computed
    return hasattr(value, "to_numpy") and hasattr(value, "columns")


def column_names(value: object) -> tuple[str, ...] | None:
    """The names of a data frame's columns if all are strings, else None.

    Example:
        >>> column_names(np.ones((2, 2))) is None
        True
    """
    if not is_frame(value):
        return None
    names = tuple(value.columns)  # type: ignore[attr-defined]
    return tuple(map(str, names)) if names and all(isinstance(name, str) for name in names) else None


def as_tensor(name: str, value: Data, *, like: Tensor | None = None, missing: float | None = None) -> Tensor:
    """A tensor unchanged, or an array or a data frame as a tensor on the CPU.

    float32 stays float32; other real numbers and booleans become float64. A frame becomes (N, columns), float32 if all
    its columns are. The tensor shares the memory of an array that needs no conversion.

    Args:
        name: name of the argument.
        value: a tensor, a NumPy array, a DataFrame or Series of pandas or polars, or a compatible object.
        like: tensor whose dtype and device an array gets instead.
        missing: replacement of missing values (null, NA) of a frame; None refuses them. NaN is not missing.

    Raises:
        TypeError: not an array, or an array of text, times, complex numbers or other objects; names a frame's column.
        ValueError: values are missing.

    Example:
        >>> as_tensor("X", np.arange(3))
        tensor([0., 1., 2.], dtype=torch.float64)
    """
    if isinstance(value, Tensor):
        return value
    if like is not None:
        return as_tensor(name, value, missing=missing).to(like)
    if is_frame(value):
        columns = [numbers_of(_where(name, label), series, missing) for label, series in series_of(value)]
        shape = (len(value), 0)  # type: ignore[arg-type]
        return torch.from_numpy(np.stack(columns, axis=-1) if columns else np.empty(shape))
    if not is_array(value):
        refuse_no_tensor(name, value, "a tensor or an array")
    # a Series has the name of its column
    label = getattr(value, "name", None) if hasattr(value, "to_numpy") else None
    return torch.from_numpy(numbers_of(_where(name, label), value, missing))


def as_tensors(**values: Data) -> tuple[Tensor, ...]:
    """Arrays and data frames as tensors of a common dtype and device; tensors are unchanged.

    Arrays get the dtype and device of the first floating-point tensor among the values. Without such a tensor they
    become float32 if all of them are float32, else float64.

    Args:
        **values: the values by the names of the arguments.

    Raises:
        TypeError, ValueError: see :func:`as_tensor`.

    Example:
        >>> X, Y = as_tensors(X=torch.ones(2, 1), Y=np.ones(2))
        >>> Y.dtype
        torch.float32
    """
    made = {name: as_tensor(name, value) for name, value in values.items()}
    arrays = [name for name, value in values.items() if not isinstance(value, Tensor)]
    if arrays:
        given = [value for value in values.values() if isinstance(value, Tensor) and value.is_floating_point()]
        like = given[0] if given else max((made[name] for name in arrays), key=lambda tensor: tensor.element_size())
        made |= {name: made[name].to(like) for name in arrays}
    return tuple(made.values())


def refuse_other_columns(name: str, value: object, names: tuple[str, ...] | None) -> None:
    """Refuse a data frame whose columns differ from those of the fit, or their order does.

    Args:
        name: name of the argument.
        value: value of the argument; it passes if it has no named columns.
        names: names of the columns of the fit; None if they had no names.

    Raises:
        ValueError: they differ.
    """
    found = column_names(value)
    if names is None or found is None or found == names:
        return
    advice = "give it those of the fit"
    if set(names) <= set(found):
        advice = f"take those of the fit in their order, {name}[{list(names)!r}]"
    raise ValueError(
        f"Expected argument `{name}` with the columns of the fit, {_listed(names)}, but got {_listed(found)}; {advice}."
    )


def series_of(frame: Any) -> Iterator[tuple[Any, Any]]:
    """The columns of a data frame, each with its name; names may repeat."""
    if hasattr(frame, "get_columns"):
        yield from ((series.name, series) for series in frame.get_columns())
    elif hasattr(frame, "items"):
        yield from frame.items()
    else:
        yield from ((name, frame[name]) for name in frame.columns)


def numbers_of(where: str, value: Any, missing: float | None = None) -> np.ndarray:
    """A float32 or float64 array whose memory torch can share, from an array or a column of a frame.

    Args:
        where: its place, for errors, such as "argument `X`".
        value: an object that converts to a NumPy array.
        missing: replacement of missing values; None refuses them.

    Raises:
        TypeError: not real numbers.
        ValueError: values are missing.
    """
    array = np.asarray(value.to_numpy() if hasattr(value, "to_numpy") else value)
    gone = absent(value)
    if gone is not None and gone.any():
        array = _filled(where, array, gone, missing)
    elif array.dtype.kind not in _NUMBERS:
        raise TypeError(f"Expected {where} to hold real numbers but got {_describe_content(array)}.")
    dtype = np.float32 if array.dtype == np.float32 else np.float64
    # torch cannot share read-only memory, negative strides or swapped bytes
    return np.require(array.astype(dtype, copy=False), requirements=["C", "W"])


def _filled(where: str, array: np.ndarray, gone: np.ndarray, missing: float | None) -> np.ndarray:
    """A column in float64 with ``missing`` in place of its missing values."""
    present = array[~gone]
    if present.dtype.kind not in _NUMBERS and not _all_numbers(present):
        raise TypeError(f"Expected {where} to hold real numbers but got {_describe_content(present)}.")
    if missing is None:
        raise ValueError(
            f"Expected {where} to have a value everywhere but got {int(gone.sum())} missing of {gone.size}; drop "
            "those rows, or fill them."
        )
    filled = np.full(array.shape, missing, dtype=np.float64)
    filled[~gone] = present.astype(np.float64)
    return filled


def absent(value: Any) -> np.ndarray | None:
    """The mask of a column's missing values; None if its type has no missing values."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.getmaskarray(value)
    if isinstance(getattr(value, "dtype", None), np.dtype):
        return None
    for method in ("is_null", "isna"):
        if hasattr(value, method):
            return np.asarray(getattr(value, method)(), dtype=bool)
    return None


def _where(name: str, label: object) -> str:
    return f"argument `{name}`" if label in (None, "") else f"column `{label}` of argument `{name}`"


def _all_numbers(array: np.ndarray) -> bool:
    return all(isinstance(item, (bool, int, float, np.number, np.bool_)) for item in array.flat)


def _describe_content(array: np.ndarray) -> str:
    """The content of an array that does not hold real numbers, and the remedy, for error messages."""
    kind = array.dtype.kind
    if kind == "c":
        return f"{array.dtype}; pass its real part"
    first = next((item for item in array.flat if item is not None), None)
    if kind in _TIMES or hasattr(first, "tzinfo"):
        return "times; turn them into numbers, such as seconds since the first"
    if kind in _TEXT or isinstance(first, str):
        return f"text, {str(first)[:40]!r} say; encode it as numbers, or leave it out"
    if kind == "O" and first is not None and _all_numbers(array):
        return "numbers as Python objects; convert them, .astype(float)"
    return f"{array.dtype} of {type(first).__name__}; convert it to numbers, or leave it out"


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(f"`{name}`" for name in names)
