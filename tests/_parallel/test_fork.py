"""Work is shared with copies of a process; whoever does it, the results are those of this process alone."""

import os
import signal
import subprocess
import sys
import textwrap
import time

import pytest
import torch

from mkc_torch._parallel import fork as _forked
from mkc_torch._parallel.fork import allow_copies, meanwhile, shared

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="copies are forked on Linux alone")

HERE = os.getpid()


@pytest.fixture(autouse=True)
def copies(monkeypatch):
    started, copy = [], _forked._copy

    def noted(*arguments):
        started.append(copy(*arguments))
        return started[-1]

    monkeypatch.setattr(_forked, "_copy", noted)
    # this process has threads that a copy lacks, so no work here computes with tensors of more than a few numbers
    allow_copies(2)
    yield started
    allow_copies(0)
    for one in started:
        with pytest.raises(ChildProcessError):
            os.waitpid(one.process, os.WNOHANG)


def elsewhere(value):
    """A value, and who gave it; slow enough for others to take the next."""

    def work():
        time.sleep(0.05)
        return value, os.getpid()

    return work


def with_niceness(value):
    """The same with how far that one stands back."""
    return lambda: (*elsewhere(value)(), os.nice(0))


def test_results_come_in_order_and_copies_take_part():
    results = shared([elsewhere(k) for k in range(9)])
    assert [value for value, _ in results] == list(range(9))
    assert len({process for _, process in results}) == 3


def test_without_permission_all_is_done_here():
    allow_copies(0)
    assert shared([os.getpid, os.getpid]) == [HERE, HERE]
    with meanwhile([os.getpid]) as answer:
        assert answer() == [HERE]


def test_a_copy_shares_nothing_further():
    def work():
        return elsewhere(_forked._copies)()

    inside = shared([work] * 6)
    assert all(copies == (2 if process == HERE else 0) for copies, process in inside)
    assert len({process for _, process in inside}) == 3


def test_what_a_copy_cannot_send_is_done_here():
    results = shared([lambda k=k: (os.getpid(), lambda: k) for k in range(6)])
    assert [one() for _, one in results] == list(range(6))
    assert {process for process, _ in results} == {HERE}


def test_what_a_copy_left_undone_is_done_here():
    def dies():
        if os.getpid() != HERE:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    assert shared([dies] * 5) == [HERE] * 5


def test_without_memory_for_a_copy_all_is_done_here(monkeypatch):
    def fails():
        raise BlockingIOError

    monkeypatch.setattr(os, "fork", fails)
    assert shared([os.getpid] * 3) == [HERE] * 3
    with meanwhile([os.getpid]) as answer:
        assert answer() == [HERE]


def test_an_error_is_raised_here():
    def fails():
        raise ArithmeticError(f"in {os.getpid() == HERE}")

    with pytest.raises(ArithmeticError, match="in True"):
        shared([elsewhere(1), elsewhere(2), elsewhere(3), fails])


def test_what_is_known_comes_back_as_itself_and_tensors_without_what_they_are_views_of():
    known, whole = object(), torch.arange(1000.0).double()

    def work():
        return known, whole[3:5], whole[7], whole[:4].reshape(2, 2).mT > 1.0, os.getpid()

    for result in shared([work] * 6, [known]):
        assert result[0] is known
        assert result[1].tolist() == [3.0, 4.0]
        assert result[2].dtype == torch.float64
        assert float(result[2]) == 7.0
        assert result[3].tolist() == [[False, True], [False, True]]
        assert result[-1] == HERE or result[1].untyped_storage().nbytes() == 16


def test_a_copy_works_meanwhile():
    with meanwhile([lambda: (os.getpid(), known)], [known := object()]) as answer:
        [(process, same)] = answer()
    assert process != HERE
    assert same is known
    assert _forked._copies == 2


def test_within_a_copy_all_is_done_there():
    """Also where others are at work, which are no copies of its own."""

    def work():
        time.sleep(0.05)
        with meanwhile([os.getpid]) as answer:
            return {os.getpid(), *shared([os.getpid, os.getpid]), *answer()}

    assert all(len(processes) == 1 for processes in shared([work] * 6) if HERE not in processes)
    with meanwhile([signal.pause]), meanwhile([work]) as answer:
        assert len(answer()[0]) == 1


def test_a_copy_that_works_meanwhile_leaves_its_core_to_what_is_shared_and_to_nothing_else():
    allow_copies(1)
    with meanwhile([signal.pause]):
        _, processes, niceness = zip(*shared([with_niceness(k) for k in range(4)]), strict=True)
        assert len(set(processes)) == 2
        assert len(set(niceness)) == 1
        with meanwhile([os.getpid]) as another:
            assert another() == [HERE]
    with meanwhile([with_niceness(0)]) as answer:
        [(_, process, niceness)] = answer()
    assert process != HERE
    assert niceness > os.nice(0)


