"""Readers for published weights in the user's files and folders; nothing is downloaded."""

import hashlib
import importlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torch import nn

from learning.errors import LearningError
from learning.training.checkpoint import ModelFolder, first_line, load_weights, read_tensors

# Name of the metadata with the fingerprint of the published weights, and of the folder for them.
BASE = "base"


@dataclass(frozen=True, slots=True)
class Weights:
    """Paths of the published weights that training starts from."""

    base: str = ""
    """Folder of SD-Turbo in diffusers' layout."""
    clip: str = ""
    """Folder of CLIP ViT-B/32 in transformers' layout; read if `losses.adversarial` is not 0."""
    vgg: str = ""
    """File of torchvision's VGG16; read if `losses.perceptual` is not 0."""
    lpips: str = ""
    """File of LPIPS' linear heads for VGG; read with it."""


# LPIPS: perceptual distance of two images by VGG16 (Zhang et al. 2018, version 0.1).
#
# The trunk has torchvision's parameter names (`features.0.weight`, ...), so that its file loads
# unchanged; the linear heads are those of the lpips package.

# Channels of VGG16's five stages.
WIDTHS = (64, 128, 256, 512, 512)
# Convolutions of each stage; features are taken after the last one's ReLU.
LAYERS = (2, 2, 3, 3, 3)
# ImageNet's mean and standard deviation for images in [-1, 1] (lpips' scaling layer).
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
# Added under the root, whose gradient is undefined where all features are zero.
LEAST_SQUARE = 1e-10


class PerceptualDistance(nn.Module):
    """LPIPS distance (n,) of images in [-1, 1], 0 for equal ones. Frozen."""

    def __init__(self, widths: Sequence[int] = WIDTHS) -> None:
        """Build trunk and heads with random weights; `widths` are the channels of its stages."""
        super().__init__()
        layers: list[nn.Module] = []
        self.taps: list[int] = []
        before = 3
        for stage, (width, count) in enumerate(zip(widths, LAYERS, strict=True)):
            if stage:
                layers.append(nn.MaxPool2d(2))
            for _ in range(count):
                layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
                before = width
            self.taps.append(len(layers) - 1)
        self.features = nn.Sequential(*layers)
        self.heads = nn.ParameterList(
            nn.Parameter(torch.rand(1, width, 1, 1) / width) for width in widths
        )
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode, as it is frozen."""
        return super().train(False)

    def forward(self, images: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """Return the distance (n,) of images (n, 3, h, w) to others of the same shape."""
        pairs = zip(self._stages(images), self._stages(others), self.heads, strict=True)
        distance = torch.zeros(len(images), device=images.device)
        for one, other, head in pairs:
            apart = (_unit(one) - _unit(other)) ** 2
            distance = distance + (apart * head).sum(dim=1).mean(dim=(1, 2))
        return distance

    def _stages(self, images: torch.Tensor) -> list[torch.Tensor]:
        activations = (images - self.get_buffer("shift")) / self.get_buffer("scale")
        stages = []
        for index, layer in enumerate(self.features):
            activations = layer(activations)
            if index in self.taps:
                stages.append(activations.float())
        return stages


def _unit(features: torch.Tensor) -> torch.Tensor:
    square = (features**2).sum(dim=1, keepdim=True)
    return features / (square + LEAST_SQUARE).sqrt()


EXTRA = "pip install 'tactile-rig[diffusion]'"
SD_TURBO = (
    "a folder of Stable Diffusion Turbo in diffusers' layout (unet/ and vae/, each with "
    "config.json and diffusion_pytorch_model.safetensors), as `stabilityai/sd-turbo` on the "
    "Hugging Face hub"
)
CLIP = (
    "a folder of CLIP ViT-B/32 in transformers' layout (config.json, model.safetensors), as "
    "`openai/clip-vit-base-patch32` on the Hugging Face hub"
)
VGG = "torchvision's VGG16 (vgg16-397923af.pth)"
LPIPS = "the linear heads of LPIPS for VGG (weights/v0.1/vgg.pth of the lpips package)"
_WEIGHTS = (
    "diffusion_pytorch_model.safetensors",
    "diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.bin",
)
_CLIP_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
_OLD_ATTENTION = {".query.": ".to_q.", ".key.": ".to_k.", ".value.": ".to_v."}
_OLD_OUTPUT = ".proj_attn.", ".to_out.0."


def vendor(module: str) -> Any:
    """Import diffusers, peft or transformers, which only this translator needs."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise LearningError(f"{module}: cannot be imported ({error}); {EXTRA}") from error


def read_unet(folder: str) -> nn.Module:
    """Return the UNet in a folder of SD-Turbo, in float32 on the CPU."""
    return _diffusers_model(vendor("diffusers").UNet2DConditionModel, folder, "unet")


def read_vae(folder: str) -> nn.Module:
    """Return the autoencoder in a folder of SD-Turbo, in float32 on the CPU."""
    return _diffusers_model(vendor("diffusers").AutoencoderKL, folder, "vae")


