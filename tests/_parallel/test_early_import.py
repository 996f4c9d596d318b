"""A module that is loaded while something else goes on."""

import subprocess
import sys
import textwrap

import pytest

from mkc_torch._parallel.early_import import load_early

SLOW = """
import sys, time
from mkc_torch._parallel.early_import import load_early
sys.path.insert(0, sys.argv[1])
usual = sys.getswitchinterval()
load_early("slow_to_load")
"""


def run(code, folder, module="import time\ntime.sleep(0.5)\nready = True\n"):
    (folder / "slow_to_load.py").write_text(module)
    code = SLOW + textwrap.dedent(code)
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, timeout=120)
    assert done.stderr == ""
    assert done.returncode == 0
    return done.stdout.split()


def test_the_module_is_loaded_beside_what_goes_on(tmp_path):
    code = """
    print(hasattr(sys.modules.get("slow_to_load"), "ready"))
    import slow_to_load
    print(slow_to_load.ready)
    """
    assert run(code, tmp_path) == ["False", "True"]


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing is forked")
def test_a_copy_of_the_process_has_all_of_it(tmp_path):
    code = """
    import os
    if not os.fork():
        import slow_to_load
        print(slow_to_load.ready, flush=True)
        os._exit(0)
    os.wait()
    """
    assert run(code, tmp_path) == ["True"]


def test_a_module_that_cannot_be_loaded_says_so_where_it_is_used(tmp_path):
    code = """
    time.sleep(0.5)
    print(sys.getswitchinterval() == usual)
    try:
        import slow_to_load
    except ImportError as error:
        print(error)
    """
    assert run(code, tmp_path, module="raise ImportError('broken')\n") == ["True", "broken"]


def test_what_is_loaded_already_takes_no_thread(monkeypatch):
    monkeypatch.setattr("mkc_torch._parallel.early_import.Thread", None)
    load_early("math")
