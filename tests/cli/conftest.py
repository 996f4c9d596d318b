"""Commands in the tests' own process write no line of progress, which depends on how busy the machine is."""

import pytest

from mkc_torch.cli import console


@pytest.fixture(scope="session", autouse=True)
def _no_lines_of_progress():
    before, console._FIRST_LINE_S = console._FIRST_LINE_S, 3600.0
    yield
    console._FIRST_LINE_S = before
