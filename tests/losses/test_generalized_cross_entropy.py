import math

import pytest
import torch
from torch import nn
from torch.autograd import gradcheck, gradgradcheck
from torch.func import grad, vmap
from torch.nn.functional import cross_entropy, one_hot

from mkc_torch import GeneralizedCrossEntropyLoss, graduated_sigma
from mkc_torch.functional import mkc_energy, mkc_weight
from mkc_torch.losses.generalized_cross_entropy import generalized_cross_entropy

INF, NAN = math.inf, math.nan
each_reduction = pytest.mark.parametrize("reduction", ["none", "mean", "sum"])
each_sigma = pytest.mark.parametrize("sigma", [0.5, 0.8, 1.0, 1.2, 3.0, 100.0])
each_shape = pytest.mark.parametrize("shape", [(4,), (6, 4), (5, 4, 3), (2, 4, 3, 2)], ids=str)


def data(*shape, dtype=torch.float64, seed=0):
    """Logits (N, C, *), labels (N, *) and probabilities (N, C, *)."""
    generator = torch.Generator().manual_seed(seed)
    logits, other = (3 * torch.randn(*shape, dtype=torch.float64, generator=generator) for _ in range(2))
    axis = 0 if len(shape) == 1 else 1
    samples = shape[:axis] + shape[axis + 1 :]
    labels = torch.randint(0, shape[axis], samples, generator=generator)
    return logits.to(dtype), labels, other.softmax(axis).to(dtype)


def gradient(value, leaf):
    return torch.autograd.grad(value.sum(), leaf, retain_graph=True)[0]


def reduced(t, reduction):
    return {"none": t, "mean": t.mean(), "sum": t.sum()}[reduction]


# --- value and gradient


@each_sigma
@each_shape
def test_the_loss_equals_the_mkc_energy_of_the_deviance_residual(sigma, shape):
    logits, labels, _ = data(*shape)
    deviance = cross_entropy(logits, labels, reduction="none")
    residual = torch.sqrt(2.0 * deviance)
    found = generalized_cross_entropy(logits, labels, sigma=sigma, reduction="none")
    torch.testing.assert_close(found, mkc_energy(residual, sigma, 1.0), rtol=1e-12, atol=1e-14)
    weight = GeneralizedCrossEntropyLoss(sigma).double().inlier_weight(logits, labels)
    torch.testing.assert_close(weight, mkc_weight(residual, sigma, 1.0), rtol=1e-6, atol=1e-9)


@each_sigma
@each_reduction
def test_the_loss_equals_generalized_cross_entropy_with_q_the_inverse_square_of_sigma(sigma, reduction):
    logits, labels, _ = data(7, 4)
    q = sigma**-2
    probability = logits.softmax(1).gather(1, labels.unsqueeze(1)).squeeze(1)
    expected = reduced((1.0 - probability**q) / q, reduction)
    found = generalized_cross_entropy(logits, labels, sigma=sigma, reduction=reduction)
    # at q near 0 the difference of the formula as printed loses digits
    torch.testing.assert_close(found, expected, rtol=1e-13 / q, atol=1e-14)


@each_reduction
@each_shape
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_infinite_sigma_equals_cross_entropy_in_value_and_gradient(reduction, shape, soft, weighted, dtype):
    logits, labels, probabilities = data(*shape, dtype=dtype)
    target = probabilities if soft else labels
    weight = torch.tensor([0.5, 0.0, 2.0, 1.0], dtype=dtype) if weighted else None
    logits.requires_grad_()
    found = GeneralizedCrossEntropyLoss(INF, weight=weight, reduction=reduction)(logits, target)
    if not soft and (weighted and len(shape) == 1 and weight[labels] == 0):
        expected = 0.0 * logits.sum()  # torch: NaN
    else:
        expected = cross_entropy(logits, target, weight=weight, reduction=reduction)
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(gradient(found, logits), gradient(expected, logits))


def test_sigma_one_equals_half_the_absolute_error_of_the_probabilities():
    logits, labels, _ = data(6, 4)
    expected = 0.5 * (one_hot(labels, 4) - logits.softmax(1)).abs().sum(1).mean()
    torch.testing.assert_close(generalized_cross_entropy(logits, labels, sigma=1.0), expected)


