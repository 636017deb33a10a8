"""Networks of the field translator: U-Nets for frames and for deformations."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.config import require
from learning.data.images import inverse
from learning.data.synthetic import pixel_grid
from learning.errors import LearningError
from recorder.markers import HEIGHT, WIDTH, Lattice

# Kind of model in `config.yaml`.
KIND = "field"
# Groups of a group normalisation; every width is a multiple of it.
GROUPS = 8


_MOST_SCALES = 6  # halving 64 cells six times leaves one


@dataclass(frozen=True, slots=True)
class NetSettings:
    """The field net: from frames to deformations."""

    widths: tuple[int, ...] = (32, 48, 96, 128, 160)
    """Channels at 128, 64, 32, 16, 8 cells."""
    refinements: int = 2
    """Number of passes that compare the frame with the reference as deformed so far."""

    def __post_init__(self) -> None:
        _require_widths(self.widths, 2)
        require(self, "refinements", least=1)


@dataclass(frozen=True, slots=True)
class MapSettings:
    """The map: from one sensor's deformation to another's."""

    widths: tuple[int, ...] = (48, 96, 128, 128)
    """Channels at 64, 32, 16, 8 cells."""
    numbers: int = 32
    """Length of the vector that describes a sensor."""

    def __post_init__(self) -> None:
        _require_widths(self.widths, 1)
        require(self, "numbers", least=1)


def _require_widths(widths: tuple[int, ...], before: int) -> None:
    """Reject widths that are not multiples of 8, too few for the field's side, or too many."""
    allowed = before + _MOST_SCALES
    if not before <= len(widths) <= allowed or any(w < 8 or w % 8 for w in widths):
        raise LearningError(
            f"widths: found {list(widths)}; allowed: {before} to {allowed} multiples of 8"
        )


class ResidualBlock(nn.Module):
    """Residual block of two 3 x 3 convolutions with a conditional scale and offset between them."""

    def __init__(self, before: int, width: int, condition: int) -> None:
        """Build a block for a condition of some length, 0: unconditional."""
        super().__init__()
        self.norm_in = nn.GroupNorm(GROUPS, before)
        # No bias, as the normalisation would remove it.
        self.convolution_in = nn.Conv2d(before, width, 3, padding=1, bias=False)
        self.norm_out = nn.GroupNorm(GROUPS, width)
        self.convolution_out = nn.Conv2d(width, width, 3, padding=1)
        self.pass_on = nn.Conv2d(before, width, 1) if before != width else nn.Identity()
        self.condition = nn.Linear(condition, 2 * width) if condition else None

    def forward(self, features: Tensor, condition: Tensor | None = None) -> Tensor:
        """Return features (n, width, h, w) of (n, before, h, w); condition (n, condition)."""
        inner = self.norm_out(self.convolution_in(functional.silu(self.norm_in(features))))
        if self.condition is not None:
            gain, offset = self.condition(condition)[:, :, None, None].chunk(2, dim=1)
            inner = inner * (1 + gain) + offset
        inner = self.convolution_out(functional.silu(inner))
        passed: Tensor = self.pass_on(features) + inner
        return passed


