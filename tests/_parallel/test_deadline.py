"""Long work stops between its steps at a time limit and at an interrupt, and leaves no process behind."""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time

import pytest

from mkc_torch._parallel.deadline import Stopped, check_deadline, is_limited, limited, stopped_by_interrupt, within
from mkc_torch._parallel.pool import allow_copies, shared
from tests.started import started


@pytest.fixture(autouse=True)
def default_interrupt_handler():
    """Handle interrupts by default, which a background shell may ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


linux = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
posix = pytest.mark.skipif(os.name == "nt", reason="no POSIX signals")


@pytest.fixture
def one_worker():
    allow_copies(1)
    yield
    allow_copies(0)


def test_there_is_no_deadline_outside_of_a_block():
    check_deadline()
    with limited(60.0):
        check_deadline()
        assert is_limited()
    assert not is_limited()


def test_an_exceeded_time_limit_stops_the_next_step():
    with limited(60.0, begin=time.monotonic() - 61.0), pytest.raises(Stopped) as raised:
        check_deadline()
    assert raised.value.reason == "time limit"


def test_stopped_is_not_an_exception_and_can_be_pickled():
    assert not issubclass(Stopped, Exception)
    assert pickle.loads(pickle.dumps(Stopped("interrupt"))).reason == "interrupt"


def test_within_returns_none_after_the_time_limit():
    assert within(60.0, lambda: 1) == 1
    assert within(0.0, check_deadline) is None
    with limited(0.0):
        assert within(60.0, lambda: check_deadline() or 1) == 1  # the inner deadline replaces the outer


@posix
def test_the_first_interrupt_stops_at_the_next_step_and_the_second_raises_keyboard_interrupt(monkeypatch):
    monkeypatch.setattr("mkc_torch._parallel.deadline._SAME_INTERRUPT_S", 0.0)
    with stopped_by_interrupt(), limited():
        check_deadline()
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(Stopped) as raised:
            check_deadline()
        assert raised.value.reason == "interrupt"
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@posix
def test_two_immediate_interrupts_count_as_a_single_interrupt():
    with stopped_by_interrupt(), limited():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)  # from the terminal, and from a parent process
        with pytest.raises(Stopped):
            check_deadline()


@posix
def test_other_handlers_and_threads_are_unchanged():
    known = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with stopped_by_interrupt():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, known)

    def elsewhere():
        with stopped_by_interrupt():
            seen.append(signal.getsignal(signal.SIGINT))

    seen = []
    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]


@pytest.mark.parametrize("copies", [0, pytest.param(1, marks=linux)])
def test_no_work_starts_after_the_deadline(copies):
    allow_copies(copies)
    try:
        done = []
        with limited(0.0), pytest.raises(Stopped):
            shared([lambda: done.append(1)] * 3)
        assert done == []
    finally:
        allow_copies(0)


@linux
@pytest.mark.usefixtures("one_worker")
def test_the_deadline_ends_a_worker_that_is_waited_for():
    here = os.getpid()

    def work():
        while os.getpid() != here:
            time.sleep(0.01)
        time.sleep(0.05)

    with limited(0.3), pytest.raises(Stopped):
        shared([work] * 2)
    assert multiprocessing.active_children() == []


@linux
@pytest.mark.usefixtures("one_worker")
def test_a_worker_stops_at_the_deadline():
    def work():
        while True:
            check_deadline()
            time.sleep(0.01)

    with limited(0.3), pytest.raises(Stopped):
        shared([work, work])
    assert multiprocessing.active_children() == []


STOPPED = """
import os, sys, time
from mkc_torch._parallel.deadline import Stopped, check_deadline, limited, stopped_by_interrupt
from mkc_torch._parallel.pool import allow_copies, shared

def work():
    print(flush=True)
    while os.getpid() != here:
        time.sleep(0.1)  # a copy does not check its deadline
    while True:
        check_deadline()
        time.sleep(0.01)

here = os.getpid()
allow_copies(1)
with stopped_by_interrupt(), limited():
    try:
        shared([work] * 2)
    except Stopped as stopped:
        print(stopped.reason, flush=True)
"""


@linux
@pytest.mark.process
def test_an_interrupt_of_all_processes_stops_work_and_ends_workers():
    with started("-c", STOPPED) as process:
        for _ in range(2):
            process.stdout.readline()
        os.killpg(process.pid, signal.SIGINT)
        # the copies share its streams, which close when the last copy ends
        output, errors = process.communicate(timeout=60)
    assert (output, errors) == ("interrupt\n", "")
    assert process.returncode == 0
