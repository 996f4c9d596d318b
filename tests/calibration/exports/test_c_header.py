import shutil
import subprocess

import numpy as np
import pytest

from mkc_torch.calibration.exports import EXPORTS, CurrentCoefficients, Destination, SensorCorrection

COMPILER = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
MATRIX = ((0.95, -0.03, 0.019), (-0.03, 1.06, -0.016), (0.02, -0.016, 0.997))
OFFSET = (119.7, -75.02, 1209.95)

MAIN = """
#include <stdio.h>
#include "mag_calibration.h"
#include "mag_calibration.h"

int main(void)
{
    float v[4];
    while (scanf("%%f %%f %%f %%f", &v[0], &v[1], &v[2], &v[3]) == 4) {
        mag_correct(v, %s v);
        printf("%%.9g %%.9g %%.9g\\n", v[0], v[1], v[2]);
    }
    return 0;
}
"""

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler here")


def run_compiled_header(correction, rows, folder, argument):
    """The field that the compiled function computes from readings and currents."""
    text = EXPORTS["c-header"].text(correction, Destination()).text
    (folder / "mag_calibration.h").write_text(text, encoding="utf-8")
    (folder / "main.c").write_text(MAIN % argument, encoding="utf-8")
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run([COMPILER, *strict, "main.c", "-o", "main"], cwd=folder, check=True, timeout=60)
    given = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in rows)
    done = subprocess.run([folder / "main"], input=given, capture_output=True, text=True, check=True, timeout=60)
    return np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()])


@pytest.mark.parametrize("unit", ["mG", "counts per µT */ #error"])
def test_the_compiled_function_gives_the_field(tmp_path, unit):
    rows = np.random.default_rng(0).normal(size=(40, 4)) * 500.0
    found = run_compiled_header(SensorCorrection("mast", unit, OFFSET, MATRIX, unit), rows, tmp_path, "")
    expected = (rows[:, :3] - np.array(OFFSET)) @ np.array(MATRIX).T
    assert np.abs(found - expected).max() < 0.1 * 0.01  # mG: a tenth of 0.01 µT is 0.1 mG


def test_the_compiled_function_takes_off_the_field_of_a_current(tmp_path):
    k, mean = (3.1, -2.2, 4.7), 12.5
    rows = np.random.default_rng(1).normal(size=(40, 4)) * np.array([500.0, 500.0, 500.0, 20.0])
    correction = SensorCorrection("mast", "mG", OFFSET, MATRIX, "mG", None, CurrentCoefficients(k, mean, "current"))
    found = run_compiled_header(correction, rows, tmp_path, "v[3],")
    away = rows[:, :3] - np.array(OFFSET) - (rows[:, 3:] - mean) * np.array(k)
    assert np.abs(found - away @ np.array(MATRIX).T).max() < 0.1 * 0.01