@each_sigma
@each_reduction
@pytest.mark.parametrize("weighted", [False, True])
def test_probabilities_give_the_mean_over_labels_drawn_from_them(sigma, reduction, weighted):
    logits, _, probabilities = data(5, 4, 3)
    weight = torch.tensor([0.5, 0.0, 2.0, 1.0]).double() if weighted else None
    loss = GeneralizedCrossEntropyLoss(sigma, weight=weight, reduction=reduction)
    single = GeneralizedCrossEntropyLoss(sigma, weight=weight, reduction="none")
    each = torch.stack([single(logits, torch.full((5, 3), c)) for c in range(4)], 1)
    expected = reduced((probabilities * each).sum(1), reduction)
    torch.testing.assert_close(loss(logits, probabilities), expected, rtol=1e-6, atol=1e-9)
    weights = torch.stack([single.inlier_weight(logits, torch.full((5, 3), c)) for c in range(4)], 1)
    torch.testing.assert_close(single.inlier_weight(logits, probabilities), (probabilities * weights).sum(1))


def test_the_gradient_is_the_inlier_weight_times_that_of_cross_entropy():
    logits, labels, _ = data(6, 4)
    logits.requires_grad_()
    loss = GeneralizedCrossEntropyLoss(1.2, reduction="none")
    expected = gradient(cross_entropy(logits, labels, reduction="none"), logits)
    weight = loss.inlier_weight(logits, labels).unsqueeze(1)
    torch.testing.assert_close(gradient(loss(logits, labels), logits), weight * expected, rtol=1e-6, atol=1e-9)


# --- numerics


@pytest.mark.parametrize("sigma", [0.5, 1.0, 1.2, 10.0, 1e4, INF])
@pytest.mark.parametrize("size", [1e-4, 1.0, 20.0, 100.0, 1e4, 1e38])
@pytest.mark.parametrize("right", [True, False])
def test_single_precision_equals_double_for_any_size_of_logits(sigma, size, right):
    logits = torch.zeros(1, 3, dtype=torch.float64)
    logits[0, 0], logits[0, 1] = size, -size
    labels = torch.tensor([0 if right else 1])
    wide, narrow = logits.clone().requires_grad_(), logits.float().requires_grad_()
    expected, found = (generalized_cross_entropy(x, labels, sigma=sigma) for x in (wide, narrow))
    rounding = 1e-7 if right else 0.0  # of a probability near 1, which torch's own cross-entropy has too
    torch.testing.assert_close(found.double(), expected, rtol=2e-5, atol=rounding)
    slope = gradient(found, narrow)
    assert slope.isfinite().all()
    torch.testing.assert_close(slope.double(), gradient(expected, wide), rtol=1e-4, atol=max(rounding, 1e-30))


@each_sigma
@pytest.mark.parametrize("size", [0.0, 3.0, 1e4])
def test_the_gradient_is_bounded_and_fades_with_the_probability(sigma, size):
    logits = torch.tensor([[size, 0.0, -size]], requires_grad=True)
    norms = [
        float(gradient(generalized_cross_entropy(logits, torch.tensor([c]), sigma=sigma), logits).norm())
        for c in range(3)
    ]
    assert max(norms) <= math.sqrt(2.0)
    assert size < 1e4 or sigma == 100.0 or max(norms) < 1e-12


@pytest.mark.parametrize("sigma", [1.2, INF])
@pytest.mark.parametrize("soft", [False, True])
def test_an_impossible_class_leaves_finite_gradients(sigma, soft):
    logits = torch.tensor([[1.0, 0.0, -INF]], requires_grad=True)
    target = torch.tensor([[0.75, 0.25, 0.0]]) if soft else torch.tensor([1])
    value = generalized_cross_entropy(logits, target, sigma=sigma)
    expected = generalized_cross_entropy(logits[:, :2], target[:, :2] if soft else target, sigma=sigma)
    torch.testing.assert_close(value, expected)
    torch.testing.assert_close(gradient(value, logits), gradient(expected, logits))


