"""Fuzz the readers of recordings by atheris and libFuzzer: `python -m tests.fuzz.readers --minutes N`.

Each format gets an equal share of the time, in its own process, and starts from a valid file of its kind. A crash is
any outcome other than rows or an error meant for the user; so is the end of the process, and a file that takes
a minute. Inputs that crash are kept in the folder that `--output` names.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.recording.formats import writers
from tests.recording.formats.writers import Samples, samples

LONGEST = 65536
"""Bytes; the smallest database is half of it."""

PATIENCE = 60
"""Seconds for one input."""


def _parquet(path: Path, given: Samples) -> None:
    import polars

    polars.DataFrame({"time": given.time, "mag_x": given.mag[:, 0]}).write_parquet(path)


def _mat73(path: Path, given: Samples) -> None:
    writers.mat73(path, given)


SEEDS: dict[str, list[Callable[[Path, Samples], None]]] = {
    ".csv": [writers.csv],
    ".parquet": [_parquet],
    **{ending: [write] for ending, write in writers.WRITERS.items()},
    ".mdf": [lambda path, given: writers.mdf(path, given, "3.30")],
}
SEEDS[".mat"].append(_mat73)
SEEDS[".mcap"] += [
    lambda path, given, encoding=encoding: writers.mcap_of(path, given, encoding, "NONE")
    for encoding in ("ros1", "json", "protobuf")
]
SEEDS[".bag"].append(lambda path, given: writers.rosbag1(path, given, "lz4"))


def main() -> None:
    """Fuzz all formats, or those named, in turn, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--output", type=Path, default=Path("crashes"))
    parser.add_argument("--only", nargs="*", choices=sorted(SEEDS), default=sorted(SEEDS))
    parser.add_argument("--child", choices=sorted(SEEDS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        fuzz(options.child, options.output, 60.0 * options.minutes)
        return
    try:
        import atheris  # noqa: F401 - tests whether it is installed
    except ImportError:
        print("atheris is not installed, so that nothing is fuzzed; it is part of the extra dev, on Linux.")
        return
    share = options.minutes / len(options.only)
    tried = crashed = 0
    print(f"{'format':<10}{'inputs':>10}{'rows':>10}{'crashes':>10}", flush=True)
    for ending in options.only:
        found = counts_of(ending, options.output, share)
        tried += found["tried"]
        crashed += found["crashed"]
        print(f"{ending:<10}{found['tried']:>10,}{found['rows']:>10,}{found['crashed']:>10,}", flush=True)
    print(f"{'all':<10}{tried:>10,}{'':>10}{crashed:>10,}")
    sys.exit(1 if crashed else 0)


def counts_of(ending: str, output: Path, minutes: float) -> dict[str, int]:
    """Fuzz a format until its time is over; a process that crashes is restarted. Returns its counts."""
    folder = output / ending.lstrip(".")
    folder.mkdir(parents=True, exist_ok=True)
    total = {"tried": 0, "rows": 0, "crashed": 0}
    left = minutes
    while left > 0.02:
        command = [sys.executable, "-m", "tests.fuzz.readers", "--child", ending, "--minutes", str(left)]
        done = subprocess.run([*command, "--output", str(folder)], capture_output=True, text=True, check=False)
        counts = folder / "counts.json"
        found = json.loads(counts.read_text(encoding="utf-8")) if counts.exists() else {**total, "seconds": 60 * left}
        counts.unlink(missing_ok=True)
        ended = done.returncode != 0
        if ended:
            (folder / "ended.txt").write_text(done.stderr[-20_000:], encoding="utf-8")
        for key in total:
            total[key] += int(found[key])
        total["crashed"] += ended
        left -= max(float(found["seconds"]) / 60.0, 0.05)
        if not ended:
            break
    return total


def fuzz(ending: str, folder: Path, seconds: float) -> None:
    """Run libFuzzer on the reader of a format; does not return."""
    import atheris

    packages = ["mkc_torch.recording", "pyulog", "mcap", "rosbags.typesys", "scipy.io", "h5py"]
    with atheris.instrument_imports(include=packages):
        from mkc_torch.recording.formats import RecordingError, read_topics
    import time

    begin = time.monotonic()
    counts: dict[str, Any] = {"tried": 0, "rows": 0, "crashed": 0, "seconds": 0.0}
    known: set[str] = set()
    work = Path(tempfile.mkdtemp(prefix="mkc_fuzz_"))
    path = work / f"input{ending}"

    def save() -> None:
        counts["seconds"] = time.monotonic() - begin
        (folder / "counts.json").write_text(json.dumps(counts), encoding="utf-8")

    def read_input(data: bytes) -> None:
        counts["tried"] += 1
        path.write_bytes(data)
        try:
            read_topics(path)
            counts["rows"] += 1
        except (RecordingError, FileNotFoundError, ImportError):
            pass
        except BaseException as error:  # a crash: kept, and the search goes on
            counts["crashed"] += 1
            place = f"{type(error).__name__} {traceback.format_tb(error.__traceback__)[-1]}"
            if place not in known:
                known.add(place)
                (folder / f"crash_{len(known)}{ending}").write_bytes(data)
                (folder / f"crash_{len(known)}.txt").write_text("".join(traceback.format_exception(error)))
        if counts["tried"] % 50 == 0 or time.monotonic() - begin > seconds - 1.0:
            save()

    corpus = work / "corpus"
    corpus.mkdir()
    for place, write in enumerate(SEEDS[ending]):
        write(work / f"seed{ending}", samples(12))
        (work / f"seed{ending}").rename(corpus / f"seed{place}")
    limits = [f"-max_total_time={int(seconds)}", f"-timeout={PATIENCE}", "-rss_limit_mb=4096", f"-max_len={LONGEST}"]
    atheris.Setup([sys.argv[0], *limits, f"-artifact_prefix={folder}/", str(corpus)], read_input)
    save()
    atheris.Fuzz()


if __name__ == "__main__":
    main()
