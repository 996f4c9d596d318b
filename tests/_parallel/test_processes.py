"""Processes of the command line keep freed memory and exclude modules from garbage collection."""

import os
import subprocess
import sys

import pytest
import torch

from mkc_torch._parallel import processes as _processes
from mkc_torch._parallel.processes import cores, keep_memory


@pytest.mark.process
def test_imported_modules_are_excluded_from_garbage_collection_until_exit():
    code = (
        "import atexit, gc, torch; from mkc_torch._parallel.processes import keep_modules\n"
        "atexit.register(lambda: print('late' if len(gc.get_objects()) < 1000 else 'seen'))\n"
        "keep_modules(); print(gc.get_freeze_count() > 100_000, gc.get_threshold()[0])\n"
    )
    # exit handlers run in reverse order of registration
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert output == ["True", "50000", "late"]


def test_tensors_work_with_kept_memory():
    keep_memory()
    values = torch.ones(5_000_000)
    del values
    assert float(torch.ones(5_000_000).sum()) == 5_000_000.0


@pytest.mark.process
def test_linear_algebra_uses_a_single_thread():
    code = (
        "import torch, numpy\nfrom threadpoolctl import threadpool_info\n"
        "from mkc_torch._parallel.processes import one_thread\n"
        "one_thread()\nknown = [i['num_threads'] for i in threadpool_info() if i['user_api'] == 'blas']\n"
        "print(torch.get_num_threads(), len(known) > 0, set(known))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output == "1 True {1}\n"


INTERRUPTED = """
import os, signal, time
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from threading import Thread

from mkc_torch._parallel import processes as _processes


def interrupt_and_end():
    time.sleep(0.5)
    for _ in range(400):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1e-4)
    os.kill(os.getpid(), signal.SIGKILL)


def check(depth):
    while True:
        with suppress(KeyboardInterrupt):  # an interrupt can come between two of them
            check(depth - 1) if depth else _processes._stopped()


def check_repeatedly(item):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # as during work
    Thread(target=interrupt_and_end).start()
    check(20)


if __name__ == "__main__":
    try:
        with _processes.in_processes(check_repeatedly, range(2)) as results:
            for result in results:
                result()
    except (BrokenProcessPool, KeyboardInterrupt):
        print("stopped")
"""


@pytest.mark.process
@pytest.mark.skipif(cores() < 2 or os.name == "nt", reason="one core, or no such signal")
def test_interrupt_while_reading_the_stop_flag_does_not_block(tmp_path):
    script = tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "stopped\n"


DYING = """
import os, signal
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from mkc_torch._parallel.processes import in_processes


def work(item):
    name, folder, times = item
    begun = len(list(Path(folder).glob(f"{name}_*")))
    (Path(folder) / f"{name}_{begun}").touch()
    if begun < times:
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "wrong":
        raise ValueError("own error")
    return name, begun


if __name__ == "__main__":
    import sys
    items = [(name, sys.argv[1], times) for name, times in (("a", 0), ("dies", 1), ("wrong", 0), ("lost", 9), ("b", 0))]
    with in_processes(work, items, 2) as results:
        for result in results:
            try:
                print(*result())
            except (ValueError, BrokenProcessPool) as error:
                print(type(error).__name__)
"""


@pytest.mark.process
def test_items_of_a_process_that_dies_are_processed_once_more(tmp_path):
    script, folder = tmp_path / "dying.py", tmp_path / "begun"
    script.write_text(DYING)
    folder.mkdir()
    command = [sys.executable, str(script), str(folder)]
    output = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout.splitlines()
    names = [line.split()[0] for line in output]
    assert names == ["a", "dies", "ValueError", "BrokenProcessPool", "b"]
    assert output[1] == "dies 1"


def test_a_single_worker_is_this_process():
    with _processes.in_processes(lambda _: os.getpid(), range(3), 1) as results:
        assert {result() for result in results} == {os.getpid()}
