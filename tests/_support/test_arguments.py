"""Checks of arguments: each message has the argument, the expected and the actual value, and the remedy."""

import math

import numpy as np
import pytest
import torch

from mkc_torch._support.arguments import (
    as_numbers,
    checked_number,
    checked_whole,
    format_value,
    refuse_bad_batch,
    refuse_bad_weight,
    refuse_not_real,
    refuse_other_type,
    refuse_out_of_range,
    refuse_text,
)

INF, NAN = math.inf, math.nan


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(2), r"but got ndarray; make a tensor of it, torch\.as_tensor\(x\)\."),
        ([1.0], r"but got list; make a tensor of it, torch\.as_tensor\(x\)\."),
        (1.0, r"but got float; make a tensor of it, torch\.as_tensor\(x\)\."),
        (torch.zeros(2, dtype=torch.int64), r"but got torch\.int64; convert it, x\.float\(\) or x\.double\(\)\."),
        (torch.zeros(2) + 0j, r"but got torch\.complex64; pass real and imaginary parts as channels\."),
        ("text", r"but got str; pass a tensor\."),
        (None, r"but got NoneType; pass a tensor\."),
    ],
)
def test_data_that_are_not_a_real_tensor_are_refused_with_the_conversion(value, message):
    with pytest.raises(TypeError, match=f"^Expected argument `x` to be a real floating-point tensor {message}$"):
        refuse_not_real("x", value)
    refuse_not_real("x", torch.zeros(2, dtype=torch.bfloat16))


def test_as_numbers_accepts_tensors_sequences_and_arrays():
    given = torch.ones(2, dtype=torch.float64, requires_grad=True)
    assert as_numbers("x", given) is given
    for value in ([1.0, 2.0], (1, 2), np.array([1.0, 2.0])):
        assert as_numbers("x", value, torch.float64).tolist() == [1.0, 2.0]
    assert as_numbers("x", 2).dtype == torch.get_default_dtype()
    for value in ("a", None, 1j, [[1.0], [1.0, 2.0]], torch.nn.Linear, 10**400):
        with pytest.raises(TypeError, match="`x` to be a number or a tensor of numbers but got "):
            as_numbers("x", value)


@pytest.mark.parametrize("end", [1.0, 2.0])
@pytest.mark.parametrize("ends", ["()", "[)", "(]", "[]"])
@pytest.mark.parametrize("kind", [float, torch.tensor, lambda v: torch.tensor([1.5, v]), lambda v: [v]])
def test_closed_ends_belong_to_a_range(end, ends, kind):
    if ends[int(end) - 1] in "[]":
        refuse_out_of_range("x", kind(end), 1.0, 2.0, ends)
        return
    with pytest.raises(ValueError, match=rf"`x` to be in \{ends[0]}1, 2\{ends[1]} but got {end:g}"):
        refuse_out_of_range("x", kind(end), 1.0, 2.0, ends)


@pytest.mark.parametrize("value", [NAN, torch.tensor([1.0, NAN]), [1.0, NAN], torch.tensor(NAN)])
def test_nan_is_out_of_every_range(value):
    with pytest.raises(ValueError, match=r"`x` to be in \[-inf, inf\] but got nan"):
        refuse_out_of_range("x", value, -INF, INF, "[]")


def test_error_of_an_unbounded_range_names_the_first_wrong_value_and_the_remedy():
    for ends, words in (("()", "positive and finite"), ("(]", "positive"), ("[)", ">= 0 and finite"), ("[]", ">= 0")):
        with pytest.raises(
            ValueError, match=f"^Expected argument `x` to be {words} but got -3 at index .0, 1.; fix it.$"
        ):
            refuse_out_of_range("x", torch.tensor([[1.0, -3.0], [-4.0, 1.0]]), ends=ends, advice="fix it")


def test_values_under_vmap_and_of_empty_tensors_are_not_checked():
    def through(x):
        refuse_out_of_range("x", x)
        refuse_bad_weight(x)
        refuse_bad_batch(x, x)
        return x

    assert torch.func.vmap(through)(torch.tensor([[-1.0], [NAN]])).shape == (2, 1)
    through(torch.empty(0))
    with pytest.raises(ValueError, match="`x` to be positive"):
        torch.func.grad(lambda x: through(x).sum())(torch.tensor([-1.0]))


