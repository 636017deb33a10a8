"""Parts of the force model: residual blocks, encoders and the convolutional GRU."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learning.force.settings import InputSettings, NetworkSettings

_GROUP = 4
"""Channels that group norm pools; all widths are multiples of it."""


def norm(kind: str, channels: int) -> nn.Module:
    """Return a normalisation: instance, batch, group or none."""
    if kind == "instance":
        return nn.InstanceNorm2d(channels)
    if kind == "batch":
        return nn.BatchNorm2d(channels)
    if kind == "group":
        return nn.GroupNorm(channels // _GROUP, channels)
    return nn.Identity()


class EncoderBlock(nn.Module):
    """A residual block as in RAFT: its branch ends in a ReLU of its own."""

    def __init__(self, before: int, after: int, *, stride: int, kind: str) -> None:
        """Make the block; it halves the side where the stride is 2."""
        super().__init__()
        self.branch = nn.Sequential(
            nn.Conv2d(before, after, 3, stride=stride, padding=1),
            norm(kind, after),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1),
            norm(kind, after),
            nn.ReLU(),
        )
        self.skip: nn.Module = nn.Identity()
        if stride != 1 or before != after:
            self.skip = nn.Sequential(nn.Conv2d(before, after, 1, stride=stride), norm(kind, after))

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, after, h / stride, w / stride)."""
        return torch.relu(self.skip(features) + self.branch(features))


class TailBlock(nn.Module):
    """A residual block as in ResNet-18, which halves the side."""

    def __init__(self, before: int, after: int, *, kind: str) -> None:
        """Make the block."""
        super().__init__()
        bias = kind == "none"
        self.branch = nn.Sequential(
            nn.Conv2d(before, after, 3, stride=2, padding=1, bias=bias),
            norm(kind, after),
            nn.ReLU(),
            nn.Conv2d(after, after, 3, padding=1, bias=bias),
            norm(kind, after),
        )
        self.skip = nn.Sequential(
            nn.Conv2d(before, after, 1, stride=2, bias=bias), norm(kind, after)
        )

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, after, h / 2, w / 2)."""
        return torch.relu(self.skip(features) + self.branch(features))


def image_encoder(settings: NetworkSettings, planes: int) -> nn.Sequential:
    """Return what turns images (n, planes, h, w) into features (n, last width, h / 8, w / 8).

    RAFT's encoder (the paper, Methods; authors' code): 7 x 7 convolution, three stages of residual
    blocks, of which the second and third halve the side, 1 x 1 convolution.
    """
    kind = settings.encoder_norm
    first, _, last = settings.encoder
    parts: list[nn.Module] = [
        nn.Conv2d(planes, first, 7, stride=2, padding=3),
        norm(kind, first),
        nn.ReLU(),
    ]
    before = first
    for stage, width in enumerate(settings.encoder):
        for block in range(settings.blocks):
            stride = 2 if stage and not block else 1
            parts.append(EncoderBlock(before, width, stride=stride, kind=kind))
            before = width
    parts += [nn.Conv2d(last, last, 1), nn.Dropout2d(settings.dropout)]
    return nn.Sequential(*parts)


def field_encoder(settings: NetworkSettings, planes: int) -> nn.Sequential:
    """Return what turns fields (n, planes, h, w) into features (n, last width, h / 2, w / 2).

    Fields are smooth, so half of their lattice keeps what they say.
    """
    first, second, last = settings.encoder
    kind = settings.encoder_norm
    return nn.Sequential(
        nn.Conv2d(planes, first, 3, padding=1),
        nn.ReLU(),
        EncoderBlock(first, second, stride=2, kind=kind),
        nn.Conv2d(second, last, 1),
        nn.Dropout2d(settings.dropout),
    )


def encoder(settings: NetworkSettings, inputs: InputSettings) -> nn.Sequential:
    """Return the encoder that an input asks for."""
    make = field_encoder if inputs.form == "field" else image_encoder
    return make(settings, inputs.planes)


class ConvGru(nn.Module):
    """A gated recurrent unit whose weights are 3 x 3 convolutions (the paper, Methods)."""

    def __init__(self, planes: int, hidden: int) -> None:
        """Make the unit for inputs of `planes` channels."""
        super().__init__()
        self.hidden = hidden
        self.gates = nn.Conv2d(hidden + planes, 2 * hidden, 3, padding=1)
        self.candidate = nn.Conv2d(hidden + planes, hidden, 3, padding=1)

    def forward(self, features: Tensor, state: Tensor) -> Tensor:
        """Return the next state (n, hidden, h, w) of features (n, planes, h, w)."""
        gates = torch.sigmoid(self.gates(torch.cat((state, features), dim=1)))
        update, reset = gates.chunk(2, dim=1)
        candidate = torch.tanh(self.candidate(torch.cat((reset * state, features), dim=1)))
        return (1 - update) * state + update * candidate
