"""Processes of the command line's own: they keep their memory, and end without looking at every module again."""

import os
import subprocess
import sys

import pytest
import torch

from mkc_torch._parallel.processes import cores, keep_memory


@pytest.mark.process
def test_what_was_imported_is_out_of_the_collectors_sight_to_the_end():
    code = (
        "import atexit, gc, torch; from mkc_torch._parallel.processes import keep_modules\n"
        "atexit.register(lambda: print('late' if len(gc.get_objects()) < 1000 else 'seen'))\n"
        "keep_modules(); print(gc.get_freeze_count() > 100_000, gc.get_threshold()[0])\n"
    )
    # what is registered last comes first at exit
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert told == ["True", "50000", "late"]


def test_kept_memory_serves_as_before():
    keep_memory()
    values = torch.ones(5_000_000)
    del values
    assert float(torch.ones(5_000_000).sum()) == 5_000_000.0


@pytest.mark.process
def test_linear_algebra_computes_in_one_thread():
    code = (
        "import torch, numpy\nfrom threadpoolctl import threadpool_info\n"
        "from mkc_torch._parallel.processes import one_thread\n"
        "one_thread()\nknown = [i['num_threads'] for i in threadpool_info() if i['user_api'] == 'blas']\n"
        "print(torch.get_num_threads(), len(known) > 0, set(known))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told == "1 True {1}\n"


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


def ask(depth):
    while True:
        with suppress(KeyboardInterrupt):  # one can come between two of these too
            ask(depth - 1) if depth else _processes._stopped()


def asked_again_and_again(item):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # as beside work
    Thread(target=interrupt_and_end).start()
    ask(20)


if __name__ == "__main__":
    try:
        with _processes.in_processes(asked_again_and_again, range(2)) as results:
            for result in results:
                result()
    except (BrokenProcessPool, KeyboardInterrupt):
        print("told")
"""


@pytest.mark.process
@pytest.mark.skipif(cores() < 2 or os.name == "nt", reason="one core, or no such signal")
def test_an_interrupt_where_it_is_asked_whether_to_stop_keeps_nobody_waiting(tmp_path):
    script = tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED)
    told = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60, check=True)
    assert told.stdout == "told\n"
