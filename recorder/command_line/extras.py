"""Extras that install the libraries which packages import only where they need them."""

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
    "manifold3d": ("rig", "sim"),
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
    "scipy": ("sim", "rig", "markers", "learning"),
    "serial": ("rig",),
    "skimage": ("learning",),
    "sklearn": ("learning",),
    "torch": ("learning",),
    "transformers": ("diffusion",),
    "trimesh": ("sim", "rig"),
    "warp": ("sim",),
    "websockets": ("rig",),
}


def extra_of(library: str, command_extras: str) -> str:
    """Return the extra that installs a library such as `scipy.linalg`; empty for an unknown one.

    It is `command_extras`, those of the command between commas, if one of these does.
    """
    extras = LIBRARIES.get(library.partition(".")[0], ())
    own = [extra for extra in command_extras.split(",") if extra in extras]
    return command_extras if own else next(iter(extras), "")
