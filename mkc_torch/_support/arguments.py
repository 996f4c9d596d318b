"""Checks of arguments; an error states what was expected, what it got, and the remedy.

Types and shapes are always checked. Values of tensors are checked only on the CPU, where this does not wait for an
accelerator, and not in compiled code or under ``vmap``, where a tensor has no single value. There, values out of range
enter the formulas unchecked, and a NaN gives NaN.
"""

from __future__ import annotations

import math
import numbers
import reprlib
from itertools import zip_longest
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


DIVERGED = "The network has diverged, or its inputs hold NaN: lower the learning rate, or check the inputs"
"""The remedy for predictions that are not finite."""


def format_value(value: object) -> str:
    """A short description of a value for error messages: its repr, or its class where that is not one line."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    text, kind = reprlib.repr(value), type(value).__name__
    if not text.startswith("<") and "\n" not in text:
        return text
    return f"an {kind}" if kind[0] in "AEIOUaeiou" else f"a {kind}"


def refuse_other_type(name: str, value: object, kind: type, what: str, advice: str) -> None:
    """Refuse a value that is not an instance of a class; for the class itself the remedy is to call it.

    Args:
        name: name of the argument.
        value: value of the argument.
        kind: the class.
        what: the expected object in words, such as "a Recording".
        advice: how to get an instance.

    Raises:
        TypeError: it is not an instance.
    """
    if not isinstance(value, kind):
        if isinstance(value, type) and issubclass(value, kind):
            advice = f"make one, {value.__name__}(...)"
        raise TypeError(f"Expected argument `{name}` to be {what} but got {format_value(value)}; {advice}.")


def refuse_no_tensor(name: str, value: object, kind: str) -> None:
    """Refuse data that are not a tensor, with the conversion as remedy.

    Args:
        name: name of the argument.
        value: value of the argument.
        kind: the expected object in words, such as "a real tensor".

    Raises:
        TypeError: it is an array, a list, a number, or another object.
    """
    if isinstance(value, Tensor):
        return
    array = isinstance(value, (list, tuple, int, float)) or hasattr(value, "__array__")
    advice = f"make a tensor of it, torch.as_tensor({name})" if array else "pass a tensor"
    raise TypeError(f"Expected argument `{name}` to be {kind} but got {type(value).__name__}; {advice}.")


def refuse_complex(name: str, value: Tensor) -> None:
    """Refuse complex numbers.

    Raises:
        TypeError: the tensor is complex.
    """
    if value.is_complex():
        raise TypeError(f"Expected argument `{name}` to be real but got {value.dtype}; pass its real part.")


def refuse_not_real(name: str, value: object, kind: str = "a real floating-point tensor") -> None:
    """Refuse data that are not a tensor of real floating-point numbers, with the conversion as remedy.

    Raises:
        TypeError: integers, complex numbers, or not a tensor.
    """
    refuse_no_tensor(name, value, kind)
    if isinstance(value, Tensor) and not value.is_floating_point():
        advice = "pass real and imaginary parts as channels"
        if not value.is_complex():
            advice = f"convert it, {name}.float() or {name}.double()"
        raise TypeError(f"Expected argument `{name}` to be {kind} but got {value.dtype}; {advice}.")


def as_numbers(
    name: str, value: object, dtype: torch.dtype | None = None, device: torch.device | None = None
) -> Tensor:
    """A tensor unchanged, or a number or a sequence of numbers as a tensor of ``dtype``.

    Raises:
        TypeError: it is not numeric, or complex.
    """
    if not isinstance(value, Tensor):
        try:
            return torch.as_tensor(value, dtype=dtype or torch.get_default_dtype(), device=device)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise TypeError(
                f"Expected argument `{name}` to be a number or a tensor of numbers but got {format_value(value)}."
            ) from None
    refuse_complex(name, value)
    return value


def refuse_out_of_range(
    name: str, value: object, low: float = 0.0, high: float = math.inf, ends: str = "()", advice: str = ""
) -> None:
    """Refuse a number, or a tensor or sequence of numbers, with a value outside a range.

    Args:
        name: name of the argument.
        value: value of the argument; the values of a tensor are checked where the module allows.
        low, high: ends of the range.
        ends: "(" or "[" and ")" or "]": whether the ends are in the range.
        advice: the remedy; empty for none.

    Raises:
        TypeError: it is not numeric.
        ValueError: a value is out of range, or NaN.
    """
    if isinstance(value, (int, float)):
        least = most = _float(name, value)
    else:
        value = as_numbers(name, value)
        seen = _extremes(value)
        if seen is None:
            return
        least, most = seen
    # for NaN all comparisons are False, so it is refused
    if (low <= least if ends[0] == "[" else low < least) and (most <= high if ends[1] == "]" else most < high):
        return
    got = f"{value}"
    if isinstance(value, Tensor):
        right = ((value >= low) if ends[0] == "[" else (value > low)) & (
            (value <= high) if ends[1] == "]" else (value < high)
        )
        got = first_of(value.detach(), ~right)
    raise ValueError(f"Expected argument `{name}` to be {_range(low, high, ends)} but got {got}{_remedy_text(advice)}.")


def checked_number(
    name: str, value: object, low: float = 0.0, high: float = math.inf, ends: str = "()", advice: str = ""
) -> float:
    """``value`` as a float in a range; arguments as for :func:`refuse_out_of_range`.

    Raises:
        TypeError: it is not a real number.
        ValueError: it is out of range, or NaN.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise TypeError(
            f"Expected argument `{name}` to be a number {_range(low, high, ends)} but got {format_value(value)}"
            f"{_remedy_text(advice)}."
        )
    try:
        number = float(value)
    except OverflowError:  # an integer with hundreds of digits
        number = math.inf
    refuse_out_of_range(name, number, low, high, ends, advice)
    return number


