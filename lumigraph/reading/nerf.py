"""NeRF whole: a scene held in the weights of a network (Mildenhall et al. 2020).

A network maps a point and a direction to density and colour. Rays through pixels are integrated by volume rendering.
Every step is differentiable, so the photographs alone teach the network.
"""

import math
import time

import torch
from jaxtyping import Float
from torch import Tensor, nn

from .camera import pinhole_rays
from .data import BOX, photographs, psnr, save
from .volume import composite, weights

WIDTH, OCTAVES, DIRECTION_OCTAVES = 96, 6, 2  # channels of a layer; L of eq. 4 for points and for directions
COARSE, FINE, RAYS, STEPS, RATE = 24, 24, 512, 700, 4e-3  # samples of each pass; rays of a step
Points = Float[Tensor, "*batch 3"]


def encode(p: Float[Tensor, "*batch coordinate"], octaves: int) -> Float[Tensor, "*batch feature"]:
    """gamma(p) = (p, sin(2^0 pi p), cos(2^0 pi p), ..., sin(2^(L-1) pi p), cos(2^(L-1) pi p))              (eq. 4)"""
    angles = math.pi * p[..., None, :] * 2.0 ** torch.arange(octaves)[:, None]
    return torch.cat([p, torch.stack([angles.sin(), angles.cos()], -2).flatten(-3)], -1)