@each_reduction
@pytest.mark.parametrize("poison", [NAN, INF, -INF])
def test_ignored_labels_affect_neither_value_nor_gradient(reduction, poison):
    logits, labels, _ = data(5, 4, 3)
    labels[1, 2] = labels[4, 0] = -1
    loss = GeneralizedCrossEntropyLoss(ignore_index=-1, reduction=reduction)
    expected = loss(logits, labels)
    logits[1, :, 2] = poison
    logits.requires_grad_()
    found = loss(logits, labels)
    assert torch.equal(found, expected)
    slope = gradient(found, logits)
    assert slope.isfinite().all()
    assert (slope[1, :, 2] == 0).all()
    assert (slope[4, :, 0] == 0).all()
    assert loss.inlier_weight(logits, labels)[1, 2] == 0
    if reduction == "mean":
        unpoisoned = data(5, 4, 3)[0].movedim(1, -1)[labels >= 0]
        torch.testing.assert_close(found, loss(unpoisoned, labels[labels >= 0]))


@each_reduction
@pytest.mark.parametrize("sigma", [1.2, INF])
@pytest.mark.parametrize("by", ["ignore_index", "weight"])
def test_without_counted_labels_value_and_gradient_are_zero(reduction, sigma, by):
    logits, _, _ = data(5, 4)
    logits.requires_grad_()
    loss = GeneralizedCrossEntropyLoss(sigma, weight=torch.tensor([1.0, 0.0, 1.0, 1.0]), reduction=reduction)
    value = loss(logits, torch.full((5,), -100 if by == "ignore_index" else 1))
    assert (value == 0).all()
    assert (gradient(value, logits) == 0).all()


# --- dtypes and transforms


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("soft", [False, True])
def test_half_precision_is_computed_in_float32_and_autocast_changes_nothing(dtype, soft):
    loss = GeneralizedCrossEntropyLoss(weight=torch.tensor([1.0, 2.0, 0.1, 1.0]))
    logits, labels, probabilities = data(5, 4, dtype=dtype)
    target = probabilities if soft else labels
    value = loss(logits, target)
    assert value.dtype == torch.float32
    assert torch.equal(value, loss(logits.float(), target))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(loss(logits.float(), target), value)
    assert loss.to(dtype).kappa.dtype == loss.weight.dtype == torch.float32
    assert loss.double().kappa.dtype == torch.float64


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32])
def test_labels_may_have_any_integer_type(dtype):
    logits, labels, _ = data(5, 4)
    loss = GeneralizedCrossEntropyLoss()
    assert torch.equal(loss(logits, labels.to(dtype)), loss(logits, labels))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's forward mode raises its own
@pytest.mark.parametrize("sigma", [0.8, 1.2, INF])
@each_reduction
def test_gradcheck_in_logits_and_probabilities(sigma, reduction):
    logits, labels, probabilities = data(3, 4)
    weight = torch.tensor([1.0, 0.5, 2.0, 0.0], dtype=torch.float64)
    loss = GeneralizedCrossEntropyLoss(sigma, weight=weight, reduction=reduction).double()
    logits.requires_grad_()
    for arguments, function in (
        ((logits,), lambda x: loss(x, labels)),
        ((logits, probabilities.requires_grad_()), loss),
    ):
        assert gradcheck(function, arguments, check_forward_ad=True)
        assert gradgradcheck(function, arguments)


@pytest.mark.parametrize("soft", [False, True])
def test_vmap_of_the_loss_and_its_gradient_equals_a_loop(soft):
    loss = GeneralizedCrossEntropyLoss()
    singles = [data(6, 4, seed=seed) for seed in range(5)]
    pairs = [(logits, probabilities if soft else labels) for logits, labels, probabilities in singles]
    together = [torch.stack(parts) for parts in zip(*pairs, strict=True)]
    torch.testing.assert_close(vmap(loss)(*together), torch.stack([loss(*pair) for pair in pairs]))
    torch.testing.assert_close(vmap(grad(loss))(*together), torch.stack([grad(loss)(*pair) for pair in pairs]))


def test_vmap_over_sigma_equals_a_loop():
    logits, labels, _ = data(6, 4)
    sigmas = torch.tensor([0.8, 1.2, INF], dtype=torch.float64)
    found = vmap(lambda s: generalized_cross_entropy(logits, labels, sigma=s))(sigmas)
    expected = torch.stack([generalized_cross_entropy(logits, labels, sigma=s) for s in sigmas])
    torch.testing.assert_close(found, expected)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's compiler raises its own
