"""NeuS: a surface as the zero of a signed distance, found by volume rendering (Wang et al. 2021).

Density has no surface. A signed distance f has one, and a logistic function makes it visible to rays: the photographs
then pull the zero level into place.
"""

import time

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import logsigmoid

from .camera import pinhole_rays
from .data import layer, photographs, psnr, save
from .nerf import encode, invert, rays_of, span, stratified
from .volume import composite, expected_depth

WIDTH, OCTAVES, COARSE, FINE, RAYS, STEPS, RATE = 64, 5, 24, 24, 256, 700, 3e-3
RADIUS, EIKONAL, MASK = 0.5, 0.1, 0.1  # of the first sphere, scene units; lambda and beta of eq. 14
Points = Float[Tensor, "*batch 3"]


def network() -> nn.ModuleDict:
    """Softplus and no kinks, for f is differentiated by the point; its last layer starts at zero: f is the sphere's."""
    layers = [nn.Linear(3 + 6 * OCTAVES, WIDTH), nn.Softplus(100), nn.Linear(WIDTH, WIDTH), nn.Softplus(100)]
    last = nn.Linear(WIDTH, 1 + WIDTH)
    nn.init.zeros_(last.weight[:1])
    nn.init.zeros_(last.bias)
    colour = nn.Sequential(nn.Linear(9 + WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 3))
    deviation = nn.ParameterDict({"v": nn.Parameter(torch.tensor(0.3))})
    return nn.ModuleDict({"distance": nn.Sequential(*layers, last), "colour": colour, "deviation": deviation})


def distance(net: nn.ModuleDict, x: Points) -> tuple[Float[Tensor, "*batch"], Tensor]:
    """f in scene units, negative inside, and features for the colour."""
    out = net["distance"](encode(x, OCTAVES))
    return out[..., 0] + x.norm(dim=-1) - RADIUS, out[..., 1:]


def with_gradient(net: nn.ModuleDict, x: Points, create: bool) -> tuple[Tensor, Points, Tensor]:
    """f, its gradient (the normal, where |grad f| = 1), and features."""
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        f, features = distance(net, x)
        (gradient,) = torch.autograd.grad(f.sum(), x, create_graph=create)
    return f, gradient, features


def alphas(f: Float[Tensor, "*n"], slope: Float[Tensor, "*n"], delta: Float[Tensor, "*n"], s: Tensor | float):
    """Opacity of intervals, max((Phi(f_i) - Phi(f_{i+1})) / Phi(f_i), 0) with Phi(f) = 1 / (1 + exp(-s f)) (eq. 13).

    f, slope: in the interval's middle; the ends are f -+ slope delta / 2. Where f rises, the ray leaves: no light.
    """
    half = 0.5 * slope.clamp(max=0) * delta
    return 1 - torch.exp(logsigmoid(s * (f + half)) - logsigmoid(s * (f - half)))  # 1 - Phi(f_{i+1}) / Phi(f_i)


def weights(alpha: Float[Tensor, "ray sample"]) -> Float[Tensor, "ray sample"]:
    """w_i = T_i alpha_i with T_i = prod_{j<i} (1 - alpha_j): `volume.weights` with alpha at hand."""
    T = torch.cumprod(torch.cat([torch.ones(len(alpha), 1), 1 - alpha], 1), 1)
    return T[:, :-1] * alpha


def render(net: nn.ModuleDict, o: Tensor, d: Tensor, learning: bool = False):
    """Colours, depths, normals and opacities of rays, and the eikonal term: the mean of (|grad f| - 1)^2 (eq. 16)."""
    near, far = span(o, d)
    far = torch.maximum(far, near + 1e-3)
    t = torch.cat([near, stratified(near, far, COARSE - 1, learning), far], 1)
    with torch.no_grad():  # more samples where a surface of that distance would be
        f, _ = distance(net, o[:, None] + t[..., None] * d[:, None])
        slope = f.diff(dim=1) / t.diff(dim=1).clamp_min(1e-6)  # two samples may meet
        rough = weights(alphas((f[:, 1:] + f[:, :-1]) / 2, slope, t.diff(dim=1), 32.0))
        shares = stratified(torch.zeros_like(near), torch.ones_like(near), FINE, learning)
        t = torch.cat([t, invert(t, rough, shares)], 1).sort(1).values
    middle = (t[:, 1:] + t[:, :-1]) / 2
    x = o[:, None] + middle[..., None] * d[:, None]
    f, gradient, features = with_gradient(net, x, learning)
    s = (10 * net["deviation"]["v"]).exp().clamp(max=300)
    w = weights(alphas(f, (gradient * d[:, None]).sum(-1), t.diff(dim=1), s))
    rgb = net["colour"](torch.cat([x, gradient, d[:, None].expand_as(x), features], -1)).sigmoid()
    normals = (w[..., None] * gradient).sum(1)
    return composite(w, rgb), expected_depth(w, middle), normals, w.sum(1), (gradient.norm(dim=-1) - 1).square().mean()


def train(net: nn.ModuleDict, o: Tensor, d: Tensor, truth: Tensor, steps: int = STEPS) -> list[float]:
    """L1 of colours, eikonal and mask (eq. 14): a white pixel shows nothing, else white surfaces would do as well."""
    optimizer, losses, begin = torch.optim.Adam(net.parameters(), RATE), [], time.perf_counter()
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = RATE * min(1.0, step / 20) * 0.05 ** (step / steps)
        chosen = torch.randint(len(o), (RAYS,))
        rgb, _, _, opacity, eikonal = render(net, o[chosen], d[chosen], learning=True)
        mask = nn.functional.binary_cross_entropy(opacity.clamp(1e-3, 0.999), (truth[chosen].amin(1) < 0.99).float())
        loss = (rgb - truth[chosen]).abs().mean() + EIKONAL * eikonal + MASK * mask
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
        if step % 50 == 49:
            s = (10 * net["deviation"]["v"].detach()).exp()
            print(f"step {step + 1:4}   {time.perf_counter() - begin:4.0f} s   loss {loss.item():.4f}   s {s:.0f}")
    return losses


def main() -> None:
    torch.manual_seed(0)
    net = network()
    train(net, *rays_of(*photographs()))
    images, poses, focal = photographs("test")
    depth, shown = layer("depth", "test"), []
    for i in range(2):
        o, d = pinhole_rays(images[i], poses[i], focal)
        with torch.no_grad():
            parts = [render(net, a, b) for a, b in zip(o.split(2048), d.split(2048), strict=True)]
        rgb, t, normals = (torch.cat(x).view(*images[i].shape[:2], -1) for x in list(zip(*parts, strict=True))[:3])
        solid = depth[i].isfinite()
        away = (t[..., 0] - depth[i])[solid].abs().median()
        print(f"{psnr(rgb, images[i]):.1f} dB unseen; the surface is {away:.4f} scene units off, in the median")
        shown += [images[i], rgb, torch.where(solid[..., None], 0.5 + 0.5 * normals, 1)]
    save("surface", *shown)


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/neus/` keeps the distance in a hash table whose levels join one by one, leaves
# out sections without weight, learns from masks, and adds density around the box in the open. `lumigraph export mesh`
# makes triangles of the zero level; `methods/planar_splatting/` fits planes instead, `methods/nglod/` known shapes.
