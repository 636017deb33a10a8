"""The authors' force network, under the names of their checkpoints."""

from collections import OrderedDict
from itertools import pairwise

import torch
from torch import Tensor, nn

# Widths of their encoder, memory and tail, and of a small network of the same structure.
FULL, SMALL = ((64, 96, 128), 128, (256, 512)), ((8, 12, 16), 16, (20, 24))


class Block(nn.Module):
    """Two convolutions beside a shortcut, whose norm has two names where the stride is 2."""

    def __init__(self, before: int, after: int, stride: int, norm: type[nn.Module]) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(before, after, 3, stride, 1)
        self.conv2 = nn.Conv2d(after, after, 3, 1, 1)
        self.norm1, self.norm2 = norm(after), norm(after)
        self.downsample = nn.Sequential()
        if stride == 2:
            self.norm3 = norm(after)
            self.downsample = nn.Sequential(nn.Conv2d(before, after, 1, stride), self.norm3)

    def forward(self, x: Tensor) -> Tensor:
        y = self.norm1(self.conv1(x)).relu()
        y = self.norm2(self.conv2(y)).relu()
        return (self.downsample(x) + y).relu()


class Theirs(nn.Module):
    """The authors' network under the names of their checkpoints, with random weights."""

    def __init__(self, widths: tuple[int, ...], memory: int, tail: tuple[int, ...]) -> None:
        super().__init__()
        norm, before = nn.InstanceNorm2d, widths[0]
        parts: list[tuple[str, nn.Module]] = [("conv1", nn.Conv2d(3, before, 7, 2, 3))]
        parts += [("norm1", norm(before)), ("relu", nn.ReLU())]
        for stage, width in enumerate(widths, 1):
            blocks = Block(before, width, min(stage, 2), norm), Block(width, width, 1, norm)
            parts.append((f"layer{stage}", nn.Sequential(*blocks)))
            before = width
        parts.append(("conv2", nn.Conv2d(before, before, 1)))
        self.base_network = nn.Sequential(OrderedDict(parts))
        names = ("convz", "convr", "convq")
        gates = {name: nn.Conv2d(memory + before, memory, 3, 1, 1) for name in names}
        self.convgru = nn.ModuleDict({"layers": nn.ModuleList([nn.ModuleDict(gates)])})
        sizes = pairwise((memory, *tail))
        self.post_processing = nn.Sequential(*(Block(*size, 2, nn.BatchNorm2d) for size in sizes))
        self.reg_layer = nn.Sequential(nn.Linear(tail[-1], 3), nn.Sigmoid())
        for name, value in self.post_processing.state_dict().items():
            if "norm" in name and value.ndim:
                value.uniform_(0.5, 1.5)

    def forward(self, frames: Tensor) -> Tensor:
        """Return the normalised forces (s, 3) of frames (s, 3, 256, 256)."""
        gates = self.convgru["layers"][0]
        features = self.base_network(frames)
        hidden, forces = torch.zeros(1, gates["convq"].out_channels, *features.shape[2:]), []
        for frame in features[:, None]:
            both = torch.cat([hidden, frame], 1)
            update, reset = gates["convz"](both).sigmoid(), gates["convr"](both).sigmoid()
            new = gates["convq"](torch.cat([reset * hidden, frame], 1)).tanh()
            hidden = (1 - update) * hidden + update * new
            forces.append(self.reg_layer(self.post_processing(hidden).mean(dim=(2, 3))))
        return torch.cat(forces)