def read_clip(folder: str) -> Any:
    """Return CLIP's image encoder in a folder, a `CLIPVisionModelWithProjection`."""
    path = Path(folder)
    if not folder or not (path / "config.json").is_file():
        raise LearningError(f"weights.clip: found {folder!r}; needed: {CLIP}")
    transformers = vendor("transformers")
    try:
        config = transformers.CLIPVisionConfig.from_pretrained(path, local_files_only=True)
        clip = transformers.CLIPVisionModelWithProjection(config)
    except (OSError, ValueError, TypeError) as error:
        raise LearningError(f"{path / 'config.json'}: not CLIP's: {first_line(error)}") from error
    # The file may also contain the text encoder.
    own = clip.state_dict().keys()
    tensors = read_tensors(_weights_file(path, _CLIP_WEIGHTS))
    load_weights(clip, {name: tensors[name].float() for name in own & tensors.keys()}, folder)
    return clip


def read_perceptual(vgg: str, lpips: str) -> PerceptualDistance:
    """Return LPIPS with the weights of VGG16 and of its linear heads."""
    for key, path, wanted in (("vgg", vgg, VGG), ("lpips", lpips, LPIPS)):
        if not path or not Path(path).is_file():
            raise LearningError(f"weights.{key}: found {path!r}; needed: {wanted}")
    trunk = {
        name: tensor
        for name, tensor in read_tensors(Path(vgg)).items()
        if name.startswith("features.")
    }
    heads = {
        name.replace("lin", "heads.", 1).removesuffix(".model.1.weight"): tensor
        for name, tensor in read_tensors(Path(lpips)).items()
    }
    widths = [len(heads.get(f"heads.{stage}", torch.empty(1, 0))[0]) for stage in range(5)]
    distance = PerceptualDistance(widths if all(widths) else WIDTHS)
    load_weights(distance, {**trunk, **heads}, f"{vgg}, {lpips}")
    return distance


def require_base_folder(folder: str) -> None:
    """Reject a folder that does not hold SD-Turbo."""
    for part in ("unet", "vae"):
        if not folder or not (Path(folder) / part / "config.json").is_file():
            raise LearningError(
                f"weights.base: found {folder!r} without {part}/config.json; needed: {SD_TURBO}"
            )


def fingerprint(folder: str) -> str:
    """Return a fingerprint of the weights in a folder of SD-Turbo: `sha256:` and 16 digits.

    Computed from the configurations, the file sizes, and the first and last MiB of each file.
    """
    digest = hashlib.sha256()
    for part in ("unet", "vae"):
        part_folder = Path(folder) / part
        digest.update((part_folder / "config.json").read_bytes())
        path = _weights_file(part_folder)
        size = path.stat().st_size
        digest.update(str(size).encode())
        with path.open("rb") as file:
            digest.update(file.read(1 << 20))
            file.seek(max(0, size - (1 << 20)))
            digest.update(file.read())
    return f"sha256:{digest.hexdigest()[:16]}"


def require_base(stored: ModelFolder, base: str) -> None:
    """Reject published weights other than those the run was trained from."""
    expected = stored.config.metadata.get(BASE)
    if expected != base:
        raise LearningError(
            f"{stored.path}: was trained from published weights {expected}, found {base}; "
            "allowed: the same ones"
        )


def base_of(stored: ModelFolder) -> str:
    """Return the published weights of a run: `base/` in its folder, else the training's path."""
    beside = stored.path / BASE
    folder = str(beside) if beside.exists() else stored.settings(Weights, "weights").base
    if not (Path(folder) / "unet").is_dir():
        raise LearningError(
            f"{stored.path}: found no published weights in {folder!r}; link the folder of SD-Turbo "
            f"that it was trained from to {beside}"
        )
    require_base(stored, fingerprint(folder))
    return folder


def _diffusers_model(model: Any, folder: str, part: str) -> nn.Module:
    part_folder = Path(folder) / part
    require_base_folder(folder)
    try:
        config = json.loads((part_folder / "config.json").read_text())
        # Built without initial weights, since all of them are read from the file.
        with torch.device("meta"):
            network: nn.Module = model.from_config(config)
    except (ValueError, TypeError, KeyError) as error:
        raise LearningError(f"{part_folder / 'config.json'}: not of a {part}: {error}") from error
    path = _weights_file(part_folder)
    tensors = {_new_name(name): tensor.float() for name, tensor in read_tensors(path).items()}
    if any(True for _ in network.buffers()):
        raise LearningError(
            f"{part_folder}: found a {part} with buffers; allowed: Stable Diffusion's"
        )
    network.to_empty(device="cpu")
    load_weights(network, tensors, str(path))
    return network


def _weights_file(where: Path, names: Sequence[str] = _WEIGHTS) -> Path:
    for name in names:
        if (where / name).is_file():
            return where / name
    raise LearningError(f"{where}: found no weights; allowed: {', '.join(names)}")


def _new_name(name: str) -> str:
    """Return the current diffusers name of a tensor; old autoencoders name attention otherwise."""
    if ".attentions." in name:
        for old, new in (*_OLD_ATTENTION.items(), _OLD_OUTPUT):
            name = name.replace(old, new)
    return name
