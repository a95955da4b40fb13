"""The layers against PyTorch's own, and the trunk's shapes, memory and inputs."""

import pytest
import torch
from torch.nn import functional as F

from worldmodel.blocks import ConvLSTM, Upsample, layer_norm, lstm_gates
from worldmodel.config import ModelConfig
from worldmodel.trunk import Decoder, Encoder, scaled

HEIGHT, WIDTH = 16, 24


def test_gates_and_their_gradients_are_those_of_an_lstm_cell():
    torch.manual_seed(0)
    cell = torch.nn.LSTMCell(3, 5)
    x, hidden, memory = (torch.randn(2, size, requires_grad=True) for size in (3, 5, 5))
    gates = F.linear(x, cell.weight_ih, cell.bias_ih) + F.linear(hidden, cell.weight_hh, cell.bias_hh)
    enter, forget, candidate, leave = gates.chunk(4, dim=1)  # PyTorch's order
    ours = torch.cat((enter, candidate, forget, leave), dim=1)[..., None, None], memory[..., None, None]
    expected = cell(x, (hidden, memory))
    inputs, upstream = (x, hidden, memory, *cell.parameters()), [torch.randn(2, 5), torch.randn(2, 5)]
    got = [out[..., 0, 0] for out in lstm_gates(*ours)]
    torch.testing.assert_close(got, list(expected))
    gradients = (torch.autograd.grad(outputs, inputs, upstream) for outputs in (got, expected))
    torch.testing.assert_close(*gradients)
    with torch.no_grad():  # another way is taken
        torch.testing.assert_close([out[..., 0, 0] for out in lstm_gates(*ours)], list(expected))


def test_convlstm_reads_its_state_from_the_neighbourhood():
    torch.manual_seed(0)
    lstm = ConvLSTM(2, 4, kernel=3)
    x, blank = torch.randn(1, 2, 6, 6), torch.zeros(1, 4, 6, 6)
    out, (hidden, _) = lstm(x, (blank, blank))
    assert out.shape == (1, 4, 6, 6) and torch.equal(out, hidden)
    touched = blank.clone()
    touched[..., 2, 2] = 1.0
    differs = ((lstm(x, (touched, blank))[0] - out).abs().sum(1) > 0)[0]
    expected = torch.zeros(6, 6, dtype=torch.bool)
    expected[1:4, 1:4] = True
    assert torch.equal(differs, expected)


def test_convlstm_forgets_little_at_first():
    torch.manual_seed(0)
    enter, candidate, forget, leave = ConvLSTM(8, 8, kernel=3).gates.bias.chunk(4)
    assert forget.min() > 0.8 and max(part.abs().max() for part in (enter, candidate, leave)) < 0.2


def test_upsampling_is_a_transposed_convolution_there_and_back():
    layer = Upsample(8, 16)
    x = torch.randn(2, 8, 4, 6, requires_grad=True)
    inputs = (x, layer.weight, layer.bias)
    got, want = layer(x), F.conv_transpose2d(*inputs, stride=2, padding=1)
    torch.testing.assert_close(got, want)
    upstream = torch.randn_like(got)
    gradients = (torch.autograd.grad(out, inputs, upstream) for out in (got, want))
    for ours, theirs in zip(*gradients, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_layer_norm_is_over_the_whole_picture():
    x = torch.randn(2, 6, 4, 5) * 3 + 1
    torch.testing.assert_close(layer_norm(6)(x), F.layer_norm(x, (6, 4, 5)))


@pytest.mark.parametrize(
    ("channels", "width", "expected"), [(32, 1.0, 32), (32, 0.5, 16), (32, 0.3, 8), (128, 0.25, 32)]
)
def test_widths_are_multiples_of_eight(channels, width, expected):
    assert scaled(channels, width) == expected


def blank_states(encoder, batch):
    small, middle, large = encoder.channels
    sizes = [(small, 2), (small, 2), (middle, 4), (middle, 4), (large, 8)]
    return [(torch.zeros(batch, c, HEIGHT // s, WIDTH // s),) * 2 for c, s in sizes]


@pytest.mark.parametrize(("action_dim", "latent_channels"), [(7, 1), (0, 1), (7, 0)])
def test_encoder_shapes_memory_and_inputs(action_dim, latent_channels):
    torch.manual_seed(0)
    encoder = Encoder(4, action_dim, latent_channels, ModelConfig(width=0.25, lstm_kernel=3))
    frame = torch.rand(2, 4, HEIGHT, WIDTH)
    action = torch.randn(2, action_dim, requires_grad=True)
    latent = torch.randn(2, 1, HEIGHT // 8, WIDTH // 8, requires_grad=True) if latent_channels else None
    states = blank_states(encoder, 2)

    def encode(states):
        features, skips, seen = encoder.look(frame, states[:4])
        embedding, acted = encoder.act(features, action, latent, states[4])
        return embedding, skips, [*seen, acted]

    embedding, (fine, skip0, skip1), after = encode(states)
    small, middle, large = encoder.channels
    assert embedding.shape == (2, large, HEIGHT // 8, WIDTH // 8)
    assert fine.shape == (2, 8, HEIGHT, WIDTH)
    assert skip0.shape == (2, small, HEIGHT // 2, WIDTH // 2) and skip1.shape == (2, middle, HEIGHT // 4, WIDTH // 4)
    assert [hidden.shape for hidden, _ in after] == [hidden.shape for hidden, _ in states]
    weights = torch.randn_like(embedding)
    (embedding * weights).sum().backward()
    assert action_dim == 0 or action.grad.abs().min() > 0
    assert latent is None or latent.grad.abs().min() > 0
    for i in range(5):  # every LSTM's memory is read
        changed = list(states)
        changed[i] = after[i]
        assert not torch.allclose(encode(changed)[0], embedding, atol=1e-5)


def test_decoder_comes_back_to_the_size_of_the_picture():
    torch.manual_seed(0)
    decoder = Decoder(5, ModelConfig(width=0.25, lstm_kernel=3))
    sizes = ((8, 1), (8, 2), (16, 4))
    skips = [torch.randn(2, channels, HEIGHT // stride, WIDTH // stride) for channels, stride in sizes]
    embedding = torch.randn(2, 32, HEIGHT // 8, WIDTH // 8)
    states = [
        (torch.zeros(2, 16, HEIGHT // 4, WIDTH // 4),) * 2,
        (torch.zeros(2, 8, HEIGHT // 2, WIDTH // 2),) * 2,
    ]
    out, after = decoder(embedding, skips, states)
    assert out.shape == (2, 5, HEIGHT, WIDTH)
    for i in range(3):  # every skip is read
        changed_skips = [skip + (number == i) for number, skip in enumerate(skips)]
        assert not torch.allclose(decoder(embedding, changed_skips, states)[0], out, atol=1e-5)
    for i in range(2):  # every LSTM's memory is read
        changed_states = list(states)
        changed_states[i] = after[i]
        assert not torch.allclose(decoder(embedding, skips, changed_states)[0], out, atol=1e-5)
