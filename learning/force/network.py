"""The force model: encoder, convolutional GRU, residual tail, sigmoid head (the paper, Methods)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from learning.data.force_range import ForceRange
from learning.force.blocks import ConvGru, TailBlock, encoder
from learning.force.settings import InputSettings, NetworkSettings

AXES = ("Fx", "Fy", "Fz")
_NEAREST = 1e-3
"""The untrained model stays so far from the ends of the sigmoid."""


class ForceModel(nn.Module):
    """From frames to three-axis force, with a memory for what was before.

    Forces are shares of the box of forces, 0 to 1; `newtons` turns them into N. The box is part of
    the weights, so that it is stored with them.
    """

    low: Tensor
    high: Tensor

    def __init__(self, network: NetworkSettings, inputs: InputSettings) -> None:
        """Make the model; convolutions begin as Kaiming has them, norms constant (Methods)."""
        super().__init__()
        self.inputs = inputs
        self.encoder = encoder(network, inputs)
        self.memory = ConvGru(network.encoder[-1], network.memory)
        middle, last = network.tail
        self.tail = nn.Sequential(
            TailBlock(network.memory, middle, kind=network.tail_norm),
            TailBlock(middle, last, kind=network.tail_norm),
            nn.AdaptiveAvgPool2d(1),
            nn.Flatten(),
        )
        self.head = nn.Linear(last, len(AXES))
        self.register_buffer("low", torch.zeros(len(AXES)))
        self.register_buffer("high", torch.ones(len(AXES)))
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu")

    @property
    def state_shape(self) -> tuple[int, int, int]:
        """Shape (channels, h, w) of the state of one sequence."""
        side = self.inputs.side // (2 if self.inputs.form == "field" else 8)
        return self.memory.hidden, side, side

    def untouched(self, batch: int) -> Tensor:
        """Return the state (batch, channels, h, w) before anything was seen."""
        return self.head.weight.new_zeros(batch, *self.state_shape)

    def forward(
        self,
        frames: Tensor,
        state: Tensor | None = None,
        *,
        lengths: Sequence[int] | None = None,
        truncate: int | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return forces (b, s, 3), 0 to 1, and the state after the last frame of each sequence.

        What comes after a sequence's length is neither computed nor counted: its forces are 0, and
        it changes no statistic of a norm and no gradient.

        Args:
            frames: Prepared frames (b, s, planes, h, w).
            state: What the sequences before ended with (b, channels, h, w); None: untouched.
            lengths: Frames of each sequence (b,); None: all.
            truncate: Gradients stop at frames whose number is a multiple of this.
        """
        batch, steps = frames.shape[:2]
        length = [steps] * batch if lengths is None else lengths
        order = sorted(range(batch), key=lambda row: -length[row])
        place = [(row, time) for time in range(steps) for row in order if time < length[row]]
        rows, times = (
            torch.tensor(index, device=frames.device) for index in zip(*place, strict=True)
        )
        features = self.encoder(frames[rows, times])
        hidden = self.untouched(batch).to(features.dtype) if state is None else state
        hidden = hidden[order]
        seen, begin = [], 0
        for time in range(max(length)):
            running = sum(time < each for each in length)
            if truncate and time and time % truncate == 0:
                hidden = hidden.detach()
            now = self.memory(features[begin : begin + running], hidden[:running])
            hidden = torch.cat((now, hidden[running:])) if running < batch else now
            seen.append(now)
            begin += running
        shares = torch.sigmoid(self.head(self.tail(torch.cat(seen))).float())
        forces = shares.new_zeros(batch, steps, len(AXES)).index_put((rows, times), shares)
        back = sorted(range(batch), key=order.__getitem__)
        return forces, hidden[back]

    def step(self, frame: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return force (b, 3), 0 to 1, and state after one more prepared frame (b, planes, h, w).

        Frame after frame this is the same as `forward` on the sequence, in evaluation mode.
        """
        features = self.encoder(frame)
        before = self.untouched(len(frame)).to(features.dtype) if state is None else state
        after = self.memory(features, before)
        return torch.sigmoid(self.head(self.tail(after)).float()), after

    def set_range(self, box: ForceRange) -> None:
        """Set the box of forces that 0 and 1 stand for."""
        self.low.copy_(self.low.new_tensor(box.low))
        self.high.copy_(self.high.new_tensor(box.high))

    def newtons(self, shares: Tensor) -> Tensor:
        """Return forces (..., 3) N of shares of the box."""
        return self.low + shares * (self.high - self.low)

    def shares(self, forces: Tensor) -> Tensor:
        """Return shares of the box of forces (..., 3) N."""
        return (forces - self.low) / (self.high - self.low)

    def start_at(self, mean: Tensor) -> None:
        """Let the untrained model say a force (3,), given as shares of the box."""
        near = mean.clamp(_NEAREST, 1.0 - _NEAREST)
        with torch.no_grad():
            self.head.bias.copy_(torch.logit(near))
            self.head.weight.normal_(std=1.0 / (10.0 * math.sqrt(self.head.in_features)))
