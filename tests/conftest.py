"""One thread a worker: results do not depend on it, and workers do not fight over the cores."""

import numpy  # noqa: F401 - its linear algebra can only be limited once it is there

from mkc_torch._processes import one_thread

one_thread()
