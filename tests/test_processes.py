"""Processes of the command line's own: they keep their memory, and end without looking at every module again."""

import subprocess
import sys

import torch

from mkc_torch._processes import keep_memory


def test_what_was_imported_is_out_of_the_collectors_sight_to_the_end():
    code = (
        "import atexit, gc, torch; from mkc_torch._processes import keep_modules\n"
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


def test_linear_algebra_computes_in_one_thread():
    code = (
        "import torch, numpy\nfrom threadpoolctl import threadpool_info\nfrom mkc_torch._processes import one_thread\n"
        "one_thread()\nknown = [i['num_threads'] for i in threadpool_info() if i['user_api'] == 'blas']\n"
        "print(torch.get_num_threads(), len(known) > 0, set(known))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert told == "1 True {1}\n"
