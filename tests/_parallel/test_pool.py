"""Work is shared by forked workers; the results do not depend on the process."""

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import time

import pytest
import torch

from mkc_torch._parallel import pool
from mkc_torch._parallel.pool import Serializer, allow_copies, shared
from tests.started import started

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="copies are forked on Linux only")

HERE = os.getpid()


@pytest.fixture(autouse=True)
def _two_workers(monkeypatch):
    # copies lack the threads of this process, so no work here computes with large tensors
    allow_copies(2)
    monkeypatch.setattr(pool, "_WORTH_S", -1.0)  # the works here are short
    yield
    allow_copies(0)
    assert multiprocessing.active_children() == []


def slow_work(value):
    """Return work that returns a value and its process, slow enough for other processes to take the next item."""

    def work():
        time.sleep(0.05)
        return value, os.getpid()

    return work


def test_results_are_in_order_and_computed_by_all_workers():
    results = shared([slow_work(k) for k in range(9)])
    assert [value for value, _ in results] == list(range(9))
    assert len({process for _, process in results}) == 3


def test_without_workers_all_work_is_done_in_the_main_process():
    allow_copies(0)
    assert shared([os.getpid, os.getpid]) == [HERE, HERE]


@pytest.mark.parametrize("works", [6, 2])
def test_work_shorter_than_a_fork_is_done_in_the_main_process(works, monkeypatch):
    monkeypatch.setattr(pool, "_WORTH_S", 0.1)
    cheap = [os.getpid] * works
    shared(cheap)  # of two works, the cost has to be known
    assert shared(cheap) == [HERE] * works


def test_nothing_is_forked_on_other_systems_than_linux(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    allow_copies(2)
    assert shared([os.getpid, os.getpid]) == [HERE, HERE]


def test_a_single_work_item_needs_no_worker():
    assert shared([os.getpid]) == [HERE]


def test_workers_fork_no_workers():
    def work():
        time.sleep(0.05)
        return {os.getpid(), *shared([os.getpid, os.getpid])}

    assert all(len(processes) == 1 for processes in shared([work] * 6) if HERE not in processes)


def test_work_with_an_unpicklable_result_is_done_in_the_main_process():
    results = shared([lambda k=k: (os.getpid(), lambda: k) for k in range(6)])
    assert [value() for _, value in results] == list(range(6))
    assert {process for process, _ in results} == {HERE}


def test_work_of_a_killed_worker_is_done_in_the_main_process():
    def dies():
        if os.getpid() != HERE:
            os.kill(os.getpid(), signal.SIGKILL)
        return os.getpid()

    assert shared([dies] * 5) == [HERE] * 5


def test_without_memory_for_a_worker_all_work_is_done_in_the_main_process(monkeypatch):
    def fails():
        raise BlockingIOError

    monkeypatch.setattr(os, "fork", fails)
    assert shared([os.getpid] * 3) == [HERE] * 3


def test_an_error_of_work_is_raised_in_the_main_process():
    def fails():
        raise ArithmeticError(f"in {os.getpid() == HERE}")

    with pytest.raises(ArithmeticError, match="in True"):
        shared([slow_work(1), slow_work(2), slow_work(3), fails])


@pytest.mark.parametrize("most", [0, 2])
def test_results_have_the_same_memory_layout_from_any_process(most):
    allow_copies(most)
    known, whole = object(), torch.arange(1000.0).double()

    def work():
        return known, whole[3:5], whole[7], whole[:4].reshape(2, 2).mT > 1.0

    for result in shared([work] * 6, [known]):
        assert result[0] is known
        assert result[1].tolist() == [3.0, 4.0]
        assert result[2].dtype == torch.float64
        assert float(result[2]) == 7.0
        assert result[3].tolist() == [[False, True], [False, True]]
        # not a view, and aligned as by torch
        assert result[1].untyped_storage().nbytes() == 16
        assert all(tensor.data_ptr() % 64 == 0 for tensor in result[1:])


def test_known_objects_are_pickled_by_their_number():
    local = type("Local", (), {})  # no module holds it by its name
    known = [local(), local()]
    parcel = Serializer(known).packed({"known": known[1], "none": None})
    assert Serializer(["other", "another"]).unpacked(parcel) == {"known": "another", "none": None}
    with pytest.raises(pickle.PicklingError, match="Local"):
        Serializer().packed(known[1])


def test_workers_are_ended_after_the_work():
    shared([slow_work(k) for k in range(5)])
    assert multiprocessing.active_children() == []


KILLED_PARENT = """
import os, signal, sys, time
from mkc_torch._parallel.pool import allow_copies, shared

def work():
    print(flush=True)
    time.sleep(600)

allow_copies(1)
try:
    shared([work] * 2)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_killed_main_process_ends_its_workers(number):
    with started("-c", KILLED_PARENT) as process:
        assert process.stdout is not None
        for _ in range(2):
            process.stdout.readline()
        # a terminal interrupts all of them
        os.killpg(process.pid, number) if number == signal.SIGINT else process.kill()
        # the copies share its streams, which close when the last copy ends
        output, errors = process.communicate(timeout=60)
    assert output == ("interrupted\n" if number == signal.SIGINT else "")
    assert errors == ""


CODE = """
    import json, math, os, sys, torch
    from mkc_torch import Recording, diagnose
    from mkc_torch._parallel import pool
    from mkc_torch._parallel.pool import allow_copies
    from mkc_torch._parallel.processes import one_thread
    from mkc_torch.recording.demonstration import simulated_recording
    from mkc_torch.diagnosis.io.diagnosis_json import diagnosis_to_json
    from mkc_torch.simulation import Dynamics, Magnetometer

    one_thread()
    pool._WORTH_S = -1.0  # share small tasks as well

    def alike(first, second):
        # a process repeats a diagnosis up to rounding only, which fits and open-loop runs amplify;
        # results of another task would differ more. Values that are not numbers must be equal.
        if isinstance(first, dict):
            return first.keys() == second.keys() and all(alike(first[key], second[key]) for key in first)
        if isinstance(first, list):
            return len(first) == len(second) and all(map(alike, first, second))
        if isinstance(first, float):
            return math.isclose(first, second, rel_tol=1e-6, abs_tol=1e-9)
        return first == second

    class Cart(Dynamics):
        states = ("place", "speed")
        inputs = ("force",)
        parameters = {"damping": 0.5}

        def derivative(self, time, x, u, p):
            return {"place": x.speed, "speed": u.force - p.damping * x.speed}

    time = torch.arange(0.0, 4.0, 0.02, dtype=torch.float64)
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
        results = []
        for copies in (0, 1):
            allow_copies(copies)
            diagnosis = diagnose(simulation, recording, max_findings=1)
            results.append(diagnosis_to_json(diagnosis))
        same = alike(*map(json.loads, results))
        print([f.effect for f in diagnosis.findings], same, len(forks) > 3)
        forks.clear()
        # an import of 1 s for a constant in a differentiated expression, which torch 2.6 also does for other reasons;
        # a user's equations may have such constants
        old = tuple(map(int, torch.__version__.split(".")[:2])) < (2, 7)
        assert old or isinstance(simulation, Dynamics) or "torch._dynamo" not in sys.modules
"""


@pytest.mark.process
def test_a_diagnosis_does_not_depend_on_the_number_of_cores():
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(CODE)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = done.stdout.splitlines()
    assert len(found) == 2, done.stdout
    assert all("['" in line and line.endswith("True True") for line in found), done.stdout