def test_who_waits_for_a_copy_starts_no_other_on_its_core(copies):
    allow_copies(1)
    with meanwhile([elsewhere(k) for k in range(5)]) as answer:
        assert [value for value, _ in answer()] == list(range(5))
    assert len(copies) == 1


def test_the_core_of_a_copy_that_is_done_is_free(copies):
    allow_copies(1)
    with meanwhile([elsewhere(bytes(1_000_000))]) as answer:
        # it is done while these are worked at, and what it has to say is not waited for
        results = shared([elsewhere(k) for k in range(9)])
        assert [value for value, _ in results] == list(range(9))
        assert len({process for _, process in results}) == 2
        while copies[0].at_work:
            time.sleep(0.01)
        with meanwhile([os.getpid]) as another:
            assert another() != [HERE]
        assert answer()[0][1] != HERE


def test_what_nobody_has_begun_is_done_by_who_asks():
    """The copy begins with the last one."""
    with meanwhile([elsewhere(k) for k in range(3)] + [lambda: (time.sleep(0.5), os.getpid())]) as answer:
        *others, (_, process) = answer()
    assert [value for value, _ in others] == [0, 1, 2]
    assert HERE in {by for _, by in others}
    assert process != HERE


def test_meanwhile_a_work_that_fails_fails_here():
    with meanwhile([lambda: 1 / 0]) as answer, pytest.raises(ZeroDivisionError):
        answer()


def test_a_copy_that_is_not_waited_for_is_ended(copies):
    with meanwhile([signal.pause]):
        pass
    assert len(copies) == 1  # the fixture looks for what is left of it


CODE = """
    import json, math, os, sys, torch
    from mkc_torch import Recording, diagnose
    from mkc_torch._parallel.fork import allow_copies
    from mkc_torch._parallel.processes import one_thread
    from mkc_torch.recording.demonstration import simulated_recording
    from mkc_torch.diagnosis.files.diagnosis_json import diagnosis_to_json
    from mkc_torch.simulation import Dynamics, Magnetometer

    one_thread()

    def alike(one, other):
        # numbers to rounding, which depends on where an array lies in memory; all else exactly
        if isinstance(one, dict):
            return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
        if isinstance(one, list):
            return len(one) == len(other) and all(map(alike, one, other))
        if isinstance(one, float):
            return math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-12)
        return one == other

    class Cart(Dynamics):
        states = ("place", "speed")
        inputs = ("force",)
        parameters = {"damping": 0.5}

        def derivative(self, time, x, u, p):
            return {"place": x.speed, "speed": u.force - p.damping * x.speed}

    time = torch.arange(0.0, 8.0, 0.02, dtype=torch.float64)
    force = torch.sin(1.3 * time) + torch.sin(0.31 * time)
    place, speed, places = 0.0, 0.0, []
    for f in force.tolist():
        places.append(place)
        speed += 0.02 * (f - 0.5 * speed - 0.4 * speed * abs(speed) - 0.3 * place)
        place += 0.02 * speed
    noise = 0.002 * torch.randn(len(time), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    cart = Recording({"time": time, "force": force, "place": torch.tensor(places) + noise})
    forks, fork = [], os.fork
    os.fork = lambda: forks.append(1) or fork()
    sensor = simulated_recording()[0]
    columns = {name: sensor[name] for name in ("time", "mag_x", "mag_y", "mag_z")}
    columns["mag_x"] = columns["mag_x"] + 6.0 * (columns["time"] > columns["time"].median())
    for simulation, recording in ((Magnetometer(), Recording(columns)), (Cart(), cart)):
        told = []
        for copies in (0, 1):
            allow_copies(copies)
            diagnosis = diagnose(simulation, recording)
            told.append(diagnosis_to_json(diagnosis))
        same = alike(*map(json.loads, told))
        print([f.effect for f in diagnosis.findings], same, len(forks) > 3)
        forks.clear()
        # a second's import for a constant beside what is differentiated; equations of one's own may have some
        assert isinstance(simulation, Dynamics) or "torch._dynamo" not in sys.modules
"""


def test_a_diagnosis_is_the_same_by_one_core_as_by_two():
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(CODE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = done.stdout.splitlines()
    assert len(found) == 2, done.stdout
    assert all("['" in one and one.endswith("True True") for one in found), done.stdout