@pytest.mark.parametrize("soft", [False, True])
def test_traced_loss_equals_eager_over_batch_sizes_and_sigmas(soft):
    loss = GeneralizedCrossEntropyLoss(weight=torch.tensor([1.0, 0.5, 2.0, 0.1]).double())
    compiled = torch.compile(loss, fullgraph=True, dynamic=True, backend="aot_eager")
    for count, sigma in ((5, 1.2), (8, 0.8), (8, 1e4), (8, INF)):
        loss.sigma = sigma
        logits, labels, probabilities = data(count, 4)
        logits[0] *= 20.0
        target = probabilities if soft else labels
        logits.requires_grad_()
        found, expected = compiled(logits, target), loss(logits, target)
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)
        (slope,) = torch.autograd.grad(found, logits)
        torch.testing.assert_close(slope, gradient(expected, logits), rtol=1e-9, atol=1e-12)


def test_state_dict_carries_sigma_and_weights():
    loss = GeneralizedCrossEntropyLoss(0.9, weight=torch.tensor([1.0, 2.0, 0.0, 1.0]))
    other = GeneralizedCrossEntropyLoss(weight=torch.ones(4))
    other.load_state_dict(loss.state_dict())
    logits, labels, _ = data(5, 4)
    assert torch.equal(loss(logits, labels), other(logits, labels))
    assert other.sigma.item() == pytest.approx(0.9)
    assert "sigma=0.9" in repr(other)


# --- training with wrong labels


def test_graduated_sigma_goes_from_start_to_end_and_stays():
    found = [graduated_sigma(p / 10) for p in range(11)]
    assert found[0] == pytest.approx(1.2)
    assert found[5:] == pytest.approx([0.8] * 6)
    assert found == sorted(found, reverse=True)
    assert found[2] ** -2 == pytest.approx(0.6 * 1.2**-2 + 0.4 * 0.8**-2)
    assert graduated_sigma(0.0, start=INF) == INF
    assert graduated_sigma(0.25, start=INF, end=1.0) == pytest.approx(math.sqrt(2.0))


def clusters(classes, seed):
    """Inputs, labels and the size of the training set; a test set of the same size follows."""
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(classes).repeat(2 * 40)
    centres = torch.randn(classes, 16, generator=generator)
    return centres[labels] + 0.7 * torch.randn(len(labels), 16, generator=generator), labels


def training_error(loss, share, *, graduated=False, classes=20, epochs=40, seed=0):
    """Error on right labels of a network trained with wrong labels; and the weights of its labels."""
    x, y = clusters(classes, seed)
    count = len(y) // 2
    generator = torch.Generator().manual_seed(seed)
    wrong = torch.rand(count, generator=generator) < share
    other = (y[:count] + torch.randint(1, classes, (count,), generator=generator)) % classes
    given = torch.where(wrong, other, y[:count])
    torch.manual_seed(seed)
    net = nn.Sequential(nn.Linear(16, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, classes))
    optimiser = torch.optim.Adam(net.parameters(), lr=2e-3)
    for epoch in range(epochs):
        if graduated:
            loss.sigma = graduated_sigma(epoch / epochs)
        for batch in torch.randperm(count, generator=generator).split(64):
            optimiser.zero_grad()
            loss(net(x[batch]), given[batch]).backward()
            optimiser.step()
    with torch.no_grad():
        found = float((net(x[count:]).argmax(1) != y[count:]).double().mean())
        low = loss.inlier_weight(net(x[:count]), given) < 0.1 if graduated else None
    return found, low, wrong


@pytest.mark.e2e
def test_with_two_in_five_labels_wrong_the_error_is_a_fraction_of_that_of_cross_entropy():
    reference, *_ = training_error(nn.CrossEntropyLoss(), 0.4)
    fixed, *_ = training_error(GeneralizedCrossEntropyLoss(), 0.4)
    graduated, low, wrong = training_error(GeneralizedCrossEntropyLoss(), 0.4, graduated=True)
    assert reference > 0.3
    assert fixed < 0.4 * reference
    assert graduated < 0.3 * reference
    # the weights identify the wrong labels
    assert low[wrong].double().mean() > 0.8
    assert low[~wrong].double().mean() < 0.02


