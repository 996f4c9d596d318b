"""The items of a stage are counted in any process, but not the steps within an item."""

import sys

import pytest

from mkc_torch._parallel.pool import allow_copies, shared
from mkc_torch._parallel.progress import count, counted, counting, silently


class Recorder(list):
    def count(self, thing, done, total):
        self.append((thing, done, total))


@pytest.fixture
def recorder():
    recorder = Recorder()
    with counting(recorder):
        yield recorder


def test_counted_reports_each_item_and_the_end(recorder):
    assert list(counted("ab", 2, "letter")) == ["a", "b"]
    assert recorder == [("letter", 0, 2), ("letter", 1, 2), ("letter", 2, 2)]


def test_unnamed_or_single_items_are_not_counted(recorder):
    count("", 1, 2)
    count("letter", 0, 1)
    with silently():
        count("letter", 1, 2)
    assert recorder == []


def test_a_progress_function_without_count_receives_no_counts():
    stages = []
    with counting(stages.append):
        count("letter", 1, 2)
    assert stages == []


@pytest.mark.parametrize(
    "copies", [0, pytest.param(1, marks=pytest.mark.skipif(sys.platform != "linux", reason="fork"))]
)
def test_shared_work_is_counted_without_its_inner_items(recorder, copies):
    allow_copies(copies)
    try:
        results = shared([lambda: shared([lambda: 1, lambda: 2], thing="inner")] * 4, thing="outer")
    finally:
        allow_copies(0)
    assert results == [[1, 2]] * 4
    assert {thing for thing, _, _ in recorder} <= {"outer"}
    assert [done for _, done, _ in recorder] == sorted(done for _, done, _ in recorder)
    if not copies:
        assert recorder == [("outer", done, 4) for done in range(5)]


def test_inner_items_of_unnamed_work_are_counted(recorder):
    shared([lambda: list(counted("ab", 2, "letter")), lambda: None])
    assert recorder[-1] == ("letter", 2, 2)
