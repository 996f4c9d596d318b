"""Time, memory, kernels and host synchronisations of a step, compared with other losses and the memory floor."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from mkc_torch import MKCLoss
from tests.device.modes import (
    FIXED,
    MODES,
    LearnedGaussianNLL,
    LearnedStudentT,
    Step,
    batch,
    copy_rate,
    make_loss,
    median_seconds,
)

CHANNELS = 4


def step_of(loss: Any, input: Tensor, target: Tensor, **rest: Any) -> Step:
    """A step of a loss, eager or compiled."""
    return Step(loss, list(loss.parameters()), input, target, **rest)


def loss_factories(device: torch.device) -> dict[str, Callable[[], nn.Module]]:
    """The losses of the table."""
    found: dict[str, Callable[[], nn.Module]] = {
        "HuberLoss": nn.HuberLoss,
        "GaussianNLLLoss, learned": lambda: LearnedGaussianNLL(CHANNELS).to(device),
    }
    for name in MODES:
        found[f"MKCLoss, {name}"] = lambda name=name: make_loss(name, CHANNELS, device)
    return found


def kernels_and_syncs(step: Callable[[], object], device: torch.device) -> tuple[str, str]:
    """The number of kernels that a step launches, and whether it waits for the device."""
    if device.type != "cuda":
        return "-", "-"
    step()
    torch.cuda.synchronize()
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        step()
        torch.cuda.synchronize()
    count = sum(1 for event in profile.events() if event.device_type == torch.autograd.DeviceType.CUDA)
    torch.cuda.set_sync_debug_mode("error")
    try:
        step()
        waits = "0"
    except RuntimeError:
        waits = "waits"
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return str(count), waits


def captured_time(step: Step, device: torch.device) -> float | None:
    """Seconds of a step replayed from a CUDA graph, without Python; None without CUDA graphs."""
    if device.type != "cuda":
        return None
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(2):
            step()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    step.input.grad = None
    with torch.cuda.graph(graph):
        step()
    return median_seconds(graph.replay, device, budget=0.1)


def table_row(step: Step, size: int, rate: float, device: torch.device) -> str:
    """A row: time, time of the replayed graph, ratio to the floor, memory over the input, kernels, synchronisations."""
    time = median_seconds(step, device, budget=0.2)
    try:
        alone = captured_time(step, device)
    except RuntimeError:  # a loss that reads values
        alone, step.input.grad = None, None
    memory = "-"
    if device.type == "cuda":
        step.input.grad = None
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        step()
        memory = f"{(torch.cuda.max_memory_allocated() - before) / (4 * size):.2f}"
    kernels, waits = kernels_and_syncs(step, device)
    text = "-" if alone is None else f"{1e3 * alone:.4f}"
    over = (time if alone is None else alone) * rate / (12.0 * size)
    return f"{size:12}{1e3 * time:10.4f}{text:>10}{over:12.2f}{memory:>8}{kernels:>9}{waits:>7}"


def print_steps(device: torch.device, sizes: tuple[int, ...], *, compiled: bool) -> None:
    """Print the table of steps, eager or compiled."""
    rate = copy_rate(device, sizes[-1])
    print(f"  copy rate {rate / 1e12:.2f} TB/s; floor: 12 bytes an element; ms: eager, and replayed from a CUDA graph")
    print(
        f"  {'loss':34}{'elements':>12}{'ms':>10}{'graph':>10}{'over floor':>12}{'memory':>8}{'kernels':>9}{'syncs':>7}"
    )
    rows: dict[str, Any] = {name: make() for name, make in loss_factories(device).items()}
    if compiled:
        rows = {"Student t, learned": LearnedStudentT(CHANNELS).to(device)}
        rows |= {f"MKCLoss, {name}": make_loss(name, CHANNELS, device) for name in MODES}
        rows = {f"{name}, compiled": torch.compile(loss, fullgraph=True) for name, loss in rows.items()}
    for name, loss in rows.items():
        for size in sizes:
            step = step_of(loss, *batch(size // CHANNELS, CHANNELS, device))
            try:
                row = table_row(step, size, rate, device)
            except Exception as error:  # compilers raise their own exception types; the row names the type
                row = f"{size:12}  {type(error).__name__}: {str(error).splitlines()[0][:80]}"
            print(f"  {name:34}{row}", flush=True)


def print_variants(device: torch.device, size: int) -> None:
    """Print dtypes, upstream gradients, weights, reductions and layouts at the largest size, over their own floors."""
    rate = copy_rate(device, size)
    weight = torch.rand(size // CHANNELS, CHANNELS, device=device)
    upstream = torch.tensor(3.0, device=device)
    rows: list[tuple[str, torch.dtype, float, dict[str, Any], dict[str, Any]]] = [
        ("bfloat16", torch.bfloat16, 6.0, {}, {}),
        ("float16", torch.float16, 6.0, {}, {}),
        ("upstream gradient 3", torch.float32, 12.0, {}, {"upstream": upstream}),
        ("weighted mean", torch.float32, 16.0, {}, {"weight": weight}),
        ("masked mean", torch.float32, 13.0, {}, {"weight": weight > 0.3}),
        ("reduction none", torch.float32, 28.0, {"reduction": "none"}, {"upstream": weight}),
    ]
    layouts = (
        ("channels second", (size // 2**16, CHANNELS, 2**8, 2**6), 1),
        ("one channel", (size, 1), -1),
        ("seven channels", (size // 7, 7), -1),
        ("1000 channels", (size // 1000, 1000), -1),
    )

    def line(name: str, what: str, step: Step, bytes_each: float) -> None:
        eager, alone = median_seconds(step, device, budget=0.1, least=3), captured_time(step, device)
        over = (eager if alone is None else alone) * rate / (bytes_each * step.input.numel())
        text = "-" if alone is None else f"{1e3 * alone:.3f}"
        print(f"  {name:12} {what:22} {1e3 * eager:9.3f} ms, graph {text:>7} ms {over:6.2f} x its floor", flush=True)

    for name, options in MODES.items():
        for what, dtype, floor, extra, rest in rows:
            given = batch(size // CHANNELS, CHANNELS, device, dtype)
            line(name, what, step_of(make_loss(name, CHANNELS, device, **extra), *given, **rest), floor)
        for what, shape, axis in layouts:
            x, y = torch.randn(shape, device=device).requires_grad_(), torch.randn(shape, device=device)
            line(name, what, step_of(MKCLoss(shape[axis], channel_dim=axis, **options).to(device), x, y), 12.0)


class Training:
    """A training step of a small perceptron."""

    def __init__(self, loss: nn.Module, device: torch.device) -> None:
        torch.manual_seed(0)
        layers = nn.Linear(16, 64), nn.SiLU(), nn.Linear(64, 64), nn.SiLU(), nn.Linear(64, CHANNELS)
        self.net, self.loss = nn.Sequential(*layers).to(device), loss
        self.optimiser = torch.optim.Adam([*self.net.parameters(), *loss.parameters()], lr=1e-3)
        self.x, self.y = torch.randn(256, 16, device=device), torch.randn(256, CHANNELS, device=device)

    def __call__(self) -> None:
        self.optimiser.zero_grad()
        self.loss(self.net(self.x), self.y).backward()
        self.optimiser.step()


def print_training(device: torch.device) -> None:
    """Print the time of a training step with each loss, relative to Huber's; the losses in turn, three times."""
    times: dict[str, list[float]] = {}
    for _ in range(3):
        for name, make in loss_factories(device).items():
            times.setdefault(name, []).append(median_seconds(Training(make(), device), device, budget=0.6))
    reference = statistics.median(times["HuberLoss"])
    for name, found in times.items():
        time = statistics.median(found)
        print(f"  {name:34}{1e3 * time:9.3f} ms {time / reference:6.2f} x Huber's", flush=True)


def print_capture(device: torch.device) -> None:
    """Replay every mode from a CUDA graph, and print the difference from eager training."""
    if device.type != "cuda":
        print("  no CUDA graphs on this device")
        return
    for name, options in {**MODES, "fixed, likelihood": FIXED | {"objective": "likelihood"}}.items():
        loss, twin = (MKCLoss(CHANNELS, **options).to(device) for _ in range(2))
        twin.load_state_dict(loss.state_dict())
        input, target = batch(256, CHANNELS, device)
        step = step_of(loss, input, target)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(3):
                step()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        input.grad = None
        with torch.cuda.graph(graph):
            step()
        for _ in range(47):
            graph.replay()
        other, same = batch(256, CHANNELS, device)
        for _ in range(3 + 47):
            step_of(twin, other, same)()
        torch.cuda.synchronize()
        pairs = zip(loss.state_dict().values(), twin.state_dict().values(), strict=True)
        off = max([0.0, *(float((value.double() - other.double()).abs().max()) for value, other in pairs)])
        time = median_seconds(graph.replay, device, budget=0.2)
        print(f"  {name:20} captured; state differs by {off:.1e} after 50 batches; a replay {1e3 * time:.4f} ms")
