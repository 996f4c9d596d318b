"""Every public entry, with each argument contaminated in each way, raises a clear error or returns no NaN."""

from __future__ import annotations

import importlib
import inspect
import warnings
from collections.abc import Iterator
from dataclasses import is_dataclass
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mkc_torch.nonlinear import NoFitError
from tests.public_entries import Entry, contaminated, entries

ENTRIES = {entry.names[0]: entry for entry in entries()}
ROOMS = ("covariance", "density", "functional", "linear", "losses", "metrics", "nonlinear")
"""Those whose public names are all entries with tensors; the others have files, recordings or effects of their own."""

ELSEWHERE = {
    "functional.KAPPA_MAX": "a number",
    "functional.energy": "a part of mkc_energy that looks at nothing, by its module",
    "functional.inverse_square": "likewise",
    "functional.log_partition": "likewise, of log_normalizer",
    "linear.NotFittedError": "an error",
    "linear.RankDeficientError": "an error",
    "nonlinear.NoFitError": "an error",
    "nonlinear.NonlinearFit": "what fit gives",
    "nonlinear.Solution": "what minimise gives",
    "nonlinear.load_forward_mode": "takes nothing",
    "covariance.ExactFitError": "an error",
    "covariance.SampleKind": "an enumeration",
}
"""Public names that are no entry, and why."""

SLOW = ("calibration.", "density.fit_kernels", "losses.least_entropy_like", "nonlinear.")
"""Those of which a sample is drawn; all of theirs take most of a minute."""

CASES = [
    (name, argument)
    for name, entry in ENTRIES.items()
    for argument in entry.arguments
    if argument not in entry.fixed + entry.passes
]


def tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for item in value:
            yield from tensors(item)
    elif is_dataclass(value):
        for item in vars(value).values():
            yield from tensors(item)


def fault_of(entry: Entry, argument: str, value: Any) -> str:
    """The fault of a call with one argument replaced: an unclear error, or a NaN; empty if there is no fault."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # our own, of a tail beyond the bound and the like
            answer = entry.call(**{**entry.arguments, argument: value})
    except (ValueError, TypeError, NoFitError) as error:
        return "" if len(str(error)) >= 30 else f"{error!r} is too short"
    except Exception as error:
        return f"{error!r} is not an error of the package"
    return "NaN" if any(tensor.isnan().any() for tensor in tensors(answer)) else ""


def faults_by_contamination(name: str, argument: str) -> dict[str, str]:
    entry = ENTRIES[name]
    outcomes = {way: fault_of(entry, argument, value) for way, value in contaminated(entry.arguments[argument])}
    return {way: fault for way, fault in outcomes.items() if fault}


@pytest.mark.parametrize(("name", "argument"), [case for case in CASES if not case[0].startswith(SLOW)])
def test_a_contaminated_argument_is_refused_or_gives_numbers(name, argument):
    assert faults_by_contamination(name, argument) == {}


@pytest.mark.e2e
@settings(max_examples=25, deadline=None)
@given(st.data())
def test_a_contaminated_argument_of_a_slow_entry_is_refused_or_gives_numbers(data):
    name, argument = data.draw(st.sampled_from([case for case in CASES if case[0].startswith(SLOW)]))
    entry = ENTRIES[name]
    assert fault_of(entry, argument, data.draw(st.sampled_from(list(contaminated(entry.arguments[argument]))))[1]) == ""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "argument"), [case for case in CASES if case[0].startswith(SLOW)])
def test_every_contaminated_argument_of_a_slow_entry_is_refused_or_gives_numbers(name, argument):
    assert faults_by_contamination(name, argument) == {}


@pytest.mark.parametrize("name", [name for name in ENTRIES if name != "diagnosis.diagnose"])
def test_valid_arguments_give_results_without_nan(name):
    assert not any(tensor.isnan().any() for tensor in tensors(ENTRIES[name].call(**ENTRIES[name].arguments)))


@pytest.mark.parametrize("room", ROOMS)
def test_each_public_name_is_an_entry(room):
    names = {f"{room}.{name}" for name in importlib.import_module(f"mkc_torch.{room}").__all__}
    asked = {name.split(" ")[0] for entry in ENTRIES.values() for name in entry.names}
    modules = {
        name
        for name in names
        if inspect.ismodule(getattr(importlib.import_module(f"mkc_torch.{room}"), name.split(".")[1]))
    }
    assert names - asked - set(ELSEWHERE) - modules == set()
