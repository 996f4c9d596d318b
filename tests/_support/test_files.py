import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from mkc_torch._support.files import claim_folder, folder_held, write_atomically


def contents_of(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(("data", "expected"), [("µT\r\n", "µT\r\n".encode()), (b"\x00\xff", b"\x00\xff")])
def test_text_is_written_as_utf8_and_bytes_as_they_are(tmp_path, data, expected):
    write_atomically(tmp_path / "a", data)
    assert contents_of(tmp_path) == {"a": expected}


def test_a_path_can_be_a_string(tmp_path):
    write_atomically(str(tmp_path / "a"), "x")
    assert contents_of(tmp_path) == {"a": b"x"}


def test_an_existing_file_is_refused_and_untouched(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(FileExistsError, match=r"a exists; use `--force`"):
        write_atomically(tmp_path / "a", "new")
    assert contents_of(tmp_path) == {"a": b"old"}


def test_an_existing_file_is_replaced_on_demand(tmp_path):
    (tmp_path / "a").write_text("old and longer")
    write_atomically(tmp_path / "a", "new", overwrite=True)
    assert contents_of(tmp_path) == {"a": b"new"}


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
@pytest.mark.parametrize("before", [{}, {"a": b"old"}])
def test_a_failed_write_leaves_the_folder_unchanged(tmp_path, monkeypatch, step, error, before):
    for name, data in before.items():
        (tmp_path / name).write_bytes(data)
    seen = []

    def fail(*_):
        seen.append(len(contents_of(tmp_path)) - len(before))
        raise error

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(type(error)):
        write_atomically(tmp_path / "a", "new", overwrite=True)
    assert seen == [1]  # the temporary file was in the target's folder when the step failed
    assert contents_of(tmp_path) == before


@pytest.mark.parametrize(("overwrite", "named"), [(False, "link"), (True, "replace")])
def test_data_reach_the_disk_before_the_name(tmp_path, monkeypatch, overwrite, named):
    steps = []
    for step in ("fsync", "link", "replace"):
        own = getattr(os, step)
        monkeypatch.setattr(os, step, lambda *a, step=step, own=own: (steps.append(step), own(*a)))
    write_atomically(tmp_path / "a", "x", overwrite=overwrite)
    assert steps == ["fsync", named]
    assert contents_of(tmp_path) == {"a": b"x"}


def test_a_file_that_another_process_creates_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    fsync = os.fsync
    monkeypatch.setattr(os, "fsync", lambda handle: (fsync(handle), (tmp_path / "a").write_text("theirs")))
    with pytest.raises(FileExistsError, match=r"a exists; use `--force`"):
        write_atomically(tmp_path / "a", "ours")
    assert contents_of(tmp_path) == {"a": b"theirs"}


def test_a_file_system_without_hard_links_is_written_to(tmp_path, monkeypatch):
    def refused(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    write_atomically(tmp_path / "a", "x")
    assert contents_of(tmp_path) == {"a": b"x"}


HOLD_LOCK = """
import sys
from mkc_torch._support.files import folder_held
with folder_held(sys.argv[1]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_a_folder_is_locked_until_its_process_is_killed(tmp_path):
    left = tmp_path / f".{'0' * 16}.tmp"
    left.write_text("half")
    with subprocess.Popen(
        [sys.executable, "-c", HOLD_LOCK, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "held\n"
        assert not left.exists()
        with pytest.raises(FileExistsError, match="is being written by another mkc; wait"), folder_held(tmp_path):
            pass
        other.kill()
    with folder_held(tmp_path):
        write_atomically(tmp_path / "a", "x")


def test_temporary_files_of_a_killed_process_do_not_count_as_content(tmp_path):
    (tmp_path / f".{'a' * 16}.tmp").write_text("half")
    assert claim_folder(tmp_path) == tmp_path


def test_text_that_cannot_be_encoded_leaves_no_file(tmp_path):
    with pytest.raises(UnicodeEncodeError):
        write_atomically(tmp_path / "a", "\ud800")
    assert contents_of(tmp_path) == {}


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX permissions")
def test_the_file_has_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "plain").write_text("")
    write_atomically(tmp_path / "a", "x")
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no folder .*absent; create it"):
        write_atomically(tmp_path / "absent" / "a", "x")


@pytest.mark.parametrize("target", [".", os.devnull])
def test_a_folder_or_device_is_never_replaced(tmp_path, target):
    with pytest.raises(FileExistsError, match="not a regular file"):
        write_atomically(tmp_path / target, "x", overwrite=True)
    assert not Path(os.devnull).is_file()


def test_claim_folder_creates_it_with_its_parents(tmp_path):
    assert claim_folder(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert (tmp_path / "a" / "b").is_dir()


def test_claim_folder_takes_an_empty_folder(tmp_path):
    assert claim_folder(str(tmp_path)) == tmp_path


def test_claim_folder_refuses_a_folder_that_is_not_empty(tmp_path):
    (tmp_path / "a").write_text("old")
    with pytest.raises(FileExistsError, match=r"not empty; use `--force`"):
        claim_folder(tmp_path)


def test_claim_folder_with_overwrite_removes_nothing(tmp_path):
    (tmp_path / "a").write_text("old")
    assert claim_folder(tmp_path, overwrite=True) == tmp_path
    assert contents_of(tmp_path) == {"a": b"old"}


FILES_OF_MKC = {
    "report.html": "<footer>Made by mkc_torch: method</footer>",
    "model.json": '{\n  "schema": "mkc-model/1",\n',
    "corrected.py": '"""Tank, corrected by what `mkc diagnose` found"""',
}


@pytest.mark.parametrize("name", FILES_OF_MKC)
def test_claim_folder_refuses_to_replace_files_of_the_user(tmp_path, name):
    (tmp_path / name).write_text("mine")
    with pytest.raises(FileExistsError, match=f"{name} exists and was not written by mkc"):
        claim_folder(tmp_path, overwrite=True, files=FILES_OF_MKC)
    assert contents_of(tmp_path) == {name: b"mine"}
    assert claim_folder(tmp_path, overwrite=True, files=["other.html"]) == tmp_path
    (tmp_path / name).write_text(FILES_OF_MKC[name])
    assert claim_folder(tmp_path, overwrite=True, files=FILES_OF_MKC) == tmp_path


def test_an_unmarked_file_counts_as_written_if_a_marked_file_does(tmp_path):
    names = ["recording.csv", "report.html"]
    (tmp_path / "recording.csv").write_text("a\n1\n")
    with pytest.raises(FileExistsError, match=r"recording\.csv exists and was not written by mkc"):
        claim_folder(tmp_path, overwrite=True, files=names)
    (tmp_path / "report.html").write_text(FILES_OF_MKC["report.html"])
    assert claim_folder(tmp_path, overwrite=True, files=names) == tmp_path


@pytest.mark.parametrize("overwrite", [False, True])
def test_claim_folder_refuses_a_file(tmp_path, overwrite):
    (tmp_path / "a").write_text("old")
    with pytest.raises(FileExistsError, match="is a file, not a folder"):
        claim_folder(tmp_path / "a", overwrite=overwrite)
    assert contents_of(tmp_path) == {"a": b"old"}