def checked_whole(name: str, value: object, least: int | None = None, advice: str = "") -> int:
    """``value`` as an integer of at least ``least``.

    Raises:
        ValueError: it is not such an integer.
    """
    number = None if isinstance(value, bool) or not isinstance(value, numbers.Integral) else int(value)
    if number is None or (least is not None and number < least):
        limit = "" if least is None else f" of at least {least}"
        raise ValueError(
            f"Expected argument `{name}` to be a whole number{limit} but got {format_value(value)}"
            f"{_remedy_text(advice)}."
        )
    return number


def refuse_text(name: str, value: object, what: str) -> None:
    """Refuse a string where a sequence of names is expected, because its letters would be the names.

    Raises:
        TypeError: it is a string, or not a sequence of strings.
    """
    if isinstance(value, str):
        raise TypeError(f"Expected argument `{name}` to be {what} but got {value!r}; write ({value!r},).")
    if not isinstance(value, (tuple, list)) or not all(isinstance(text, str) for text in value):
        raise TypeError(f"Expected argument `{name}` to be {what} but got {format_value(value)}.")


def refuse_bad_weight(weight: object, name: str = "weight") -> None:
    """Refuse weights that are not a real tensor, or negative, NaN or infinite; a boolean mask is accepted.

    Raises:
        TypeError: not a tensor, or complex.
        ValueError: a weight is negative or not finite.
    """
    refuse_no_tensor(name, weight, "a tensor of weights or a boolean mask")
    assert isinstance(weight, Tensor)
    refuse_complex(name, weight)
    if weight.dtype == torch.bool:
        return
    seen = _extremes(weight)
    if seen is None or (seen[0] >= 0.0 and seen[1] < math.inf):
        return
    weight = weight.detach()
    wrong = ~((weight >= 0) & (weight < math.inf))
    raise ValueError(
        f"Expected argument `{name}` to be >= 0 and finite but got {first_of(weight, wrong)} ({int(wrong.sum())} such "
        "values); give samples that do not count the weight 0 or False."
    )


