# mypy: ignore-errors
# bpy, Blender as a module, has no types.
"""Marker images rendered by Blender: `python -m benchmarks blender OUT` (extra `blender`).

Each state's fine surface becomes a mesh whose texture coordinates are its material points, seen by
the paper's camera (35 mm lens, 36 mm film) without lights, because the texture is emissive. So the
comparison is with Blender's renderer, not its lighting. Cycles on a CPU takes half a minute per
image.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.sim.render.compare import iou, mismatch
from benchmarks.sim.render.raycast import smooth
from benchmarks.sim.render.states import RenderState, dent, solved
from recorder.command_line.options import names
from sim.device import ready_device
from sim.markers import HEIGHT, WIDTH, Camera, named
from sim.markers.camera import FILM, LENS
from sim.markers.renderer import Renderer

PATTERNS = ("Array1", "Circle1", "Diamond1")
# Side of the texture [px]: 4.9 um per pixel on the paper's gel.
TEXTURE = 4096
# Spacing of the mesh's points [m].
SPACING = 0.1e-3
# Rays per pixel.
SAMPLES = 256
# Unit for Blender, whose clipping distances suit millimetres.
MM = 1e3


def render(state: RenderState, texture: Path, out: Path) -> np.ndarray:
    """Return the marker fraction (480, 640) of each pixel, rendered by Blender from a texture."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.collection.objects.link(_gel(state, texture))
    lens = bpy.data.cameras.new("camera")
    lens.lens, lens.sensor_width, lens.sensor_fit = LENS * MM, FILM * MM, "HORIZONTAL"
    lens.clip_start, lens.clip_end = 0.1, 1e3
    camera = bpy.data.objects.new("camera", lens)
    # Blender's cameras look along -z with y up; rotated about x, it looks up with y downwards.
    camera.location, camera.rotation_euler = (0, 0, -Camera.paper().distance * MM), (math.pi, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, False
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.pixel_filter_type = "BOX"
    scene.render.resolution_x, scene.render.resolution_y = WIDTH, HEIGHT
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format = "PNG"
    scene.render.image_settings.color_mode = "BW"
    scene.render.image_settings.color_depth = "16"
    scene.render.filepath = str(out)
    bpy.ops.render.render(write_still=True)
    with Image.open(out) as image:
        grey = np.asarray(image).astype(float) / 65535
    return grey[::-1]


def _gel(state: RenderState, texture: Path):
    """Return the Blender object: the deformed top in mm, textured by material points."""
    import bpy

    body = state.body
    x, y = (
        np.linspace(-size / 2, size / 2, round(size / SPACING) + 1)
        for size in (body.size_x, body.size_y)
    )
    moved = smooth(state.x, state.y, state.surface.astype(float), x, y)
    material = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    rest = body.heights_at(material[..., 0], material[..., 1])
    place = (np.concatenate([material, rest[..., None]], axis=-1) + moved) * MM
    number = np.arange(len(x) * len(y)).reshape(len(x), len(y))
    cells = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1)
    mesh = bpy.data.meshes.new("gel")
    mesh.from_pydata(place.reshape(-1, 3).tolist(), [], cells.reshape(-1, 4).tolist())
    fraction = (material / (body.size_x, body.size_y) + 0.5).reshape(-1, 2)
    layer = mesh.uv_layers.new(name="material")
    layer.data.foreach_set("uv", fraction[cells.ravel()].astype(np.float32).ravel())
    shader = bpy.data.materials.new("markers")
    if shader.node_tree is None:
        shader.use_nodes = True
    nodes, links = shader.node_tree.nodes, shader.node_tree.links
    nodes.clear()
    image = nodes.new("ShaderNodeTexImage")
    image.image = bpy.data.images.load(str(texture))
    image.image.colorspace_settings.name = "Non-Color"
    image.extension = "CLIP"
    emission, end = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    links.new(image.outputs["Color"], emission.inputs["Color"])
    links.new(emission.outputs["Emission"], end.inputs["Surface"])
    mesh.materials.append(shader)
    return bpy.data.objects.new("gel", mesh)


def draw_texture(name: str, state: RenderState, path: Path) -> None:
    """Write a pattern over the whole gel as a PNG, with white markers and anti-aliased edges."""
    body, pattern = state.body, named(name)
    pixels = [(np.arange(TEXTURE) + 0.5) / TEXTURE - 0.5] * 2
    x, y = (
        fraction * size for fraction, size in zip(pixels, (body.size_x, body.size_y), strict=True)
    )
    pixel = body.size_x / TEXTURE
    fraction = np.clip(0.5 - pattern.distance(x, y, 4 * pixel) / pixel, 0, 1)
    Image.fromarray(np.round(fraction[::-1] * 255).astype(np.uint8)).save(path)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("out", type=Path, help="folder for the images")
    parser.add_argument(
        "--patterns", type=names, default=",".join(PATTERNS), help="default %(default)s"
    )
    parser.add_argument("--made-up", action="store_true", help="skip the solved presses")


def run(options: argparse.Namespace) -> int:
    """Render every state and pattern, write both images and print their similarity."""
    options.out.mkdir(parents=True, exist_ok=True)
    ready_device("cpu")
    states = [dent(at=(2e-3, -1e-3), aside=(0.6e-3, 0.3e-3))]
    if not options.made_up:
        states += solved()
    names = options.patterns
    print("| state | pattern | IoU | pixels that differ |\n|---|---|---|---|")
    for index, state in enumerate(states):
        renderer = Renderer(state.body)
        textures = renderer.textures([named(name) for name in names])
        ours = renderer.see(state.x, state.y, state.surface[None]).masks(textures)[0]
        for name, mask in zip(names, ours, strict=True):
            texture = options.out / f"{name}.png"
            draw_texture(name, state, texture)
            theirs = render(state, texture, options.out / f"{index}-{name}-blender.png") >= 0.5
            Image.fromarray(mask).save(options.out / f"{index}-{name}-ours.png")
            fraction = 100 * mismatch(mask, theirs)
            print(
                f"| {state.name} | {name} | {iou(mask, theirs):.5f} | {fraction:.4f} % |",
                flush=True,
            )
    return 0