@pytest.mark.e2e
def test_right_labels_are_learned_as_well_as_with_cross_entropy():
    reference, *_ = training_error(nn.CrossEntropyLoss(), 0.0)
    assert training_error(GeneralizedCrossEntropyLoss(), 0.0)[0] < reference + 0.01
    assert training_error(GeneralizedCrossEntropyLoss(), 0.0, graduated=True)[0] < reference + 0.01


# --- bad arguments


@pytest.mark.parametrize("sigma", [0.0, -1.0, 0.49, NAN, -INF])
def test_sigma_out_of_range_is_refused_in_every_argument(sigma):
    message = r"`sigma` in \[0\.5, inf\] but got"
    loss = GeneralizedCrossEntropyLoss()
    logits, labels, _ = data(5, 4)
    with pytest.raises(ValueError, match=message):
        GeneralizedCrossEntropyLoss(sigma)
    with pytest.raises(ValueError, match=message):
        loss.sigma = sigma
    with pytest.raises(ValueError, match=message):
        generalized_cross_entropy(logits, labels, sigma=sigma)
    for name in ("start", "end"):
        with pytest.raises(ValueError, match=rf"`{name}`.*\[0\.5, inf\]"):
            graduated_sigma(0.5, **{name: sigma})
    assert loss.sigma.item() == pytest.approx(1.2)


def test_a_learned_sigma_and_a_sigma_per_class_are_refused():
    logits, labels, _ = data(5, 4)
    with pytest.raises(ValueError, match="`sigma` without a gradient"):
        generalized_cross_entropy(logits, labels, sigma=torch.tensor(1.2, requires_grad=True))
    with pytest.raises(ValueError, match=r"`sigma`.*single number.*got shape \(4,\)"):
        GeneralizedCrossEntropyLoss(torch.full((4,), 1.2))


@pytest.mark.parametrize(("progress", "until"), [(-0.1, 0.5), (1.1, 0.5), (NAN, 0.5), (0.5, 0.0), (0.5, 1.5)])
def test_progress_beyond_the_training_is_refused(progress, until):
    with pytest.raises(ValueError, match=r"`(progress`.*\[0|until`.*\(0), 1\]"):
        graduated_sigma(progress, until=until)


@pytest.mark.parametrize(
    ("weight", "message"),
    [
        ([1.0, -1.0], "non-negative and finite, not all 0"),
        ([0.0, 0.0], "non-negative and finite, not all 0"),
        ([1.0, NAN], "non-negative and finite, not all 0"),
        ([[1.0, 1.0]], r"of shape \(C,\), one for each class, but got \(1, 2\)"),
        (1.0, r"of shape \(C,\), one for each class, but got \(\)"),
    ],
)
def test_bad_class_weights_are_refused(weight, message):
    with pytest.raises(ValueError, match=message):
        GeneralizedCrossEntropyLoss(weight=torch.tensor(weight))


def test_another_reduction_is_refused():
    with pytest.raises(ValueError, match=r"`reduction`.*'none', 'mean' or 'sum'.*got 'avg'"):
        GeneralizedCrossEntropyLoss(reduction="avg")


def assert_refused(logits, target, message, kind=ValueError, **options):
    loss = GeneralizedCrossEntropyLoss(**options)
    with pytest.raises(kind, match=message):
        loss(logits, target)
    with pytest.raises(kind, match=message):
        generalized_cross_entropy(logits, target, **options)
    if not options:
        with pytest.raises(kind, match=message):
            loss.inlier_weight(logits, target)


@pytest.mark.parametrize("shape", [(4,), (5, 1), (5, 4), (1, 5), ()])
def test_labels_of_another_shape_are_refused_with_the_class_dimension(shape):
    assert_refused(
        torch.zeros(5, 4), torch.zeros(shape, dtype=torch.int64), r"labels `target` of shape \(5,\) for `input`"
    )


@pytest.mark.parametrize("shape", [(5,), (5, 3), (4, 5), (5, 1)])
def test_probabilities_of_another_shape_are_refused_with_a_hint_for_labels(shape):
    assert_refused(torch.zeros(5, 4), torch.ones(shape), r"`target` of the shape of `input`, \(5, 4\).*target.long\(\)")


