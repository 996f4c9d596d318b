"""What a stage is made of is counted, by whoever works at it, and nothing within one of those things."""

import sys

import pytest

from mkc_torch._parallel.pool import allow_copies, shared
from mkc_torch._parallel.progress import count, counted, counting, silently


class Told(list):
    def count(self, thing, done, total):
        self.append((thing, done, total))


@pytest.fixture
def told():
    told = Told()
    with counting(told):
        yield told


def test_each_thing_is_counted_and_the_end(told):
    assert list(counted("ab", 2, "letter")) == ["a", "b"]
    assert told == [("letter", 0, 2), ("letter", 1, 2), ("letter", 2, 2)]


def test_what_has_no_name_or_is_single_is_not_told(told):
    count("", 1, 2)
    count("letter", 0, 1)
    with silently():
        count("letter", 1, 2)
    assert told == []


def test_a_function_is_told_nothing():
    stages = []
    with counting(stages.append):
        count("letter", 1, 2)
    assert stages == []


@pytest.mark.parametrize(
    "copies", [0, pytest.param(1, marks=pytest.mark.skipif(sys.platform != "linux", reason="fork"))]
)
def test_shared_works_are_counted_but_not_what_is_within_them(told, copies):
    allow_copies(copies)
    try:
        results = shared([lambda: shared([lambda: 1, lambda: 2], thing="inner")] * 4, thing="outer")
    finally:
        allow_copies(0)
    assert results == [[1, 2]] * 4
    assert {thing for thing, _, _ in told} <= {"outer"}
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)
    if not copies:
        assert told == [("outer", done, 4) for done in range(5)]


def test_works_without_a_name_let_what_is_within_them_be_counted(told):
    shared([lambda: list(counted("ab", 2, "letter")), lambda: None])
    assert told[-1] == ("letter", 2, 2)
