"""Every public module is constructed on the meta device, given memory, loaded, and set to its initial values."""

import copy
import importlib
import inspect
import io

import pytest
import torch
import torch.distributed
from torch import nn
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard

from mkc_torch import (
    GeneralizedCrossEntropyLoss,
    HeteroscedasticMKCLoss,
    LELoss,
    MKCConvHead,
    MKCHead,
    MKCLoss,
)
from mkc_torch.diagnosis import DiagnosedModel
from mkc_torch.metrics import MKCNegativeLogLikelihood
from tests.public_api import MODULES

HEAD = {"bound": [50.0, 9.0], "d_min": 1e-3, "sigma_init": 2.0, "d_init": [0.5, 0.7]}
THETA, GAMMA = torch.tensor([1.0, 2.0], dtype=torch.float64), torch.ones(3)
EXAMPLES = {
    MKCLoss: [
        lambda: MKCLoss(2),
        lambda: MKCLoss(2, sigma=[2.0, 3.0], d=[1.0, 0.1], bound=50.0),
        lambda: MKCLoss(2, sigma=float("inf"), d=1.0, learn_sigma=False, learn_d=False),
        lambda: MKCLoss(2, objective="likelihood", bound=[9.0, 8.0], d_min=0.1),
        lambda: MKCLoss(2, d=1.0, objective="robust"),
    ],
    HeteroscedasticMKCLoss: [lambda: HeteroscedasticMKCLoss(50.0), lambda: HeteroscedasticMKCLoss([50.0, 9.0])],
    MKCHead: [lambda: MKCHead(3, 2, **HEAD)],
    MKCConvHead: [lambda: MKCConvHead(3, 2, **HEAD)],
    LELoss: [lambda: LELoss(dim=0)],
    GeneralizedCrossEntropyLoss: [lambda: GeneralizedCrossEntropyLoss(1.5, weight=[1.0, 2.0])],
    MKCNegativeLogLikelihood: [lambda: MKCNegativeLogLikelihood(MKCLoss(2, d=1.0))],
    DiagnosedModel: [lambda: DiagnosedModel("Sensor", {}, THETA, (), [GAMMA])],
}
"""Constructors of every public module, each with options that hold values of their own."""

each_example = pytest.mark.parametrize(
    "make",
    [make for makes in EXAMPLES.values() for make in makes],
    ids=[f"{kind.__name__}-{n}" for kind, makes in EXAMPLES.items() for n in range(len(makes))],
)


def public_modules():
    for name in MODULES:
        module = importlib.import_module(name)
        for export in module.__all__:
            member = getattr(module, export)
            if inspect.isclass(member) and issubclass(member, nn.Module):
                yield member


def on_meta(make):
    with torch.device("meta"):
        return make()


def own_tensors(module):
    """Parameters, buffers and the states of metrics that are no buffers."""
    states = getattr(module, "_defaults", {})
    return {
        **dict(module.named_parameters()),
        **dict(module.named_buffers()),
        **{k: getattr(module, k) for k in states},
    }


def fixed_values(module):
    """All values but those that are drawn at random."""
    return {name: value for name, value in own_tensors(module).items() if not name.startswith("location.")}


def assert_same(left, right):
    assert list(left) == list(right)
    torch.testing.assert_close(left, right, rtol=0.0, atol=0.0)


def fill_with_garbage(module):
    with torch.no_grad():
        for value in own_tensors(module).values():
            value.fill_(7)


def reset_each_submodule(module):
    """As loaders do: parents first, then children, which must not undo what their parents set."""
    for child in module.modules():
        if hasattr(child, "reset_parameters"):
            child.reset_parameters()


def test_every_public_module_has_an_example():
    assert set(public_modules()) == set(EXAMPLES)


@each_example
def test_a_module_is_constructed_on_the_meta_device(make):
    module = on_meta(make)
    assert all(value.is_meta for value in own_tensors(module).values())
    assert list(own_tensors(module)) == list(own_tensors(make()))
    assert type(module).__name__ in repr(module)
    assert_same(own_tensors(copy.deepcopy(module)), own_tensors(module))


@each_example
def test_every_module_with_values_of_its_own_can_reset_them(make):
    for child in make().modules():
        if [*child.parameters(recurse=False), *child.buffers(recurse=False)] and not isinstance(
            child, nn.ParameterList
        ):
            assert callable(child.reset_parameters)


@each_example
def test_memory_and_a_reset_give_the_values_of_an_ordinary_construction(make):
    module, expected = on_meta(make), make()
    module.to_empty(device="cpu")
    fill_with_garbage(module)
    reset_each_submodule(module)
    assert_same(fixed_values(module), fixed_values(expected))
    assert [p.requires_grad for p in module.parameters()] == [p.requires_grad for p in expected.parameters()]
    for value in own_tensors(module).values():
        assert not value.eq(7).all()


