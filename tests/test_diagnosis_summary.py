import dataclasses
import io
from pathlib import Path

import pytest

pytest.importorskip("rich")

from rich.console import Console

from mkc_torch._commands.diagnosis_summary import show
from mkc_torch.diagnosis.result import Region
from tests.diagnosis.factory import make_diagnosis


def shown(diagnosis, files=(), *, width=100, terminal=False):
    stream = io.StringIO()
    console = Console(file=stream, width=width, force_terminal=terminal, highlight=False)
    show(console, diagnosis, [Path(file) for file in files])
    return stream.getvalue()


def flat(text):
    return " ".join(text.split())


def test_a_finding_in_a_dozen_lines():
    text = shown(make_diagnosis(1), ["out/flight_07/diagnosis.json"])
    assert len(text.strip().splitlines()) <= 15
    for words in (
        "flight_07 against magnetometer",
        "Left out of the simulation: hard-iron step or current field (current)",
        "size offset change (3.214 ± 0.081, −1.104 ± 0.077, 0.325 ± 0.092) µT onset 41.32 ± 0.14 s",
        "where from 41.3 s on; acts on mag_x, mag_y, mag_z",
        "driven by no recorded column",
        "how sure p = 0.005, the smallest that 199 surrogates can show",
        "held out +0.312 nats a sample (95 %: 0.281 to 0.350), residual 0.912 → 0.521 µT (43 % less)",
        "or current field (current): this recording cannot tell",
        "ceiling a smooth correction by all columns and by time reaches",
        "noise autoregressive: noise with a memory",
        "to do Record at two more temperatures",
        "warning 3 samples",
        "written out/flight_07/diagnosis.json",
    ):
        assert words in flat(text)


def test_where_in_the_states_a_finding_lies():
    made = make_diagnosis(1)
    region = Region("speed", "rad/s", "near zero", 0.31, 0.82, 0.2)
    finding = dataclasses.replace(made.findings[0], region=region, experiments=(0.9, 0.1))
    text = flat(shown(dataclasses.replace(made, findings=(finding,))))
    assert "mostly 82 % of the gain where speed is within ±0.310 rad/s, 20 % of the time" in text
    assert "in experiment 1: 90 %, experiment 2: 10 %" in text


def test_nothing_found():
    text = flat(shown(make_diagnosis(0)))
    assert "Nothing is missing that this recording could show." in text
    assert "how sure p = 0.37; 64 candidates tried, level 0.05" in text
    assert "to do Use the simulation as it is" in text


def test_several_findings_are_numbered():
    text = shown(make_diagnosis(3))
    for line in ("1  hard-iron step", "2  current field (current)", "3  an effect outside the catalogue (temperature)"):
        assert line in text.splitlines()
    assert "doubtful A curve has no size to compare." in flat(text)
    assert "together residual" in flat(text)
    assert "less) Blocks of 4 s with gaps of 1 s." in flat(text)


def test_structure_that_remains():
    text = flat(shown(make_diagnosis(0, verdict="unexplained", p_value=0.005)))
    assert "Structure remains that no effect in the catalogue accounts for." in text


def test_texts_from_files_neither_style_nor_steer_the_terminal():
    diagnosis = make_diagnosis(1, recording="[red]a[/red]\x1b[2J", warnings=("[/] \x1b]0;x\x07", "x" * 300))
    first = dataclasses.replace(diagnosis.findings[0], drivers=("[b]\x1b[2J",))
    text = shown(dataclasses.replace(diagnosis, findings=(first,)))
    assert "\x1b" not in text
    assert "\x07" not in text
    assert "[red]a[/red]" in text
    assert "[/]" in text


def test_long_paths_stay_on_one_line_and_many_warnings_are_counted():
    path = "folder/" * 20 + "report.html"
    text = shown(make_diagnosis(0, warnings=tuple(f"warning {i}" for i in range(40))), [path], width=80)
    assert any(line.endswith(path) for line in text.splitlines())
    assert "34 more; see the report" in flat(text)


@pytest.mark.parametrize("width", [40, 60, 200])
def test_every_width(width):
    text = shown(make_diagnosis(3), width=width, terminal=True)
    assert "hard-iron step" in text


def test_without_a_ceiling_there_is_no_line_of_it():
    assert "ceiling" not in shown(make_diagnosis(1, ceiling=None))
