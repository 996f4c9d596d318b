"""The examples of losses in networks, at a small size."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from scipy.special import k1

pytest.importorskip("lightning")

# advice such as more workers for the loader
pytestmark = [
    pytest.mark.filterwarnings("ignore::lightning.fabric.utilities.warnings.PossibleUserWarning"),
    pytest.mark.filterwarnings(r"ignore:.*LeafSpec.* is deprecated"),
]

FOLDER = Path(__file__).parents[2] / "examples" / "lightning"


def load_example(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        # a script imports modules of its own folder; dataclasses look their module up
        patch.setattr(sys, "path", [str(FOLDER), *sys.path])
        patch.setitem(sys.modules, name, module)
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def example():
    return load_example("heavy_tailed_channel")


@pytest.fixture(scope="module")
def tabular():
    pytest.importorskip("sklearn")
    return load_example("corrupted_tabular")


@pytest.fixture(scope="module")
def series():
    return load_example("bursty_series")


def test_outliers_are_one_sided_and_in_one_channel(example):
    x, y = example.sample(0.25, seed=0)
    away = y - example.clean(x)
    assert float((away[:, 1] > 0.7).double().mean()) == pytest.approx(0.25, abs=0.04)
    assert float(away[:, 0].abs().max()) < 0.6
    assert float(away[:, 1].min()) > -0.6


@pytest.mark.manual
def test_mkc_em_has_a_smaller_error_than_squared_error_and_huber(example):
    error = {name: float(example.errors(example.trained(name, 0.25, 0, 8)).square().mean().sqrt())
             for name in ("MSE", "Huber", example.MKC_EM)}  # fmt: skip
    assert error[example.MKC_EM] < 0.3 * error["MSE"]
    assert error[example.MKC_EM] < 0.5 * error["Huber"]


def test_the_adaptive_loss_equals_its_definition():
    adaptive = load_example("peers").AdaptiveLoss(1)
    z, item = torch.linspace(-3.0, 3.0, 7), torch.tensor(1.0)
    # the general loss at alpha = 1 is Charbonnier's, sqrt(z^2 + 1) - 1
    torch.testing.assert_close(adaptive.rho(z, item), (z.square() + 1.0).sqrt() - 1.0)
    # whose partition function is 2 e K_1(1)
    assert float(adaptive.log_partition(item).exp()) == pytest.approx(2.0 * torch.e * k1(1.0), rel=1e-5)


@pytest.mark.parametrize("name", ["diabetes", "Friedman 1"])
def test_wrong_targets_are_two_to_ten_times_too_large_in_training_only(tabular, name):
    draw = tabular.TASKS[name].draw
    bad, good = draw(0.2, 3), draw(0.0, 3)
    assert float(bad.wrong.double().mean()) == pytest.approx(0.2, abs=0.05)
    factor = (bad.y / good.y)[bad.wrong]
    assert float(factor.min()) >= 2.0 - 1e-5
    assert float(factor.max()) <= 10.0 + 1e-5
    torch.testing.assert_close(bad.y[~bad.wrong], good.y[~bad.wrong], rtol=0.0, atol=0.0)
    torch.testing.assert_close(bad.held_out_y, good.held_out_y, rtol=0.0, atol=0.0)


@pytest.mark.manual
@pytest.mark.parametrize(("name", "of_mse", "of_oracle"), [("diabetes", 0.6, 1.1), ("Friedman 1", 0.3, 1.3)])
def test_mkc_em_on_corrupted_tables_is_nearly_as_good_as_training_without_wrong_rows(tabular, name, of_mse, of_oracle):
    task = dataclasses.replace(tabular.TASKS[name], epochs=20)
    found = {n: tabular.outcome(task, n, 0.2, 3) for n in ("MSE", tabular.MKC_EM, tabular.ORACLE)}
    mkc = found[tabular.MKC_EM]
    assert mkc.error < of_mse * found["MSE"].error
    assert mkc.error < of_oracle * found[tabular.ORACLE].error
    assert mkc.found > 0.6
    assert mkc.mistaken < 0.02


def test_interference_is_a_share_of_the_series(series):
    training, held_out = series.sample(0.2, 3)
    for part, samples in ((training, series.TRAINING), (held_out, series.HELD_OUT)):
        assert part.clean.shape == (samples,)
        assert float(part.interference.min()) == 0.0
        assert float((part.interference > 0.0).double().mean()) == pytest.approx(0.2, abs=0.05)
        assert float((part.quiet - part.clean).std()) == pytest.approx(series.NOISE, rel=0.1)
    assert not series.sample(0.0, 3)[0].interference.any()


def test_targets_are_the_given_steps_after_their_windows(series):
    count = torch.arange(60.0)
    last = series.windows(count)[:, -1:]
    torch.testing.assert_close(series.ahead(count) - last, torch.tensor(series.AHEAD).expand(len(last), -1).float())


@pytest.mark.manual
def test_mkc_forecasts_are_better_than_those_of_squared_error(series):
    every = {name: series.errors(series.trained(name, 0.2, 3, 4), 0.2, 3).square().mean(-1).sqrt()
             for name in ("MSE", series.MKC_EM, series.MKC_HEAD)}  # fmt: skip
    for name in (series.MKC_EM, series.MKC_HEAD):
        quiet, disturbed = every[name] / every["MSE"]
        assert quiet < 0.7
        assert disturbed < 0.9


def test_heads_with_a_scale_for_each_window_have_a_finite_loss(series):
    x, y = torch.randn(5, series.WINDOW), torch.randn(5, len(series.AHEAD))
    for name in (series.MKC_HEAD, series.STUDENT_HEAD):
        net, criterion = series.network(name)
        assert net(x)[0].shape == y.shape
        assert criterion(net(x), y).isfinite()


def test_the_masked_squared_error_ignores_masked_targets(series):
    input = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    value = series.MaskedMSE()(input, torch.tensor([0.0, torch.nan, 1.0]))
    value.backward()
    assert value.item() == pytest.approx(2.5)
    torch.testing.assert_close(input.grad, torch.tensor([1.0, 0.0, 2.0]))


def test_every_loss_has_a_measured_time():
    speed = load_example("speed")
    losses = {"squared": torch.nn.MSELoss(), "Gaussian": speed.LearnedGaussianNLL(4)}
    found = speed.measured(losses, rows=8, times=1, rounds=2, device=torch.device("cpu"))
    assert set(found) == set(losses)
    assert all(value > 0.0 for value in found.values())


@pytest.fixture(scope="module")
def wrong_targets():
    pytest.importorskip("sklearn")
    return load_example("wrong_targets")


@pytest.mark.parametrize("kind", ["permuted", "uniform", "one-sided", "factor 1000", "stuck"])
def test_only_the_given_share_of_targets_is_wrong(wrong_targets, kind):
    target = torch.rand(200, 1, generator=torch.Generator().manual_seed(0)) + 1.0
    new, wrong = wrong_targets.contaminated(target, kind, 0.3, torch.Generator().manual_seed(1))
    assert int(wrong.sum()) == 60
    assert torch.equal(new[~wrong], target[~wrong])
    assert int((new[wrong] != target[wrong]).sum()) >= 55
    if kind == "permuted":
        assert torch.equal(new[wrong].sort(0).values, target[wrong].sort(0).values)


@pytest.mark.manual
def test_the_table_of_wrong_targets_has_all_rows(wrong_targets, tmp_path):
    pytest.importorskip("matplotlib")
    arguments = ["--tables", "diabetes", "--shares", "0", "0.3", "--seeds", "1", "--steps", "120", "--no-cleaner"]
    wrong_targets.main([*arguments, "--workers", "1", "--output", str(tmp_path)])
    lines = (tmp_path / "wrong_targets.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("| diabetes")]
    assert [row.split("|")[2].strip() for row in rows] == ["none", *wrong_targets.KINDS]
    assert any(line.startswith("| average rank") for line in lines)
    assert (tmp_path / "wrong_targets.png").stat().st_size > 10_000
    names = [name.strip() for name in lines[0].split("|")[4:-1]]
    errors = dict(zip(names, map(float, rows[4].split("|")[4:-1]), strict=True))  # factor 1000
    assert errors["MKC, as it comes"] < 1.2 < errors["MSE"]


def test_a_cleaner_has_a_held_out_error(wrong_targets):
    pytest.importorskip("cleanlab")
    reported = wrong_targets.outcomes("diabetes", "one-sided", 0.2, 0, steps=100, cleaner=True)
    assert 0.3 < reported[wrong_targets.CLEANER].error < 5.0
    assert reported[wrong_targets.MKC].precision > 0.6


def test_a_row_of_noise_over_the_input_has_every_loss(capsys, monkeypatch):
    module = load_example("noise_over_input")
    monkeypatch.setattr(module, "STEPS", 150)
    module.main(["--shapes", "exponential, unrelated input", "--seeds", "1"])
    header, _, row, mean = (line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines())
    assert [name.strip() for name in header[1:-1]] == list(module.LOSSES)
    assert row[-1].strip() == "1 of 1"
    assert all(0.1 < float(ratio) < 10.0 for ratio in row[2:-1])
    assert mean[3].strip() == row[3].strip()


@pytest.mark.parametrize("shape", load_example("noise_over_input").SHAPES)
def test_the_noise_over_the_input_has_the_spread_of_its_shape(shape):
    module = load_example("noise_over_input")
    function, spread = module.SHAPES[shape]
    draws = [module.drawn(shape, seed) for seed in range(40)]
    x, target = (torch.cat([draw[k] for draw in draws]) for k in (0, 1))
    x = x / 12.0**0.5 + 0.5
    z = (target - module.FUNCTIONS[function](x)) / spread(x, module.FUNCTIONS[function](x))
    assert z.square().mean().sqrt().item() == pytest.approx(1.0, abs=0.05)


def test_a_table_of_optimisers_has_every_rate_and_variant(capsys, monkeypatch):
    module = load_example("optimisers")
    monkeypatch.setattr(module, "STEPS", 5)
    module.main(["--seeds", "1", "--optimisers", "SGD"])
    rows = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines()[2:]]
    assert [float(row[2]) for row in rows] == 2 * list(module.OPTIMISERS["SGD"][2])
    unscaled, scaled = (float(rows[-1][k].split("(")[1].rstrip(") ")) for k in (4, 6))
    assert {len(row) for row in rows} == {3 + len(module.VARIANTS)}
    assert unscaled != scaled
