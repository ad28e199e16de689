"""Emission-absorption model against scattering: a field fitted to fog under a fixed lamp, rendered under others.

The source of single scattering, J(x, d) = sigma_s p(cos) E(x), is a function of position and direction for fixed lamps.
So sigma and c(x, d) = J / sigma_t represent it, up to the angular resolution of c: band l of the Henyey-Greenstein
phase function has the magnitude g^l, of which harmonics up to degree n keep the first n. A moving lamp changes E, which
is baked into c.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from ... import kernels
from ...camera import Camera
from ...camera.rays import Rays, Samples
from ...components.sampling.sampling import stratified
from ...components.training.development import encoded
from ...figures import Row, contact_sheet, save_picture
from ...figures.charts import Series, line_chart, standalone
from ...files import write_bytes, write_json
from ...kernels.harmonic_grid import COEFFICIENTS
from ...kernels.sparse_grid import Nodes
from ...metrics import psnr
from ...synthetic import scattered
from ...synthetic.cameras import look_at, pinhole, sphere_point
from ...synthetic.scenes import fog
from ...system.progress import track
from ...volume import composite

CELLS = 40  # nodes of the grid along each axis
HALF = fog.REACH  # half-size of the grid's cube, scene units
RAY_SAMPLES, RAYS_PER_STEP = 48, 768
LEARNING_RATE = 0.05
VIEWS, TEST_VIEWS = 48, 6  # photographs to learn from, and held-out ones
DRAWN_SIDE = 190  # pixels of a picture on the sheet
DEGREES = 0, 1, 2  # of the harmonics of colour
LAMPS = 0, 5, 10, 20, 45, 90, 180  # degrees by which the lamp has moved
INSIDE = 0.75  # distance of cameras within the fog from the origin, scene units
INSIDE_FIELD_OF_VIEW = 75.0  # degrees
PHASE_PLACE = (0.0, 0.42, 0.3)  # a place in clear fog, away from the lamp, at which colour is measured
PHASE_ANGLES = 37
GAMMA, TONE_FLOOR = 1 / 2.2, 1e-3  # of the loss, which weighs light about as it looks


class GlowingGrid(nn.Module):
    """Emission-absorption field: density and harmonics of linear colour at the nodes of a dense grid."""

    def __init__(self, degree: int):
        super().__init__()
        self.nodes = Nodes.all((CELLS,) * 3)
        self.density = nn.Parameter(torch.full((self.nodes.count,), -0.5))
        harmonics = torch.zeros(self.nodes.count, COEFFICIENTS, 3)
        harmonics[:, 0] = 0.2
        self.harmonics = nn.Parameter(harmonics)
        self.kept = (torch.arange(COEFFICIENTS) < (degree + 1) ** 2)[:, None]  # of the coefficients

    def at(
        self, points: Float[Tensor, "point 3"], directions: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, " point"], Float[Tensor, "point 3"]]:
        """Density per scene unit, and linear colour along rays in these directions."""
        given = (points / HALF + 1) / 2, directions, self.nodes, self.density, self.harmonics * self.kept
        density, colour = kernels.harmonic_grid(*given)
        return softplus(density), colour.clamp_min(0)

    def forward(self, rays: Rays, generator: torch.Generator | None = None) -> Float[Tensor, "ray 3"]:
        """Linear radiance of rays over black (Max 1995)."""
        box = rays.origins.new_tensor([[-HALF] * 3, [HALF] * 3])
        enter, leave = (t[:, None].clamp_min(0) for t in rays.through_box(box))
        shares = stratified(len(rays), RAY_SAMPLES, generator, rays.origins.device)
        samples = Samples.rows(
            enter + shares * (leave - enter).clamp_min(1e-3), torch.maximum(leave, enter + 1e-3)[:, 0]
        )
        density, colour = self.at(*samples.along(rays))
        return composite(samples, density, colour, torch.zeros(1, 3)).rgb

    @torch.no_grad()
    def picture(self, camera: Camera) -> Float[Tensor, "height width 3"]:
        width, height = camera.size[0].tolist()
        return self(camera.rays(camera.pixels())).view(height, width, 3)


@dataclass(frozen=True)
class ScatteringFit:
    """One degree of colour. PSNR is of sRGB-encoded pictures of held-out cameras.

    moved:  PSNR under the lamp moved by each of LAMPS
    inside: PSNR of cameras in the fog; all training cameras are outside
    phase:  colour at PHASE_PLACE over directions at each of PHASE_ANGLES to the light, its mean 1
    """

    degree: int
    moved: list[float]
    inside: float
    phase: list[float]


@dataclass(frozen=True)
class Scattering:
    """All fits of one fog. phase: the true phase function at PHASE_ANGLES, its mean 1"""

    anisotropy: float
    fits: list[ScatteringFit]
    phase: list[float]


def angles() -> Float[Tensor, " angle"]:
    """Angles between light direction and viewing direction, radians."""
    return torch.linspace(0, math.pi, PHASE_ANGLES)


def henyey_greenstein(cosine: Float[Tensor, " angle"], g: float) -> Float[Tensor, " angle"]:
    """Phase function per steradian."""
    return (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * cosine) ** 1.5)


def truncation(g: float, degree: int, bands: int = 200) -> float:
    """Energy share of the phase function beyond a degree: sum of (2 l + 1) g^2l over l > n, over all l."""
    sizes = [(2 * band + 1) * g ** (2 * band) for band in range(bands)]
    return sum(sizes[degree + 1 :]) / sum(sizes)


def measure(
    anisotropy: float = 0.6, steps: int = 500, size: int = 64, seed: int = 0
) -> tuple[Scattering, list[list[Float[Tensor, "height width 3"]]]]:
    """Fits of all degrees, and pictures of one held-out camera: under the first lamp, a moved one, and from inside, the
    truth
    first. size: of pictures, pixels a side"""
    stage = fog.stage(size, VIEWS, seed, anisotropy=round(100 * anisotropy))
    inward = [look_at(sphere_point(a, math.radians(12), INSIDE), [0, 0, -0.15]) for a in (0.6, 2.6, 4.7)]
    test = stage.cameras["test"][:: max(1, len(stage.cameras["test"]) // TEST_VIEWS)]
    within = pinhole(np.stack(inward), size, INSIDE_FIELD_OF_VIEW)
    worlds = [fog.world(lamp, anisotropy) for lamp in LAMPS]
    truths = [[light_of(world, test[i]) for i in range(len(test))] for world in worlds]
    inside = [light_of(worlds[0], within[i]) for i in range(len(within))]
    light = [light_of(worlds[0], stage.cameras["train"][i]) for i in range(VIEWS)]
    chosen, moved = len(test) // 2, LAMPS.index(45)
    pictures = [[truths[0][chosen], truths[moved][chosen], inside[0]]]
    fits = []
    for degree in DEGREES:
        field = fitted(stage.cameras["train"], light, degree, steps, seed)
        seen = [field.picture(test[i]) for i in range(len(test))]
        from_inside = [field.picture(within[i]) for i in range(len(within))]
        quality = [quality_of(seen, truth) for truth in truths]
        fits.append(ScatteringFit(degree, quality, quality_of(from_inside, inside), phase_of(field)))
        pictures.append([seen[chosen], seen[chosen], from_inside[0]])
    true = henyey_greenstein(angles().cos(), anisotropy)
    return Scattering(anisotropy, fits, (true / sphere_mean(true)).tolist()), pictures


def light_of(world: object, camera: Camera) -> Float[Tensor, "height width 3"]:
    """Radiance of one camera by the tracer."""
    return torch.from_numpy(scattered(world, camera))  # type: ignore[arg-type]


def fitted(
    cameras: Camera, light: Sequence[Float[Tensor, "height width 3"]], degree: int, steps: int, seed: int
) -> GlowingGrid:
    """A field fitted to linear radiance of photographs."""
    field, chance = GlowingGrid(degree), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(field.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.95))
    target, pixels = torch.stack(list(light)).flatten(1, 2), cameras[0].pixels()
    for step in track(range(steps), f"Fitting harmonics of degree {degree}", steps):
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * 0.1 ** (step / steps)
        view = torch.randint(len(cameras), (RAYS_PER_STEP,), generator=chance)
        pixel = torch.randint(len(pixels), (RAYS_PER_STEP,), generator=chance)
        seen = field(cameras.rays(pixels[pixel], view), chance)
        toned = [(x + TONE_FLOOR) ** GAMMA for x in (seen, target[view, pixel])]
        optimizer.zero_grad()
        (toned[0] - toned[1]).square().mean().backward()
        optimizer.step()
    return field


def quality_of(seen: Sequence[Tensor], truth: Sequence[Tensor]) -> float:
    """Mean PSNR of sRGB-encoded pictures."""
    return sum(psnr(encode_picture(a), encode_picture(b)) for a, b in zip(seen, truth, strict=True)) / len(seen)


def encode_picture(light: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    return encoded(light.clamp(0, 1))


def enlarged(picture: Float[Tensor, "height width 3"]) -> Float[Tensor, "tall wide 3"]:
    """Whole pixels repeated, for the sheet."""
    times = max(1, DRAWN_SIDE // len(picture))
    return picture.repeat_interleave(times, 0).repeat_interleave(times, 1)


@torch.no_grad()
def phase_of(field: GlowingGrid) -> list[float]:
    """Colour at PHASE_PLACE by angle between viewing and light direction, averaged around it; its mean is 1."""
    place, lamp = torch.tensor(PHASE_PLACE), torch.tensor([fog.LAMP_ORBIT, 0.0, fog.LAMP_HEIGHT])
    light = torch.nn.functional.normalize(place - lamp, dim=0)
    x = torch.nn.functional.normalize(torch.linalg.cross(light, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    y = torch.linalg.cross(light, x)
    turn = torch.arange(24) * (2 * math.pi / 24)
    rim = turn.cos()[:, None] * x + turn.sin()[:, None] * y
    theta = angles()[:, None, None]
    outward = theta.cos() * light + theta.sin() * rim  # light leaves along it; the ray of the eye looks against it
    looks = -outward.reshape(-1, 3)
    _, colour = field.at(place.expand(len(looks), 3), looks)
    mean = colour.mean(-1).view(PHASE_ANGLES, -1).mean(-1)
    return (mean / sphere_mean(mean)).tolist()


def sphere_mean(values: Float[Tensor, " angle"]) -> float:
    """Mean over the sphere of a function of the angle."""
    weight = angles().sin()
    return max(float((weight * values).sum() / weight.sum()), 1e-9)


def draw(folder: Path, found: Scattering, pictures: Sequence[Sequence[Float[Tensor, "height width 3"]]]) -> None:
    """Write scattering.png, the pictures; lamps.svg, PSNR against the lamp's movement; phase.svg, colour against angle;
    and scattering.json, the figures."""
    names = ["truth", *(f"degree {fit.degree}" for fit in found.fits)]
    rows = [Row(name, [enlarged(encode_picture(x)) for x in row]) for name, row in zip(names, pictures, strict=True)]
    columns = ["first lamp", "lamp moved 45°", "within the fog"]
    sheet = contact_sheet("Fog: a field of emission and absorption", columns, rows)
    save_picture(folder / "scattering.png", sheet, "figure")
    lamps = [Series(f"degree {fit.degree}", LAMPS, fit.moved) for fit in found.fits]
    chart = line_chart(
        lamps, "degrees by which the lamp moved", "PSNR of held-out views, dB", marks=True, smoothed=False
    )
    write_bytes(folder / "lamps.svg", standalone(chart), "figure")
    degrees = [math.degrees(a) for a in angles().tolist()]
    phases = [Series(f"degree {fit.degree}", degrees, fit.phase) for fit in found.fits]
    phases.append(Series("Henyey-Greenstein", degrees, found.phase))
    chart = line_chart(phases, "angle between light and eye, degrees", "colour, mean 1", smoothed=False)
    write_bytes(folder / "phase.svg", standalone(chart), "figure")
    beyond = {str(degree): truncation(found.anisotropy, degree) for degree in DEGREES}
    write_json(folder / "scattering.json", asdict(found) | {"lamps": LAMPS, "beyond_degree": beyond}, "figure")