class Attention(nn.Module):
    """Self-attention over all cells, for relations across the whole field."""

    def __init__(self, width: int, heads: int, side: int) -> None:
        """Build attention over side x side cells."""
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width)
        self.place = nn.Parameter(0.02 * torch.randn(1, width, side, side))
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, width, side, side)."""
        cells = (self.norm(features) + self.place).flatten(2).transpose(1, 2)
        attended: Tensor = self.attention(cells, cells, cells, need_weights=False)[0]
        return features + attended.transpose(1, 2).reshape(features.shape)


class Contraction(nn.Module):
    """Encodes a field into features at full, half, ... resolution; the coarsest see all of it."""

    def __init__(self, channels: int, widths: Sequence[int], condition: int = 0) -> None:
        """Build it for fields of 64 x 64, with channels at that side, half of it, and so on."""
        super().__init__()
        self.begin = nn.Conv2d(channels, widths[0], 3, padding=1)
        self.blocks = nn.ModuleList(ResidualBlock(width, width, condition) for width in widths)
        self.halvings = nn.ModuleList(
            nn.Conv2d(width, wider, 3, stride=2, padding=1)
            for width, wider in itertools.pairwise(widths)
        )
        deepest = SIDE // 2 ** (len(widths) - 1)
        # Heads of about 32 channels, if they divide the width.
        heads = math.gcd(widths[-1], max(1, widths[-1] // 32))
        self.attention = Attention(widths[-1], heads, deepest)
        self.last = ResidualBlock(widths[-1], widths[-1], condition)

    def forward(self, field: Tensor, condition: Tensor | None = None) -> list[Tensor]:
        """Return features, finest first, of (n, channels, side, side)."""
        features = self.blocks[0](self.begin(field), condition)
        scales = [features]
        for halving, block in zip(self.halvings, self.blocks[1:], strict=True):
            features = block(halving(features), condition)
            scales.append(features)
        scales[-1] = self.last(self.attention(features), condition)
        return scales


class FieldUnet(nn.Module):
    """U-Net from a field to a deformation of the same side; its untrained output is zero."""

    def __init__(self, channels: int, widths: Sequence[int], condition: int = 0) -> None:
        """Build it with the arguments of `Contraction`; the output is a deformation."""
        super().__init__()
        self.contraction = Contraction(channels, widths, condition)
        self.blocks = nn.ModuleList(
            ResidualBlock(width + wider, width, condition)
            for width, wider in zip(widths[-2::-1], widths[:0:-1], strict=True)
        )
        self.norm = nn.GroupNorm(GROUPS, widths[0])
        self.end = nn.Conv2d(widths[0], CHANNELS, 3, padding=1)
        for weights in self.end.parameters():
            nn.init.zeros_(weights)

    def forward(self, field: Tensor, condition: Tensor | None = None) -> Tensor:
        """Return the deformation (n, 3, side, side) of a field (n, channels, side, side)."""
        scales = self.contraction(field, condition)
        features = scales.pop()
        for block in self.blocks:
            features = functional.interpolate(features, scale_factor=2, mode="nearest")
            features = block(torch.cat([features, scales.pop()], dim=1), condition)
        output: Tensor = self.end(functional.silu(self.norm(features)))
        return output


# Representation of deformations in the networks, and their application to a reference.
#
# A deformation is (n, 3, h, w) on cells that tile the 640 x 480 image evenly, cell centres like the
# pixel centres of an image of h rows and w columns:
#
# - channels 0 and 1: shift (column, row) [px]. The point at p in the frame was at p - shift(p) in
#   the reference image. The archive's fields are the same displacement at undeformed positions.
# - channel 2: growth of the markers there [px of their radius], in addition to stretching by the
#   shift. Discs of a uSkin grow where they are pressed, although nothing there moves sideways.
#   Growth applies to whole markers and is coarse: fine growth could draw markers that do not exist.

# Shift along columns, shift along rows, growth.
CHANNELS = 3
# Cells along either axis: 10 x 7.5 px each, the step of the archive's lattice.
SIDE = 64
_GROWTH_CELLS = 4  # cells along either axis that share one growth value: 40 x 30 px
_INVERSIONS = 12  # fixed-point steps; each reduces the error by the largest slope of the field


def image_grid(height: int, width: int, device: torch.device) -> Tensor:
    """Return pixel coordinates of an image (1, height, width, 2), -1 to 1 (column, row)."""
    column = (2 * torch.arange(width, device=device) + 1) / width - 1
    row = (2 * torch.arange(height, device=device) + 1) / height - 1
    across, down = torch.meshgrid(column, row, indexing="xy")
    return torch.stack([across, down], dim=-1).unsqueeze(0)


def looked_up(images: Tensor, points: Tensor) -> Tensor:
    """Return images (n, c, h, w) at points (n, r, s, 2), -1 to 1; beyond their border, as there."""
    return functional.grid_sample(
        images, points, mode="bilinear", padding_mode="border", align_corners=False
    )


def render(distance: Tensor, deformation: Tensor) -> Tensor:
    """Return signed distances (n, 1, h, w) [px] of deformed references (n or 1, 1, h, w).

    Deformations are (n, 3, any, any). A reference is unknown outside its image. A marker cut by the
    border is assumed to extend beyond it as far as it reaches into the image, and no other markers
    are assumed there.
    """
    height, width = distance.shape[-2:]
    deformation = deformation.to(distance.dtype)
    fine: Tensor = functional.interpolate(
        deformation, size=(height, width), mode="bicubic", align_corners=False
    )
    shift = fine[:, :2] * _per_px(distance).view(1, 2, 1, 1)
    points = image_grid(height, width, distance.device) - shift.permute(0, 2, 3, 1)
    level = looked_up(distance.expand(len(deformation), -1, -1, -1), points)
    beyond = torch.linalg.vector_norm((points.abs() - 1).clamp(min=0) / _per_px(distance), dim=-1)
    deformed: Tensor = level - beyond.unsqueeze(1) + fine[:, 2:]
    return deformed


def coverage(level: Tensor) -> Tensor:
    """Return the covered fraction 0..1 of pixels by signed distances [px], for straight edges."""
    size = math.sqrt(HEIGHT * WIDTH / (level.shape[-2] * level.shape[-1]))
    return (0.5 + level / size).clamp(0.0, 1.0)


def coarse_growth(deformation: Tensor) -> Tensor:
    """Return a deformation (n, 3, h, w) with its growth averaged to the scale of whole markers."""
    shift, growth = deformation[:, :2], deformation[:, 2:]
    coarse = functional.avg_pool2d(growth, _GROWTH_CELLS)
    spread: Tensor = functional.interpolate(
        coarse, size=growth.shape[-2:], mode="bilinear", align_corners=False
    )
    return torch.cat([shift, spread], dim=1)


def from_displacement(field: Tensor, lattice: Lattice) -> Tensor:
    """Return shifts (n, 2, 64, 64) [px] of displacements (n, 2, h, w) [px], without NaN."""
    columns, rows = pixel_grid(SIDE, field.device)[0]
    return -inverse(field, columns, rows, lattice, _INVERSIONS)


def transferred(deformation: Tensor, zoom: Tensor, placement: Tensor | None = None) -> Tensor:
    """Return a deformation (n, 3, h, w) of a source's image in pixels of another sensor's image.

    The image centres coincide and lengths in millimetres are preserved: `zoom` is millimetres per
    target pixel over those per source pixel (n, 2) (column, row). `placement` is an affine change
    (n, 2, 3) of the sampled position, from the target's image to the source's, both from -1 to 1.
    """
    height, width = deformation.shape[-2:]
    grid = image_grid(height, width, deformation.device).expand(len(deformation), -1, -1, -1)
    points = grid * zoom.view(-1, 1, 1, 2)
    if placement is not None:
        # Written out, as autocast would round a matrix product to bfloat16.
        turned = (placement[:, None, None, :, :2] * points.unsqueeze(3)).sum(dim=-1)
        points = points + turned + placement[:, None, None, :, 2]
    scale = torch.cat([zoom, zoom.prod(dim=1, keepdim=True).sqrt()], dim=1)
    return looked_up(deformation, points) / scale.view(-1, 3, 1, 1)


def _per_px(images: Tensor) -> Tensor:
    """Return the size of a pixel of the 640 x 480 image in -1..1 coordinates (2,) (column, row)."""
    return images.new_tensor([2 / WIDTH, 2 / HEIGHT])


# Network from a frame and its reference to the deformation between them.

# Unit of deformations in the networks [px], chosen for values around one.
UNIT_PX = 16.0


class FieldNet(nn.Module):
    """Estimates a deformation iteratively from the frame and the reference as deformed so far.

    Each pass predicts the remaining deformation. The reference is an input (a signed distance), so
    the net need not memorise marker patterns and also works for unseen ones.
    """

    def __init__(self, widths: Sequence[int], refinements: int) -> None:
        """Build it with channels at 128, 64, 32, ... cells; the untrained deformation is zero."""
        super().__init__()
        self.refinements = refinements
        self.look = nn.Conv2d(2, widths[0], 5, stride=2, padding=2)
        self.look_closer = nn.Conv2d(widths[0], widths[1], 3, stride=2, padding=1)
        self.update = FieldUnet(widths[1] + CHANNELS, widths[1:])

    def forward(self, frames: Tensor, distance: Tensor) -> list[Tensor]:
        """Return deformations (n, 3, 64, 64) [px], one per pass; the last is the result.

        Frames are (n, 1, 256, 256) in 0..1, signed distances of the references (n|1, 1, 256, 256)
        [px].
        """
        deformation = frames.new_zeros(len(frames), CHANNELS, SIDE, SIDE)
        deformations: list[Tensor] = []
        for _ in range(self.refinements):
            with torch.no_grad():
                so_far = coverage(render(distance, deformation.float()))
            # Centred, since 0..1 would offset every feature of mostly dark images.
            inputs = torch.cat([frames - so_far, frames + so_far - 0.5], dim=1)
            features = self.look_closer(functional.silu(self.look(inputs)))
            previous = deformation.detach() / UNIT_PX
            missing = self.update(torch.cat([features, previous.to(features.dtype)], dim=1))
            deformation = deformation.detach() + coarse_growth(UNIT_PX * missing.float())
            deformations.append(deformation)
        return deformations


# Network from one sensor's deformation to another's under the same press.

_LAYOUT = 8  # channels of a reference's layout in each cell
_SCALES = 4  # mm per column and per row of both images
_SCALE_MM = 0.05  # unit of pixel scales before the logarithm


class LayoutEncoder(nn.Module):
    """Encodes a reference: the layout of its markers, and a vector that identifies the sensor."""

    def __init__(self, width: int, numbers: int) -> None:
        """Build it with `width` hidden channels and `numbers` values for the sensor."""
        super().__init__()
        self.look = nn.Conv2d(1, width, 5, stride=2, padding=2)
        self.look_closer = nn.Conv2d(width, width, 3, stride=2, padding=1)
        self.layout = nn.Conv2d(width, _LAYOUT, 1)
        self.farther = nn.Conv2d(width, 2 * width, 3, stride=4, padding=1)
        self.norm = nn.GroupNorm(GROUPS, 2 * width)
        self.whole = nn.Linear(2 * width * 16, numbers)

    def forward(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Return layouts (n, 8, 64, 64), sensors' vectors (n, numbers) of signed distances [px]."""
        features = functional.silu(self.look(distance / UNIT_PX))
        features = functional.silu(self.look_closer(features))
        far = functional.silu(self.norm(self.farther(features)))
        pooled = functional.adaptive_avg_pool2d(far, 4).flatten(1)
        return self.layout(features), self.whole(pooled)


