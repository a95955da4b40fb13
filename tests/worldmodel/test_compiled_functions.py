"""What is compiled computes what it computes as it is, there and back."""

import pytest
import torch

from worldmodel import losses
from worldmodel.advection import advect
from worldmodel.blocks import lstm_gates


@pytest.fixture
def draw():
    generator = torch.Generator().manual_seed(0)
    return lambda *shape, low=0.0, high=1.0: low + (high - low) * torch.rand(shape, generator=generator)


def there_and_back(function, inputs):
    """Outputs and, of a weighted sum of them, the gradients to all inputs that take one."""
    outputs = function(*inputs)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    loss = sum((out * torch.linspace(0.5, 1.0, out.numel()).view(out.shape)).sum() for out in outputs)
    return *outputs, *torch.autograd.grad(loss, [x for x in inputs if x.requires_grad])


def assert_same(plain, compiled):
    for ours, theirs in zip(compiled, plain, strict=True):
        assert theirs.abs().max() > 1e-3
        torch.testing.assert_close(ours, theirs, rtol=1e-4 if theirs.dtype == torch.float32 else 1e-2, atol=1e-6)


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("shape", [(2, 24, 3, 4), (1, 5, 3, 7)])
def test_lstm_gates(both_ways, draw, shape, precision):
    batch, channels, *picture = shape
    gates = draw(batch, 4 * channels, *picture, low=-6.0, high=6.0).to(precision)
    inputs = gates, draw(*shape, low=-2.0, high=2.0)
    inputs = [x.contiguous(memory_format=torch.channels_last).requires_grad_() for x in inputs]
    assert_same(*both_ways(lambda: there_and_back(lstm_gates, inputs), functions=2))


def test_smoothness(both_ways, draw):
    inputs = draw(2, 3, 7, 9).requires_grad_(), draw(2, 3, 7, 9, high=0.1)
    assert_same(*both_ways(lambda: there_and_back(losses.edge_aware_smoothness, inputs), functions=1))


def test_advection(both_ways, draw):
    inputs = [draw(*shape).requires_grad_() for shape in ((2, 3, 7, 9), (2, 4, 7, 9), (2, 4, 5, 5))]
    assert_same(*both_ways(lambda: there_and_back(advect, inputs), functions=3))


def test_alignment(both_ways, draw):
    inputs = draw(1, 3, 6, 8).requires_grad_(), draw(1, 3, 6, 8)
    assert_same(*both_ways(lambda: there_and_back(lambda a, b: losses.knn_alignment(a, b, 2), inputs), functions=3))


def test_nearest_neighbours(both_ways, draw):
    clouds = draw(1, 3, 6, 8), draw(1, 3, 6, 8)
    for plain, compiled in (
        both_ways(lambda: losses.nearest_in_window(*clouds, 1), functions=2),
        both_ways(lambda: losses.nearest_of_all(*clouds), functions=1),
    ):
        assert torch.equal(compiled, plain)
