"""The figures and tables of Li et al. (2023) at a small size; ``python examples/paper/all.py`` makes the full ones."""

import importlib.util
import math
import re
from pathlib import Path

import pytest
import torch

from mkc_torch import Recording
from mkc_torch.calibration.coverage import fibonacci_sphere
from mkc_torch.linear import MKCRegression
from mkc_torch.recording.recording import write_table
from tests.examples.test_lel_examples import FOLDER, assert_is_picture, example, run


def test_figure_2_shows_a_density_that_converges_to_the_gaussian():
    module = example("figures_2_3")
    assert module.gap(100.0) < 1e-4 < module.gap(3.0)


def test_figure_3_shows_a_density_near_the_maximum_likelihood():
    module = example("figures_2_3")
    e = module.residuals(0.2, 50, 1000, torch.Generator().manual_seed(1))
    fit = module.fit_density(e, d=1.0, bound=module.BOUND_3)
    assert float(module.mean_log_density(e, fit.sigma).mean()) > module.entropy(0.2) - 0.04


@pytest.mark.manual
def test_figures_4_to_6_order_the_bandwidths_of_both_channels(monkeypatch, capsys, tmp_path):
    run(example("figures_4_to_6"), monkeypatch, "--draws", 8, "--output", tmp_path)
    printed = " ".join(capsys.readouterr().out.split())
    assert "σ of channel 1 is less than that of channel 2 in 8 of 8 draws" in printed
    for name in ("figure_4.png", "figure_5.png", "figure_6.png"):
        assert_is_picture(tmp_path / name)


def test_algorithm_3_converges_within_three_iterations_to_the_mkc_em_estimate():
    module = example("figures_4_to_6")
    X, Y = module.example_2(20, torch.Generator().manual_seed(2))
    path = module.algorithm_3(X, Y, 20.0, torch.tensor([1.0, 2.0]).double(), 8)
    left = (path.theta - path.theta[-1]).norm(dim=-1)
    assert float(left[3].max()) < 1e-3 < float(left[0].min())
    fit = MKCRegression(bound=path.bound).fit(X, Y)
    assert float((fit.coef_ - path.theta[-1]).abs().median()) < 1e-4


@pytest.mark.manual
def test_the_error_over_the_bandwidth_falls_and_then_rises_to_that_of_wls():
    module = example("figures_4_to_6")
    console = module.Console(quiet=True)
    _, curves = module.show_figure_4(console, 30, torch.Generator().manual_seed(0))
    curve, wls = curves["least_squares"], float(curves["WLS"])
    best = int(curve.argmin())
    assert 0 < best < len(curve) - 1
    assert float(curve[best]) < 0.3 * wls
    assert float(curve[-1]) == pytest.approx(wls, rel=0.01)


def test_the_error_bound_holds_at_every_bandwidth(monkeypatch, capsys, tmp_path):
    run(example("error_bound"), monkeypatch, "--draws", 5, "--grid", 400, "--output", tmp_path / "a.png")
    printed = " ".join(capsys.readouterr().out.split())
    assert "the bound holds at every bandwidth" in printed
    confirmed, cases = map(int, re.search(r"confirms (\d+) of (\d+) worst", printed).groups())
    assert confirmed == cases > 30
    assert_is_picture(tmp_path / "a.png")


@pytest.mark.manual
def test_table_1_has_the_published_error_of_wls(monkeypatch, capsys):
    module = example("table_1")
    run(module, monkeypatch, "--draws", 20, "--timed", 1)
    printed = capsys.readouterr().out
    assert "Table I" in printed
    assert "(0.0395 ± 0.0259)" in printed
    Y = module.targets(module.CASES[1], 400, torch.Generator().manual_seed(0))
    assert float(module.errors("WLS", Y).mean()) == pytest.approx(module.PAPER[1][0][0], abs=0.003)


@pytest.fixture
def recordings(tmp_path) -> tuple[Path, Path]:
    """Write a disturbed and an undisturbed recording of a simulated sensor."""
    g = torch.Generator().manual_seed(0)
    paths = tmp_path / "disturbed.csv", tmp_path / "undisturbed.csv"
    for path in paths:
        points = 45.0 * fibonacci_sphere(600).double() * torch.tensor([0.95, 1.0, 1.05])
        points = points[torch.randperm(600, generator=g)] + torch.tensor([1.0, -2.0, 3.0])
        points += 0.3 * torch.randn(600, 3, generator=g).double()
        if path == paths[0]:
            points[200:230, 2] += 25.0
        columns = {
            "time": torch.arange(600).double() / 50,
            **dict(zip(("mag_x", "mag_y", "mag_z"), points.T, strict=True)),
        }
        write_table(path, columns)
    assert len(Recording.read(paths[0])) == 600
    return paths