def network() -> nn.ModuleDict:
    """Four layers to density and features, one more with the direction to colour (figure 7, smaller)."""
    inputs, turned = 3 + 6 * OCTAVES, 3 + 6 * DIRECTION_OCTAVES
    hidden = [layer for _ in range(3) for layer in (nn.Linear(WIDTH, WIDTH), nn.ReLU())]
    return nn.ModuleDict(
        {
            "body": nn.Sequential(nn.Linear(inputs, WIDTH), nn.ReLU(), *hidden),
            "density": nn.Linear(WIDTH, 1),
            "colour": nn.Sequential(nn.Linear(WIDTH + turned, WIDTH // 2), nn.ReLU(), nn.Linear(WIDTH // 2, 3)),
        }
    )


def density(net: nn.ModuleDict, points: Points):
    """Density per scene unit at points, and features for the colour: sigma does not depend on d (section 3)."""
    features = net["body"](encode(points, OCTAVES))
    return 10 * nn.functional.softplus(net["density"](features)[..., 0] - 1), features


def field(net: nn.ModuleDict, points: Points, directions: Points):
    """Density and colour at points seen along directions."""
    sigma, features = density(net, points)
    rgb = net["colour"](torch.cat([features, encode(directions, DIRECTION_OCTAVES)], -1)).sigmoid()
    return sigma, rgb


def span(origins: Float[Tensor, "ray 3"], directions: Float[Tensor, "ray 3"]):
    """Distances at which rays enter and leave the box, by its three pairs of walls (Kay and Kajiya 1986)."""
    a, b = (BOX[0] - origins) / directions, (BOX[1] - origins) / directions
    return torch.minimum(a, b).amax(1, keepdim=True), torch.maximum(a, b).amin(1, keepdim=True)


def stratified(near: Float[Tensor, "ray 1"], far: Float[Tensor, "ray 1"], count: int, jitter: bool):
    """One distance in each of N equal bins: t_i ~ U[near + (i-1)/N (far - near), near + i/N (far - near)] (eq. 2)"""
    offset = torch.rand(len(near), count) if jitter else torch.full((len(near), count), 0.5)
    return near + (far - near) * (torch.arange(count) + offset) / count


def invert(edges: Float[Tensor, "ray edge"], w: Float[Tensor, "ray bin"], shares: Float[Tensor, "ray count"]):
    """Distances where the cumulative weight reaches these shares: fine samples lie where light comes from (eq. 5)."""
    pdf = (w + 1e-5) / (w + 1e-5).sum(1, keepdim=True)
    cdf = nn.functional.pad(pdf.cumsum(1), (1, 0))
    i = torch.searchsorted(cdf, shares.contiguous(), right=True).clamp(1, w.shape[1])
    low, high = cdf.gather(1, i - 1), cdf.gather(1, i)
    within = ((shares - low) / (high - low).clamp_min(1e-12)).clamp(0, 1)
    return torch.lerp(edges.gather(1, i - 1), edges.gather(1, i), within)


def along(o: Float[Tensor, "ray 3"], d: Float[Tensor, "ray 3"], t: Float[Tensor, "ray edge"]) -> Points:
    """Points in the middle of the intervals from t_i to t_{i+1}."""
    return o[:, None] + ((t[:, 1:] + t[:, :-1]) / 2)[..., None] * d[:, None]


def render(net: nn.ModuleDict, o: Float[Tensor, "ray 3"], d: Float[Tensor, "ray 3"], jitter: bool = False):
    """Colours of rays (section 5.2): coarse samples find where light comes from, and fine ones are added there.

    The paper has a network for each pass. Here one serves both, so the coarse pass needs no gradient.
    """
    near, far = span(o, d)
    far = torch.maximum(far, near + 1e-3)  # a ray beside the box
    coarse = torch.cat([near, stratified(near, far, COARSE - 1, jitter), far], 1)
    with torch.no_grad():
        w = weights(density(net, along(o, d, coarse))[0], coarse.diff(dim=1))
        shares = stratified(torch.zeros_like(near), torch.ones_like(near), FINE, jitter)
        t = torch.cat([coarse, invert(coarse, w, shares)], 1).sort(1).values
    points = along(o, d, t)
    sigma, rgb = field(net, points, d[:, None].expand_as(points))
    return composite(weights(sigma, t.diff(dim=1)), rgb)


def picture(net: nn.ModuleDict, image: Tensor, pose: Tensor, focal: float) -> Float[Tensor, "height width 3"]:
    """Rendering of a whole camera, some rays at a time."""
    o, d = pinhole_rays(image, pose, focal)
    with torch.no_grad():
        parts = [render(net, a, b) for a, b in zip(o.split(2048), d.split(2048), strict=True)]
    return torch.cat(parts).view(image.shape)


def rays_of(images: Tensor, poses: Tensor, focal: float) -> tuple[Tensor, Tensor, Tensor]:
    """Rays of all photographs that meet the box, and the colour of each."""
    pairs = [pinhole_rays(image, pose, focal) for image, pose in zip(images, poses, strict=True)]
    o, d = (torch.cat(parts) for parts in zip(*pairs, strict=True))
    near, far = span(o, d)
    met = (near < far)[:, 0]
    return o[met], d[met], images.reshape(-1, 3)[met]


def train(net: nn.ModuleDict, o: Tensor, d: Tensor, truth: Tensor, steps: int = STEPS) -> list[float]:
    """Adam on the squared error, with a learning rate that falls (section 5.3). Returns the loss of each step."""
    optimizer, losses, begin = torch.optim.Adam(net.parameters(), RATE, eps=1e-7), [], time.perf_counter()
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = RATE * 0.05 ** (step / steps)
        chosen = torch.randint(len(o), (RAYS,))
        loss = (render(net, o[chosen], d[chosen], jitter=True) - truth[chosen]).square().mean()  # eq. 6
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if step % 100 == 99:
            print(f"step {step + 1:4}   {time.perf_counter() - begin:4.0f} s   loss {sum(losses[-100:]) / 100:.4f}")
    return losses


def main() -> None:
    torch.manual_seed(0)
    net = network()
    train(net, *rays_of(*photographs()))
    images, poses, focal = photographs("test")
    pictures = [picture(net, image, pose, focal) for image, pose in zip(images[:3], poses, strict=False)]
    print(f"{psnr(torch.stack(pictures), images[:3]):.1f} dB on photographs that it has not seen")
    save("nerf", *(x for pair in zip(images, pictures, strict=False) for x in pair))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/nerf.py` has both networks, poses that are learnt, and unbounded scenes.
# `components/sampling/hierarchical_sampler.py` leaves out what a grid knows to be empty, which is most of the work;
# `kernels/perceptron/` multiplies in bfloat16 without keeping activations. `methods/mip_nerf.py` encodes cones
# instead of points, `methods/nerf_w.py` gives each photograph its own light, `methods/regnerf/` needs three of them.
