"""The experiments of Indiveri (2009) at a small size; the full ones are ``python examples/paper/lel_*.py``."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from mkc_torch.linear import LeastEntropyLike, LeastSquares
from mkc_torch.losses.entropy_like import entropy_like
from tests.literature import hbk

FOLDER = Path(__file__).parents[2] / "examples" / "paper"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    if str(FOLDER) not in sys.path:
        sys.path.append(str(FOLDER))  # an example may import its neighbour, as in a run of the script
    spec.loader.exec_module(module)
    return module


def run(module: ModuleType, monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, arguments)])
    module.main()


def assert_is_picture(path: Path) -> None:
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size > 20_000


def test_tables_1_to_4_are_printed(monkeypatch, capsys):
    module = example("lel_tables_1_to_4")
    run(module, monkeypatch, "--draws", 6, "--samples", 2000, "--timed", 1)
    printed = capsys.readouterr().out
    for text in ("Table 1", "Table 2", "Table 3", "Table 4", "6 of 6", "0.9199", "Nelder-Mead"):
        assert text in printed


def test_case_2_has_the_published_minima_and_smaller_errors_than_least_squares():
    module = example("lel_tables_1_to_4")
    generator = torch.Generator().manual_seed(3)
    G = module.design(10_000)
    truth = torch.tensor(module.TRUTH).double().expand(5, 4)
    y = module.corrupted(module.clean(G, truth, generator), generator)
    fit = LeastEntropyLike(starts=torch.tensor(module.STARTS[2]).double()).fit(G, y)
    printed = torch.tensor(module.FINAL[2]).double()
    assert float((fit.minima_ - printed).abs().max()) < 0.5
    assert float((fit.minima_entropy_ - 0.6455).abs().max()) < 0.01
    error, error_ls = ((f - truth).norm(dim=-1) for f in (fit.coef_, LeastSquares().fit(G, y).coef_))
    assert bool((error < 0.2 * error_ls).all())


def test_minima_of_case_1_have_the_published_entropy():
    module = example("lel_tables_1_to_4")
    G = module.design(10_000)
    y = module.clean(G, torch.tensor(module.TRUTH).double().unsqueeze(0), torch.Generator().manual_seed(4))
    fit = LeastEntropyLike(starts=torch.tensor(module.STARTS[1]).double()).fit(G, y)
    difference = fit.minima_entropy_[0] - torch.tensor(module.ENTROPY[1]).double()
    assert float(difference.abs().max()) < 0.0015
    assert float((fit.minima_[0, 0] - truth_of(module)).norm()) < 3.0


def truth_of(module: ModuleType) -> torch.Tensor:
    return torch.tensor(module.TRUTH, dtype=torch.float64)


def test_table_5_has_the_published_estimates_and_entropies(monkeypatch, capsys, tmp_path):
    module = example("lel_table_5")
    X, y = module.data()
    whole, target = hbk()
    assert torch.equal(X, whole[:, 1:])
    assert torch.equal(y, target)
    found = module.estimates(X, y)
    assert list(found) == list(module.PAPER)
    for name, (theta, median, entropy) in module.PAPER.items():
        digits = torch.tensor([5e-5 if abs(v) < 0.01 else 5e-3 for v in theta]).double()
        assert bool(((found[name] - torch.tensor(theta).double()).abs() <= digits).all())
        r = y - X @ found[name]
        assert float(r.square().median()) == pytest.approx(median, abs=5e-3)
        assert float(entropy_like(r)) == pytest.approx(entropy, abs=5e-5)
    run(module, monkeypatch, "--output", tmp_path / "a.png", "--starts", 30)
    assert "0.429046" in capsys.readouterr().out
    assert_is_picture(tmp_path / "a.png")


@pytest.mark.manual
def test_all_figures_are_drawn(monkeypatch, capsys, tmp_path):
    run(example("lel_figures"), monkeypatch, "--draws", 20, "--samples", 1000, "--output", tmp_path)
    assert "Figures 1 and 2" in capsys.readouterr().out
    for name in ("figures_1_2.png", "figures_3_to_8.png"):
        assert_is_picture(tmp_path / name)


def test_lel_estimates_the_plane_of_a_range_image_better_than_least_squares(monkeypatch, capsys, tmp_path):
    module = example("lel_range_image")
    run(module, monkeypatch, "--output", tmp_path / "a.png")
    assert "pixels" in capsys.readouterr().out
    assert_is_picture(tmp_path / "a.png")
    image = module.scene(torch.Generator().manual_seed(1))
    X, z = module.regression(image.points)
    planes = module.planes_of(X, z)
    assert module.angle(planes["LEL, then LS"]) < module.angle(planes["LEL"]) < 0.3 * module.angle(planes["LS"])
