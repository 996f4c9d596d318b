import json
import math
from html.parser import HTMLParser

import pytest
import torch

pytest.importorskip("polars")
pytest.importorskip("jinja2")
pytest.importorskip("matplotlib")

from mkc_torch.challenge.key import digest
from mkc_torch.challenge.magnetometer.subject import magnetometer
from mkc_torch.challenge.run import run_challenge
from mkc_torch.recording.recording import Recording

DURATION = 10.0


def diagnose(paths, folder):
    """Report every second recording as adequate, fail at the end, and check that the key is hidden."""
    output = folder.parent
    assert (output / "key_hash.txt").is_file()
    assert not (output / "key.json").exists()
    for path in paths:
        if int(path.stem[-1]) % 2:
            (folder / path.stem).mkdir()
            reported = {"verdict": "adequate", "p_value": 0.5, "findings": []}
            (folder / path.stem / "diagnosis.json").write_text(json.dumps(reported))
            (folder / path.stem / "model.json").write_text("{}")
    raise RuntimeError("no more")


def apply(model, path):
    assert model.is_file()
    recording = Recording.read(path)
    return {f"field_{axis}": recording[f"mag_{axis}"] for axis in "xyz"}


@pytest.fixture(scope="module", params=[1, pytest.param(2, marks=pytest.mark.process)])
def run(request, tmp_path_factory):
    output = tmp_path_factory.mktemp("challenge") / "out"
    reported = []
    result = run_challenge(
        diagnose, apply, cases=3, empty=3, seed=3, output=output, workers=request.param, subject=magnetometer(DURATION),
        progress=lambda stage, done, total: reported.append((stage, done, total)),
    )  # fmt: skip
    return result, output, reported


def test_the_hash_matches_the_key(run):
    _, output, _ = run
    assert digest((output / "key.json").read_text().rstrip("\n")) == (output / "key_hash.txt").read_text().strip()


def test_recordings_do_not_reveal_the_hidden_physics(run):
    _, output, _ = run
    names = sorted(path.name for path in (output / "recordings").iterdir())
    assert names == [f"case_{k:05d}.csv" for k in range(6)]
    assert len(list((output / "second").iterdir())) == 3


def test_what_failed_is_scored_as_failed(run):
    result, output, _ = run
    assert result.failed == ("case_00000", "case_00002", "case_00004")
    assert (sum(result.verdicts.values()), result.verdicts["failed"]) == (3, 3)
    assert result.false_alarms.total == 0
    assert "no more" in next((output / "diagnoses").glob("*.error.txt")).read_text()


def test_progress_covers_each_stage(run):
    _, _, reported = run
    assert {stage for stage, done, total in reported if done == total} == {
        "draw", "diagnose", "second recordings", "baseline",
    }  # fmt: skip


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open = []

    def handle_starttag(self, tag, _):
        assert tag not in ("script", "link", "img")
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_startendtag(self, *_):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_loads_nothing(run):
    _, output, _ = run
    tags = Tags()
    page = (output / "challenge.html").read_text(encoding="utf-8")
    tags.feed(page)
    assert tags.open == []
    assert page.count("<svg") == 3
    assert "thresholds hold" in page


def test_summary_and_score_are_written(run):
    _, output, _ = run
    assert "| threshold | measured | holds |" in (output / "summary.md").read_text(encoding="utf-8")
    assert "| empty recordings: unexplained | 0 | 0 |" in (output / "summary.md").read_text(encoding="utf-8")
    record = json.loads((output / "score.json").read_text())
    assert record["settings"]["seed"] == 3
    assert sum(record["score"]["verdicts"].values()) == 3


def test_the_same_seed_gives_the_same_key(run, tmp_path):
    _, output, _ = run
    run_challenge(diagnose, apply, cases=3, empty=3, seed=3, output=tmp_path / "again", subject=magnetometer(DURATION))
    assert (tmp_path / "again" / "key_hash.txt").read_text() == (output / "key_hash.txt").read_text()


def test_a_folder_in_use_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError, match="not empty"):
        run_challenge(diagnose, apply, cases=1, empty=1, output=tmp_path)


def test_default_is_five_empty_for_three_hidden(tmp_path):
    result = run_challenge(diagnose, apply, cases=3, output=tmp_path / "out", subject=magnetometer(DURATION))
    assert sum(result.verdicts.values()) == 5
    assert all(math.isfinite(p) for p in result.p_values)
    assert torch.get_num_threads() == 1
