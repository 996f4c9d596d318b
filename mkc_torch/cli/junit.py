"""Checks as JUnit XML, which build servers show: a test case for each output of each recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from mkc_torch._support.files import write_atomically
from mkc_torch._support.typesetting import plain
from mkc_torch.cli.check_files import CheckedFile
from mkc_torch.diagnosis import RecordingCheck
from mkc_torch.report.check import sentences


def write_junit(path: Path, checked: Sequence[CheckedFile], *, overwrite: bool) -> None:
    """Write the checks as JUnit XML.

    Raises:
        FileExistsError: the file exists and ``overwrite`` is False.
        OSError: the file cannot be written.
    """
    write_atomically(path, junit_xml(checked), overwrite=overwrite)


def junit_xml(checked: Sequence[CheckedFile]) -> str:
    """Return the JUnit XML of checks.

    A recording that could not be checked is an error; an output in which the model does not hold, and a recording that
    was used in the fit, are failures.

    Example:
        >>> junit_xml([CheckedFile(Path("new.csv"), None, error="new.csv: there is no such file.")]).count("<error")
        1
    """
    suite = ElementTree.Element("testsuite", name="mkc check")
    for file in checked:
        if file.check is None:
            case = ElementTree.SubElement(suite, "testcase", classname="mkc check", name=file.path.name)
            ElementTree.SubElement(case, "error", message=plain(file.error))
            continue
        for number in range(len(file.check.outputs)):
            _add_output(suite, file.path.name, file.check, number)
    kinds = {kind: len(suite.findall(f"./testcase/{kind}")) for kind in ("failure", "error")}
    counts = {"tests": len(suite), "failures": kinds["failure"], "errors": kinds["error"], "skipped": 0}
    for name, count in counts.items():
        suite.set(name, str(count))
    ElementTree.indent(suite)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(suite, encoding="unicode") + "\n"


def _add_output(suite: ElementTree.Element, name: str, check: RecordingCheck, number: int) -> None:
    each = check.outputs[number]
    case = ElementTree.SubElement(
        suite, "testcase", classname=f"mkc check.{plain(check.simulation)}", name=f"{name}: {plain(each.output)}"
    )
    failure = check.reasons[0] if check.used_in_fit else each.failure
    if failure:
        ElementTree.SubElement(case, "failure", message=plain(failure), type=check.verdict)
    lines = (
        f"RMSE without findings {sentences.rmse(each.baseline, each.unit)}, with findings "
        f"{sentences.rmse(each.corrected, each.unit)}, ratio {sentences.ratio(each.ratio)}",
        sentences.how(check),
    )
    ElementTree.SubElement(case, "system-out").text = "\n".join(lines)
