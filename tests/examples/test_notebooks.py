"""The notebooks run on simulated recordings, and are stored without outputs."""

import json
import re
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "examples" / "notebooks").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_there_are_notebooks_for_networks_sensors_and_simulations():
    assert [path.stem for path in NOTEBOOKS] == ["network", "sensor", "simulation"]


@each_notebook
def test_notebooks_are_stored_without_outputs_and_local_paths(path):
    text = path.read_text(encoding="utf-8")
    content = json.loads(text)
    for cell in content["cells"]:
        assert not cell.get("outputs")
        assert cell.get("execution_count") is None
    assert not re.search(r"/(home|root|tmp|work|Users)/|[A-Z]:\\", text)
    assert set(content["metadata"]) == {"kernelspec", "language_info"}


@pytest.mark.manual
@each_notebook
def test_every_cell_runs(path, tmp_path, monkeypatch):
    """The cells run as plain Python in this process, with their assertions, without a kernel."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.chdir(tmp_path)
    names = {"__name__": path.stem}
    try:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), path.name, "exec"), names)
        assert len(pyplot.get_fignums()) >= 1
    finally:
        pyplot.close("all")


@pytest.mark.slow
@each_notebook
def test_a_kernel_shows_pictures_and_tables(path, tmp_path):
    nbformat, client = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    pytest.importorskip("matplotlib")
    notebook = nbformat.read(path, as_version=4)
    client.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    if path.stem != "network":  # recordings and results show themselves as tables
        assert sum("<table" in output.get("data", {}).get("text/html", "") for output in outputs) == 2
    reported = "".join(output.get("text", "") for output in outputs if output.output_type == "stream")
    assert reported
    assert "Warning" not in reported