def test_checked_number_refuses_tensors_text_and_booleans():
    assert checked_number("x", np.float32(0.5), 0.0, 1.0) == 0.5
    assert checked_number("x", 1, 0.0, 2.0) == 1
    with pytest.raises(ValueError, match="`x` to be positive and finite but got inf"):
        checked_number("x", 10**400)
    for value in ("0.5", None, True, torch.tensor(0.5), [0.5]):
        with pytest.raises(TypeError, match=r"`x` to be a number in \(0, 1\) but got .*; half is usual\.$"):
            checked_number("x", value, 0.0, 1.0, advice="half is usual")
    with pytest.raises(ValueError, match=r"`x` to be in \(0, 1\) but got 1.5; half is usual\.$"):
        checked_number("x", 1.5, 0.0, 1.0, advice="half is usual")


def test_checked_whole_accepts_integers_only():
    assert checked_whole("x", np.int64(3), 1) == 3
    assert checked_whole("seed", -5) == -5
    for value in (0, 2.0, 1.5, True, "3", None):
        with pytest.raises(ValueError, match=r"`x` to be a whole number of at least 1 but got .*; 10 is ample\.$"):
            checked_whole("x", value, 1, "10 is ample")


def test_other_types_are_refused_and_for_the_class_the_remedy_is_a_call():
    refuse_other_type("x", torch.nn.ReLU(), torch.nn.Module, "a module", "write one")
    with pytest.raises(TypeError, match=r"`x` to be a module but got 'a'; write one\.$"):
        refuse_other_type("x", "a", torch.nn.Module, "a module", "write one")
    with pytest.raises(TypeError, match=r"`x` to be a module but got the class ReLU; make one, ReLU\(\.\.\.\)\.$"):
        refuse_other_type("x", torch.nn.ReLU, torch.nn.Module, "a module", "write one")
    with pytest.raises(TypeError, match=r"got the class int; write one\.$"):
        refuse_other_type("x", int, torch.nn.Module, "a module", "write one")


def test_text_is_refused_as_a_sequence_of_names():
    refuse_text("x", ("a", "b"), "names")
    with pytest.raises(TypeError, match=r"`x` to be names but got 'abc'; write \('abc',\)\."):
        refuse_text("x", "abc", "names")
    for value in (3, (3,), None):
        with pytest.raises(TypeError, match="`x` to be names but got"):
            refuse_text("x", value, "names")


@pytest.mark.parametrize("bad", [-1.0, NAN, INF, -INF])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_weights_that_are_negative_or_not_finite_are_refused_by_index(bad, dtype):
    weight = torch.ones(3, 2, dtype=dtype)
    weight[1, 0] = bad
    message = (
        rf"`weight` to be >= 0 and finite but got {bad:g} at index \(1, 0\) \(1 such values\); .* weight 0 or False"
    )
    with pytest.raises(ValueError, match=message):
        refuse_bad_weight(weight)


def test_weights_may_be_counts_and_masks_but_not_lists_or_complex():
    for weight in (torch.tensor([0, 2]), torch.tensor([True, False]), torch.zeros(2), torch.empty(0)):
        refuse_bad_weight(weight)
    with pytest.raises(ValueError, match="got -2 at index"):
        refuse_bad_weight(torch.tensor([1, -2]))
    for weight in ([1.0], np.ones(2), 1.0):
        with pytest.raises(
            TypeError, match=r"`w` to be a tensor of weights or a boolean mask but got .*as_tensor\(w\)"
        ):
            refuse_bad_weight(weight, "w")
    with pytest.raises(TypeError, match=r"`weight` to be real but got torch\.complex64"):
        refuse_bad_weight(torch.ones(2) + 0j)


def test_format_value_is_short():
    assert format_value(torch.nn.Linear) == "the class Linear"
    assert format_value("a") == "'a'"
    assert format_value(format_value) == "a function"
    assert format_value(object()) == "an object"
    assert len(format_value(list(range(1000)))) < 60
