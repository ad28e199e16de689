"""Our tracer under an environment map beside Mitsuba 3 (`pip install mitsuba`): radiance within the noise of both.

    python benchmarks/relighting_truth.py --size 64 --samples 512

Scenes of shapes that both have: matt surfaces, matt surfaces with one bounce, microfacets that reflect all light (GGX,
our Fresnel term is 1 then). Two renderings of either tracer with other random numbers give its noise. `bias` is the
difference of the means of both pictures; `difference` and `noise` are root mean squares over pixels; a ratio of 1 says
that nothing but noise differs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np
import tyro

from lumigraph.synthetic import Material, Object, Pose, Sky, World, lit, scenes
from lumigraph.synthetic.cameras import look_at, pinhole
from lumigraph.synthetic.shapes import Ball, Cuboid
from lumigraph.synthetic.textures import Plain

EYE, TARGET, FIELD_OF_VIEW = (2.2, -2.4, 1.7), (0.0, 0.0, 0.0), 40.0
FLOOR = (1.2, 1.2, 0.05)
SHAPES = (  # shape, pose, albedo encoded as sRGB
    (Cuboid(FLOOR), Pose.at(0, 0, -0.05), (0.8, 0.8, 0.78)),
    (Ball(0.35), Pose.at(-0.3, 0.2, 0.35), (0.8, 0.4, 0.3)),
    (Cuboid((0.2, 0.25, 0.3)), Pose.at(0.45, -0.25, 0.3, turn=30), (0.3, 0.5, 0.75)),
)
UPSAMPLED = 16  # Mitsuba's map is bilinear between pixels, ours constant within each


@dataclasses.dataclass(frozen=True)
class Options:
    size: int = 64
    samples: int = 512  # rays per pixel
    lights: tuple[int, ...] = (0, 2, 3)


def main(options: Options) -> None:
    for light in options.lights:
        for kind, material, bounces in (
            ("matt", Material(Plain((0, 0, 0))), 0),
            ("matt, one bounce", Material(Plain((0, 0, 0))), 1),
            ("microfacets, roughness 0.5", Material(Plain((1, 1, 1)), roughness=0.5, metal=1.0), 0),
        ):
            compare(light, kind, material, bounces, options)


def compare(light: int, kind: str, material: Material, bounces: int, options: Options) -> None:
    """Print one row."""
    shown = scenes.scene("materials").environment(light)
    objects = [
        Object(shape, material if material.metal else replace(material, texture=Plain(albedo)), pose)
        for shape, pose, albedo in SHAPES
    ]
    world = World(tuple(objects), sky=Sky(visible=False), environment=shown, bounces=bounces)
    camera = pinhole(look_at(EYE, TARGET)[None], options.size, FIELD_OF_VIEW)
    # Other numbers of rays make other random numbers.
    ours = [lit(world, camera, 16 + k, options.samples // 32) for k in range(2)]
    theirs = [mitsuba_picture(world, bounces, options, seed) for seed in range(2)]
    inside = (ours[0][..., 3] == 1) & (ours[1][..., 3] == 1)
    a, b = (np.stack([x[..., :3][inside] for x in pair]) for pair in (ours, theirs))
    noise = np.sqrt(sum(((x[0] - x[1]) ** 2).mean() / 4 for x in (a, b)))
    difference = np.sqrt(((a.mean(0) - b.mean(0)) ** 2).mean())
    bias = a.mean() / b.mean() - 1
    print(
        f"light {light}, {kind:28} mean {a.mean():.4f}, bias {bias:+.2%}, difference {difference:.5f}, "
        f"noise {noise:.5f}, ratio {difference / noise:.2f}"
    )


def mitsuba_picture(world: World, bounces: int, options: Options, seed: int) -> np.ndarray:
    """The same world by Mitsuba's path tracer."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    assert world.environment is not None
    radiance = world.environment.radiance.numpy()
    half = radiance.shape[1] // 2  # its first column looks along +y
    pixels = np.kron(np.roll(radiance, half, 1), np.ones((UPSAMPLED, UPSAMPLED, 1))).astype(np.float32)
    upright = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    view = mi.ScalarTransform4f().look_at(origin=EYE, target=TARGET, up=[0, 0, 1])
    film: dict[str, Any] = {"type": "hdrfilm", "width": options.size, "height": options.size, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2 + bounces, "hide_emitters": True},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": upright},
        "sensor": {
            "type": "perspective",
            "fov": FIELD_OF_VIEW,
            "to_world": view,
            "film": film,
            "sampler": {"type": "independent", "sample_count": options.samples, "seed": seed},
        },
    }
    for k, thing in enumerate(world.objects):
        scene[f"object{k}"] = mitsuba_shape(thing, mi)
    return np.array(mi.render(mi.load_dict(scene), seed=seed))[..., :3]


def mitsuba_shape(thing: Object, mi: Any) -> dict[str, Any]:
    """One object with its material."""
    albedo = thing.material.describe()[1]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = thing.pose.rotation, thing.pose.position
    if thing.material.metal:
        alpha = thing.material.roughness**2
        bsdf: dict[str, Any] = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": alpha}
    else:
        bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [float(x) for x in albedo]}}
    if isinstance(thing.shape, Ball):
        return {
            "type": "sphere",
            "radius": thing.shape.radius,
            "center": list(thing.pose.position),
            "bsdf": bsdf,
        }
    assert isinstance(thing.shape, Cuboid)
    place = mi.ScalarTransform4f(matrix) @ mi.ScalarTransform4f().scale(list(thing.shape.half))
    return {"type": "cube", "to_world": place, "bsdf": bsdf}


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