@each_example
def test_a_checkpoint_is_assigned_to_a_module_on_the_meta_device(make):
    module, saved, file = on_meta(make), make(), io.BytesIO()
    with torch.no_grad():
        for value in saved.state_dict().values():
            value.add_(1)
    torch.save(saved.state_dict(), file)
    file.seek(0)
    module.load_state_dict(torch.load(file), assign=True)
    assert_same(module.state_dict(), saved.state_dict())


@pytest.mark.parametrize("options", [{}, {"bound": 50.0}, {"bound": 50.0, "d_min": 0.1, "learn_d": False}, {"d": 1.0}])
def test_a_checkpoint_is_assigned_value_by_value(options):
    saved = MKCLoss(2, **options)
    for seed in range(3):
        saved(*torch.randn(2, 40, 2, generator=torch.Generator().manual_seed(seed)).unbind(0))
    module = on_meta(lambda: MKCLoss(2, **options))
    for name, value in saved.state_dict().items():
        *path, last = name.split(".")
        module.get_submodule(".".join(path)).load_state_dict({last: value}, strict=False, assign=True)
    assert_same(module.state_dict(), saved.state_dict())
    assert repr(module) == repr(saved)


@each_example
def test_half_precision_as_default_does_not_round_the_values(make):
    expected = make()
    torch.set_default_dtype(torch.bfloat16)
    try:
        module = make()
    finally:
        torch.set_default_dtype(torch.float32)
    found, wanted = fixed_values(module), fixed_values(expected)
    if isinstance(module, MKCHead):  # the layers are the network's, in its precision
        found, wanted = ({name: values[name] for name in ("bound", "d_min")} for values in (found, wanted))
    assert_same(found, wanted)


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_an_assigned_checkpoint_in_half_precision_keeps_the_module_in_float32(half):
    saved = MKCLoss(2)
    saved(*torch.randn(2, 40, 2, generator=torch.Generator().manual_seed(0)).unbind(0))
    state = {name: value.to(half) if value.is_floating_point() else value for name, value in saved.state_dict().items()}
    module = on_meta(lambda: MKCLoss(2))
    module.load_state_dict(state, assign=True)
    assert {value.dtype for value in module.state_dict().values()} == {torch.float32, torch.int64}
    module(torch.zeros(40, 2, dtype=half), torch.ones(40, 2, dtype=half)).backward()


def test_a_value_given_as_a_tensor_of_the_meta_device_must_be_loaded():
    module = on_meta(lambda: GeneralizedCrossEntropyLoss(weight=torch.tensor([1.0, 2.0])))
    module.to_empty(device="cpu")
    with pytest.raises(ValueError, match=r"initial value of `weight`.*load a state_dict"):
        module.reset_parameters()
    module.load_state_dict(GeneralizedCrossEntropyLoss(weight=torch.tensor([1.0, 2.0])).state_dict())
    assert module.weight.tolist() == [1.0, 2.0]


def test_wrong_values_are_refused_on_the_meta_device_too():
    for make in (
        lambda: MKCLoss(2, d=-1.0),
        lambda: MKCLoss(2, sigma=0.01),
        lambda: MKCLoss(2, d=5.0, bound=1.0),
        lambda: HeteroscedasticMKCLoss(-1.0),
        lambda: MKCHead(3, 2, bound=1.0, d_min=2.0),
        lambda: GeneralizedCrossEntropyLoss(0.1),
    ):
        with pytest.raises(ValueError, match="Expected argument"):
            on_meta(make)


class Training(nn.Module):
    def __init__(self):
        super().__init__()
        self.net, self.loss = nn.Linear(3, 4), MKCLoss(4, sigma=[1.0, 2.0, 3.0, 4.0])
        self.head = MKCHead(4, 2, **HEAD)

    def forward(self, features, target):
        output = self.net(features)
        return self.loss(output, target) + sum(value.mean() for value in self.head(output))


@pytest.mark.filterwarnings("ignore:DTensor random operators:UserWarning")
def test_fully_sharded_training_starts_on_the_meta_device():
    store = torch.distributed.HashStore()
    torch.distributed.init_process_group("gloo", store=store, rank=0, world_size=1)
    try:
        training = on_meta(Training)
        fully_shard(training, mesh=init_device_mesh("cpu", (1,)))
        training.to_empty(device="cpu")
        reset_each_submodule(training)
        assert "sharded" in repr(training)
        start = MKCLoss(4, sigma=[1.0, 2.0, 3.0, 4.0]).raw_kappa.detach()
        assert_same({"raw": training.loss.raw_kappa.full_tensor().detach()}, {"raw": start})
        optimizer = torch.optim.AdamW(training.parameters(), lr=1e-2)
        for _ in range(3):
            optimizer.zero_grad()
            training(torch.randn(20, 3), torch.randn(20, 4)).backward()
            optimizer.step()
        assert training.loss.residual_scale.batches.tolist() == [3] * 4
        assert not torch.equal(training.loss.raw_kappa.full_tensor(), start)
    finally:
        torch.distributed.destroy_process_group()