class FieldMap(nn.Module):
    """Maps a source's deformation to the target's.

    The untrained map is the identity in millimetres. It learns the place of the source's contact in
    the target's image (an affine placement per sample, as each sensor is pressed on its own grid),
    then a correction that includes growth of discs. Its only inputs about the sensors are their
    references and scales, so one model serves all pairs of a group.
    """

    def __init__(self, widths: Sequence[int], numbers: int) -> None:
        """Build it with channels at 64, 32, 16, ... cells; `numbers` describe a sensor."""
        super().__init__()
        condition = 2 * numbers + _SCALES
        self.source = LayoutEncoder(2 * GROUPS, numbers)
        self.target = LayoutEncoder(2 * GROUPS, numbers)
        planes = CHANNELS + 2
        narrow = [max(1, width // (2 * GROUPS)) * GROUPS for width in widths]
        self.placing = Contraction(planes, narrow, condition)
        self.place = nn.Linear(narrow[-1], 6)
        for weights in self.place.parameters():
            nn.init.zeros_(weights)
        self.change = FieldUnet(planes + CHANNELS + 2 * _LAYOUT, widths, condition)

    def forward(
        self,
        deformation: Tensor,
        source_distance: Tensor,
        target_distance: Tensor,
        source_scale: Tensor,
        target_scale: Tensor,
    ) -> Tensor:
        """Return the target's deformation (n, 3, 64, 64) [px of its image] for the source's.

        Signed distances of the references are (n, 1, 256, 256) [px], scales (column, row) (n, 2)
        [mm / px].
        """
        source_layout, source_numbers = self.source(source_distance)
        target_layout, target_numbers = self.target(target_distance)
        scales = (torch.cat([source_scale, target_scale], dim=1) / _SCALE_MM).log()
        condition = torch.cat([source_numbers, target_numbers, scales.to(source_numbers.dtype)], 1)
        grid = image_grid(SIDE, SIDE, deformation.device).permute(0, 3, 1, 2)
        grid = grid.expand(len(deformation), -1, -1, -1)
        inputs = torch.cat([deformation / UNIT_PX, grid], dim=1).to(condition.dtype)
        whole = self.placing(inputs, condition)[-1].mean(dim=(2, 3))
        placement = self.place(whole).float().view(-1, 2, 3)
        zoom = target_scale / source_scale
        identity = transferred(deformation, zoom)
        placed = transferred(deformation, zoom, placement)
        inputs = torch.cat([placed / UNIT_PX, identity / UNIT_PX, grid], dim=1)
        layouts = torch.cat([source_layout, target_layout], dim=1)
        change: Tensor = self.change(
            torch.cat([inputs.to(layouts.dtype), layouts], dim=1), condition
        )
        return placed + coarse_growth(UNIT_PX * change.float())


# Signed distance of a marker image, which is warped instead of the image.
#
# Its zero is the edge of the markers, so thresholding a warped one keeps sub-pixel edges. Adding a
# constant grows every marker by as many pixels, as the discs of a uSkin do under pressure. A loss
# on it has a gradient at any distance between a marker and its true position.

# Distances are clipped here: a uSkin's disc grows from 12 to 54 px in radius.
REACH_PX = 64
_BLUR_PX = 1.0
_NEAR_PX = 1.0  # the blur locates edges up to here and has no weight from 1 px farther on
_LEAST_PX = 0.01


def signed_distance(masks: Tensor, reach: int = REACH_PX) -> Tensor:
    """Return signed distances (n, 1, h, w) [px], positive on markers, float32, for masks (n, h, w).

    Far from an edge it is the distance to the nearest pixel of the other kind, less half a pixel.
    That locates edges to a third of a pixel, always too far inside round shapes. Near an edge it is
    therefore inferred from the mask blurred by a Gaussian, for a straight edge, to a twentieth of a
    pixel. An image without markers is -reach everywhere; distances are clipped there.
    """
    outside = _distance_to(masks, reach) - 0.5
    inside = _distance_to(~masks, reach) - 0.5
    far = torch.where(masks, inside, -outside)
    away = (far.abs() - _NEAR_PX).clamp(0.0, 1.0)
    distance = torch.lerp(_distance_by_blur(masks), far, away)
    # Every pixel keeps its sign, even an isolated one.
    signed = torch.where(masks, distance.clamp(min=_LEAST_PX), distance.clamp(max=-_LEAST_PX))
    return signed.unsqueeze(1)


def resampled(distance: Tensor, side: int) -> Tensor:
    """Return distances (n, 1, h, w) at the pixel centres of side x side images of the same view."""
    return functional.interpolate(distance, size=(side, side), mode="bilinear", align_corners=False)


def _distance_by_blur(masks: Tensor) -> Tensor:
    """Return signed distances (n, h, w) [px] valid within 2 px of an edge; only signs elsewhere."""
    taps = torch.arange(-4, 5, device=masks.device, dtype=torch.float32)
    weights = torch.exp(-0.5 * (taps / _BLUR_PX).square())
    weights = weights / weights.sum()
    blurred: Tensor = functional.pad(masks.unsqueeze(1).float(), (4, 4, 4, 4), mode="replicate")
    blurred = functional.conv2d(blurred, weights.view(1, 1, 1, -1))
    blurred = functional.conv2d(blurred, weights.view(1, 1, -1, 1)).squeeze(1)
    # Averaging of the edge over a pixel widens the blur.
    width = math.sqrt(_BLUR_PX**2 + 1 / 12)
    away: Tensor = torch.erfinv((2 * blurred - 1).clamp(-0.999, 0.999))
    return math.sqrt(2) * width * away


def _distance_to(masks: Tensor, reach: int) -> Tensor:
    """Return the distance (n, h, w) to the nearest True, at most `reach` [px].

    Distances along rows come from running maxima. As squared distances add up, the result is then
    the minimum over all rows in reach.
    """
    height, width = masks.shape[-2:]
    column = torch.arange(width, device=masks.device, dtype=torch.float32)
    far = float(reach)
    last = torch.where(masks, column, -2 * far).cummax(dim=-1).values
    mirrored = torch.where(masks, -column, -2 * far - width).flip(-1)
    following = -mirrored.cummax(dim=-1).values.flip(-1)
    along = torch.minimum(column - last, following - column).clamp(max=far).square()
    best = along.clone()
    for offset in range(1, min(reach, height - 1) + 1):
        lower, upper = best[:, offset:], best[:, :-offset]
        torch.minimum(lower, along[:, :-offset] + offset**2, out=lower)
        torch.minimum(upper, along[:, offset:] + offset**2, out=upper)
    return best.sqrt().clamp(max=far)


class FieldModel(nn.Module):
    """The field net and the map. The untrained map is the identity in millimetres."""

    def __init__(self, net: NetSettings, map_: MapSettings, seed: int = 0) -> None:
        """Build both networks; the initial weights depend only on the seed."""
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.net = FieldNet(net.widths, net.refinements)
            self.map = FieldMap(map_.widths, map_.numbers)
        self.usual_scale: Tensor
        # Millimetres per pixel (column, row): median of the training, a GelSight's before it.
        self.register_buffer("usual_scale", torch.tensor([0.0249, 0.0249]))

    def forward(
        self,
        frames: Tensor,
        source_distance: Tensor,
        target_distance: Tensor,
        source_scale: Tensor,
        target_scale: Tensor,
    ) -> Tensor:
        """Return the target's deformation (n, 3, 64, 64) [px of its image] for source frames.

        Frames are (n, 1, 256, 256) in 0..1, the others as in `FieldMap`.
        """
        deformation = self.net(frames, source_distance)[-1]
        mapped: Tensor = self.map(
            deformation, source_distance, target_distance, source_scale, target_scale
        )
        return mapped
