"""Extras that install the libraries which packages import only where they need them."""

from __future__ import annotations

# Extras that install a library, by the name it is imported by; without those of the base.
LIBRARIES = {
    "accelerate": ("learning",),
    "cv2": ("rig", "markers", "learning"),
    "diffusers": ("diffusion",),
    "foxglove_schemas_protobuf": ("export",),
    "fsspec": ("remote",),
    "grpc": ("nidaq",),
    "h5py": ("export",),
    "hidraw": ("rig",),
    "matplotlib": ("sim", "learning"),
    "mcap": ("export",),
    "mcap_protobuf": ("export",),
    "nidaqmx": ("nidaq",),
    "onnx": ("learning",),
    "onnxruntime": ("markers", "learning"),
    "onnxscript": ("learning",),
    "openvino": ("openvino",),
    "peft": ("diffusion",),
    "pyarrow": ("export",),
    "rtde_control": ("rig",),
    "s3fs": ("remote",),
    "rosbags": ("export",),
    "safetensors": ("learning",),
    "scipy": ("sim", "markers", "learning"),
    "serial": ("rig",),
    "skimage": ("learning",),
    "sklearn": ("learning",),
    "tensorboard": ("learning",),
    "torch": ("learning",),
    "transformers": ("diffusion",),
    "trimesh": ("sim",),
    "warp": ("sim",),
    "websockets": ("rig",),
}


def extra_of(library: str, wanted: str) -> str:
    """Return the extra that installs a library, `wanted` if it does; empty for an unknown library.

    Args:
        library: Name of the module that could not be imported, such as `scipy.linalg`.
        wanted: Extras of the command, between commas.
    """
    known = LIBRARIES.get(library.partition(".")[0], ())
    own = [extra for extra in wanted.split(",") if extra in known]
    return wanted if own else next(iter(known), "")