def test_figure_7_has_a_small_error_of_mkc_em_on_a_disturbed_recording(monkeypatch, capsys, tmp_path, recordings):
    run(example("figure_7"), monkeypatch, *recordings, "--output", tmp_path / "a.png")
    printed = capsys.readouterr().out
    rows = {m[1]: float(m[2]) for m in re.finditer(r"│ ([\w-]+) +│ +([\d.]+) │", printed)}
    assert rows["MKC-EM"] < 0.4 < rows["WLS"]
    assert_is_picture(tmp_path / "a.png")


@pytest.mark.manual
def test_the_comparison_prints_efficiencies_and_writes_a_page(monkeypatch, capsys, tmp_path):
    module = example("comparison")
    few = [e for e in module.ENTRIES if e.name.startswith(("LeastSquares", "MEstimator huber", "RANSAC", "MKC"))]
    monkeypatch.setattr(module, "ENTRIES", tuple(few))
    run(module, monkeypatch, "--draws", 4, "--curve-draws", 2, "--output", tmp_path)
    printed = capsys.readouterr().out
    assert "MKC-EM's Gaussian efficiency" in printed
    assert "Hough voting" in printed
    assert_is_picture(tmp_path / "comparison.png")
    page = (tmp_path / "comparison.md").read_text(encoding="utf-8")
    assert all(f"| {e.name} |" in page for e in few)
    least = next(line for line in page.splitlines() if line.startswith("| LeastSquares |"))
    assert "| 100.0 ± 0.0 | 5 % | 5 % |" in least


def test_the_comparison_has_every_linear_estimator():
    import mkc_torch.linear as linear

    module = example("comparison")
    names = " ".join(e.name for e in module.ENTRIES)
    for name in linear.__all__:
        assert name in names or name.endswith("Error")
    X, Y = module.draw(2, torch.Generator().manual_seed(0))
    for entry in module.ENTRIES:
        assert entry.fit(X, Y).shape == (2, 4)


@pytest.mark.skipif(importlib.util.find_spec("skimage") is None, reason="scikit-image is not installed")
def test_hough_voting_finds_a_line():
    x = torch.linspace(-3, 3, 200).double()
    found = example("comparison").hough_line(x, 1 + 2 * x)
    assert found == pytest.approx((1.0, 2.0), abs=0.05)


def test_mkc_em_loses_less_than_one_per_cent_on_gaussian_data():
    module = example("comparison")
    X, Y = module.draw(200, torch.Generator().manual_seed(3))
    least, em = (module.errors(e, X, Y) for e in (module.ENTRIES[0], module.ENTRIES[-1]))
    efficiency = least.mean() / em.mean()
    spread = (least - efficiency * em).std() / (math.sqrt(200) * em.mean())
    assert float(efficiency + 2 * spread) >= 0.99
    assert float(spread) < 0.01


@pytest.mark.manual
def test_all_runs_scripts_and_links_their_outputs(monkeypatch, capsys, tmp_path):
    module = example("all")
    run_all = ["all", "--output", str(tmp_path), "--small", "--only", "figures_2_3", "figure_7"]
    monkeypatch.setattr("sys.argv", run_all)
    assert module.main() == 0
    printed = capsys.readouterr().out
    assert "figures_2_3: done" in printed
    assert "figure_7: left out, it needs --disturbed and --undisturbed" in printed
    left = " ".join((tmp_path / "figures_2_3.txt").read_text(encoding="utf-8").split())
    assert "worse at 0 of 11 shares" in left
    assert float(re.search(r"the least gain .* is ([-\d.e]+) nats", left)[1]) > 0
    for name in ("figure_2.png", "figure_3.png"):
        assert_is_picture(tmp_path / name)
    page = (tmp_path / "index.md").read_text(encoding="utf-8")
    for name in ("(figures_2_3.txt)", "(figure_2.png)", "(figure_3.png)"):
        assert name in page


def test_all_names_the_failed_scripts(monkeypatch, capsys, tmp_path):
    module = example("all")
    monkeypatch.setattr(module, "SCRIPTS", (module.Script("no_such_script", "nothing"),))
    monkeypatch.setattr("sys.argv", ["all", "--output", str(tmp_path)])
    assert module.main() == 1
    assert "no_such_script: FAILED (2)" in capsys.readouterr().out


def test_all_has_every_script_of_the_papers():
    module = example("all")
    assert {p.stem for p in FOLDER.glob("*.py")} - {"all"} == {s.name for s in module.SCRIPTS}
    for script in module.SCRIPTS:
        values = {"out": "folder", "disturbed": "a.csv", "undisturbed": "b.csv"}
        assert all("{" not in word for small in (True, False) for word in script.arguments(small, values))


def test_table_2_has_a_smaller_offset_error_of_mkc_em_on_a_simulated_sensor(monkeypatch, capsys):
    run(example("table_2"), monkeypatch)
    rows = {
        line.split("│")[1].strip(): line.split("│")[3] for line in capsys.readouterr().out.splitlines() if "│" in line
    }
    centre = {name: float(cell.split("(")[0]) for name, cell in rows.items() if name in ("LS", "MKC-EM")}
    assert centre["MKC-EM"] < 0.1 < 0.5 < centre["LS"]