@pytest.mark.parametrize("label", [4, -1, 255])
def test_a_label_out_of_range_is_refused_with_its_index(label):
    target = torch.zeros(2, 3, dtype=torch.int64)
    target[1, 2] = label
    assert_refused(
        torch.zeros(2, 4, 3), target, rf"`target` in \[0, 4\).* but got {label} at index \(1, 2\) and 0 more"
    )


@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("soft", [False, True])
def test_a_nan_or_infinite_logit_is_refused_with_its_index(value, soft):
    logits, labels, probabilities = data(5, 4)
    logits[3, 1] = value
    assert_refused(
        logits, probabilities if soft else labels, rf"`input` without NaN.* but got {value} at index \(3, 1\)"
    )


def test_a_sample_without_any_possible_class_is_refused():
    logits, labels, _ = data(5, 4)
    logits[2] = -INF
    assert_refused(logits, labels, r"or only -inf but got -inf at index \(2, 0\)")


@pytest.mark.parametrize("row", [[0.5, 0.6, 0.0, 0.0], [1.5, -0.5, 0.0, 0.0], [NAN, 1.0, 0.0, 0.0], [0.0] * 4])
def test_targets_that_are_not_probabilities_are_refused_with_their_index(row):
    target = torch.full((5, 4), 0.25)
    target[3] = torch.tensor(row)
    assert_refused(torch.zeros(5, 4), target, r"`target` to be non-negative with the sum 1 .* at index \(3,\); divide")


@pytest.mark.parametrize("shape", [(0, 4), (5, 0), (2, 4, 0), ()])
def test_an_empty_batch_is_refused(shape):
    target = torch.zeros(shape[:1] + shape[2:], dtype=torch.int64)
    assert_refused(
        torch.zeros(shape), target, r"`input` of shape \(N, C, \*\) or \(C,\) with elements .*skip empty batches"
    )


def test_weights_of_another_number_of_classes_are_refused():
    logits, labels, _ = data(5, 4)
    assert_refused(logits, labels, r"`weight` of the 4 classes of `input` but got shape \(3,\)", weight=torch.ones(3))


def test_arguments_of_another_type_are_refused():
    logits, labels, _ = data(5, 4)
    assert_refused(logits.long(), labels, "`input` to be floating-point logits but got torch.int64", TypeError)
    assert_refused(logits, labels.bool(), "`target` to be integer labels or .* but got torch.bool", TypeError)
    assert_refused(
        logits, labels.tolist(), r"`target` to be a tensor of .* but got list; .*torch\.as_tensor\(target\)", TypeError
    )
    assert_refused(
        logits.tolist(),
        labels,
        r"`input` to be floating-point logits but got list; .*torch\.as_tensor\(input\)",
        TypeError,
    )


def test_arguments_that_are_not_numbers_are_refused_by_name():
    logits, labels, _ = data(5, 4)
    with pytest.raises(TypeError, match=r"`sigma`.*number.*got 'a'"):
        GeneralizedCrossEntropyLoss("a")
    with pytest.raises(TypeError, match=r"`sigma`.*number.*got 'a'"):
        generalized_cross_entropy(logits, labels, sigma="a")
    with pytest.raises(TypeError, match=r"`weight`.*number.*got 'a'"):
        GeneralizedCrossEntropyLoss(weight="a")
    with pytest.raises(ValueError, match=r"`ignore_index`.*whole number.*got 'a'"):
        GeneralizedCrossEntropyLoss(ignore_index="a")
    for options in ({"progress": "a"}, {"progress": 0.5, "start": "a"}, {"progress": 0.5, "until": None}):
        with pytest.raises(TypeError, match="to be a number in"):
            graduated_sigma(**options)


def test_labels_of_eight_bits_are_not_confused_with_ignore_index():
    logits = torch.randn(2, 200, generator=torch.Generator().manual_seed(0))
    label = torch.tensor([156, 3])
    loss = GeneralizedCrossEntropyLoss(math.inf, reduction="none")
    torch.testing.assert_close(loss(logits, label.to(torch.uint8)), cross_entropy(logits, label, reduction="none"))