def seems_finite(*values: Tensor) -> bool:
    """Whether all elements are finite; True where they cannot be checked, False also where only their sum overflows."""
    if torch.compiler.is_compiling() or any(value.device.type != "cpu" for value in values):
        return True
    try:
        # a sum takes a fraction of the time of a check of each element
        totals = [value.detach().sum().item() for value in values]
    except RuntimeError:  # under vmap there is no single value
        return True
    return all(map(math.isfinite, totals))


def refuse_not_finite(
    name: str, value: Float[Tensor, "*shape"], advice: str, counts: Bool[Tensor, "*shape"] | None = None
) -> None:
    """Refuse a tensor with NaN or infinite elements in the mask ``counts``.

    Raises:
        ValueError: there is such an element.
    """
    wrong = ~torch.isfinite(value.detach())
    if counts is not None:
        wrong = wrong & counts
    if bool(wrong.any()):
        raise ValueError(
            f"Expected argument `{name}` to be finite but got {int(wrong.sum())} values that are not, the first at "
            f"index {tuple(wrong.nonzero()[0].tolist())}. {advice}."
        )


def refuse_bad_batch(
    input: Float[Tensor, "*shape"] | None,
    target: Float[Tensor, "*shape"],
    counts: Bool[Tensor, "*shape"] | None = None,
    error: Float[Tensor, "*shape"] | None = None,
    advice: str = "",
) -> None:
    """Refuse NaN or infinite predictions and targets in the mask, where their values can be checked.

    Args:
        input, target: predictions and targets, at least in float32; None for predictions that are not checked.
        counts: the mask; None for all elements.
        error: their difference, 0 outside the mask, if it is in memory: a single check then suffices.
        advice: a further remedy for predictions that are not finite.

    Raises:
        ValueError: a target or a prediction is not finite.
    """
    if seems_finite(*([value for value in (input, target) if value is not None] if error is None else (error,))):
        return
    refuse_not_finite("target", target, "Leave them out: loss(input, target, weight=torch.isfinite(target))", counts)
    if input is not None:
        refuse_not_finite("input", input, f"{DIVERGED}. {advice}" if advice else DIVERGED, counts)


def _float(name: str, value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ValueError(
            f"Expected argument `{name}` to be a number that a float holds but got {format_value(value)}."
        ) from None


def refuse_other_shapes(**given: Tensor) -> None:
    """Refuse tensors that do not broadcast, by their names; not in compiled code, where torch raises.

    Raises:
        ValueError: they do not broadcast.
    """
    if torch.compiler.is_compiling():
        return
    # not torch.broadcast_shapes, which loads sympy
    sizes = zip_longest(*(reversed(value.shape) for value in given.values()), fillvalue=1)
    if any(len({size for size in along if size != 1}) > 1 for along in sizes):
        shapes = ", ".join(f"`{name}` {tuple(value.shape)}" for name, value in given.items())
        raise ValueError(f"Expected arguments of shapes that broadcast but got {shapes}.")


def _extremes(value: Tensor) -> tuple[float, float] | None:
    """The smallest and the largest element, NaN if any is NaN; None without elements or where they are not checked."""
    if torch.compiler.is_compiling() or value.device.type != "cpu" or value.numel() == 0:
        return None
    least, most = torch.aminmax(value.detach())
    try:
        return least.item(), most.item()
    except RuntimeError:  # under vmap there is no single value
        return None


def first_of(value: Tensor, wrong: Tensor) -> str:
    """The first wrong element and its index, for error messages."""
    index = tuple(int(at) for at in wrong.nonzero()[0])  # not tolist, which torch 2.6 lacks under its transforms
    return f"{value[index].item():.6g}" + (f" at index {index}" if index else "")


def _range(low: float, high: float, ends: str) -> str:
    if low == 0.0 and high == math.inf:
        sign = "positive" if ends[0] == "(" else ">= 0"
        return sign if ends[1] == "]" else f"{sign} and finite"
    return f"in {ends[0]}{low:.4g}, {high:.4g}{ends[1]}"


def _remedy_text(advice: str) -> str:
    return f"; {advice}" if advice else ""
