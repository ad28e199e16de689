"""3-D Gaussian splatting: a scene as ellipsoids whose shadows on a picture are blended (Kerbl et al. 2023).

Project each ellipsoid to an ellipse, sort by depth, blend front to back, descend. PyTorch differentiates the
projection; the gradient of the blending is written by hand, as every splatting program has it.
"""

import time
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from .bake import harmonics
from .camera import project as to_pixels
from .data import BOX, photographs, psnr, save

COUNT, MOST, STEPS, SIDE = 1500, 3000, 320, 16  # Gaussians at first and at most; steps; pixels of a tile's side
MIN_ALPHA, MAX_ALPHA, BLUR = 1 / 255, 0.99, 0.3  # BLUR: square pixels, so that no ellipse falls between pixels
REFINE_EVERY, REFINE_UNTIL, SPLIT_FACTOR, PRUNE_OPACITY = 50, 200, 1.6, 0.02
RATES = {"means": 6e-3, "quaternions": 5e-3, "log_scales": 2e-2, "logits": 5e-2, "harmonics": 1.5e-2}
Cloud = dict[str, Tensor]  # the names of RATES, a row for each Gaussian
Footprints = tuple[Tensor, Tensor, Tensor, Tensor]  # centres (pixels), conics, opacities, colours


def carve(images: Tensor, poses: Tensor, focal: float, count: int) -> Cloud:
    """Gaussians at random points that no photograph shows as background (the visual hull), all of them grey."""
    points = torch.lerp(BOX[0], BOX[1], torch.rand(40 * count, 3))
    inside = torch.ones(len(points), dtype=torch.bool)
    for image, pose in zip(images, poses, strict=True):
        height, width = image.shape[:2]
        x, y = to_pixels((points - pose[:, 3]) @ pose[:, :3], focal, torch.tensor([width / 2, height / 2])).long().T
        inside &= (x >= 0) & (x < width) & (y >= 0) & (y < height)
        inside &= (image[y.clamp(0, height - 1), x.clamp(0, width - 1)] < 0.99).any(1)
    kept = inside.nonzero()[:count, 0]
    spacing = float(((BOX[1] - BOX[0]).prod() * inside.float().mean() / len(kept)) ** (1 / 3))
    return {
        "means": points[kept],
        "quaternions": torch.tensor([1.0, 0, 0, 0]).repeat(len(kept), 1),
        "log_scales": torch.full((len(kept), 3), 0.4 * spacing).log(),
        "logits": torch.zeros(len(kept)),
        "harmonics": torch.zeros(len(kept), 4, 3),
    }


def rotations(quaternions: Float[Tensor, "gaussian 4"]) -> Float[Tensor, "gaussian 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length."""
    w, x, y, z = normalize(quaternions, dim=1).unbind(1)
    rows = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]
    rows += [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]
    rows += [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    return torch.stack(rows, 1).view(-1, 3, 3)


def project(cloud: Cloud, pose: Float[Tensor, "3 4"], focal: float, size: tuple[int, int]):
    """Footprints and depths: an ellipsoid seen from afar is an ellipse (Zwicker 2002; Kerbl 2023, eq. 5).

    Sigma = Q diag(s)^2 Q^T in the world; C = J W Sigma W^T J^T on the picture, J the slope of (u, v) in (x, y, z).
    """
    W = pose[:, :3].T  # world to camera
    x, y, z = (p := (cloud["means"] - pose[:, 3]) @ W.T).unbind(1)
    centres = to_pixels(p, focal, torch.tensor(size) / 2)
    zero = torch.zeros_like(z)
    J = focal * torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2], 1).view(-1, 2, 3)
    A = J @ W @ rotations(cloud["quaternions"]) * cloud["log_scales"].exp()[:, None]  # C = A A^T
    C = A @ A.mT + BLUR * torch.eye(2)
    a, b, c = C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]
    conics = torch.stack([c, -b, a], 1) / (a * c - b * b)[:, None]  # C^-1
    Y = harmonics(normalize(cloud["means"] - pose[:, 3], dim=1))
    colours = (0.5 + (Y[..., None] * cloud["harmonics"]).sum(1)).clamp_min(0)  # 1/2 + sum_k Y_k(d) h_k
    return (centres, conics, cloud["logits"].sigmoid(), colours), z


def tiles(prints: Footprints, depths: Tensor, size: tuple[int, int]) -> Iterator[tuple[Tensor, Int[Tensor, " some"]]]:
    """Squares of pixels, each with the Gaussians that reach it, nearest first: alpha >= 1/255 is q <= 2 log(255 o)."""
    centres, conics, o, _ = prints
    det = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
    q = 2 * (o / MIN_ALPHA).clamp_min(1).log()
    reach = (q[:, None] * conics[:, [2, 0]] / det[:, None]).sqrt()
    order = depths.argsort()
    order = order[(depths > 0.1)[order]]
    low, high = (centres - reach)[order], (centres + reach)[order]
    for top in range(0, size[1], SIDE):
        for left in range(0, size[0], SIDE):
            corner = torch.tensor([left, top])
            y, x = torch.arange(top, min(top + SIDE, size[1])), torch.arange(left, min(left + SIDE, size[0]))
            meet = ((high >= corner) & (low <= corner + SIDE)).all(1)
            yield torch.cartesian_prod(y, x).flip(1), order[meet]


def blend(at: Float[Tensor, "pixel 2"], prints: Footprints) -> tuple[Float[Tensor, "pixel 3"], tuple]:
    """Colours before white, C = sum_i T_i alpha_i c_i + T_end, T_i = prod_{j<i} (1 - alpha_j); and what is used again.

    alpha_i = o_i exp(-q_i / 2), q_i = d^T C_i^-1 d (eq. 3)
    """
    centres, conics, o, colour = prints
    d = at[:, None] - centres
    q = conics[:, 0] * d[..., 0] ** 2 + 2 * conics[:, 1] * d[..., 0] * d[..., 1] + conics[:, 2] * d[..., 1] ** 2
    G = torch.exp(-q / 2)
    raw = o * G
    alpha = torch.where(raw < MIN_ALPHA, 0, raw.clamp(max=MAX_ALPHA))
    T = torch.cumprod(torch.cat([torch.ones(len(at), 1), 1 - alpha], 1), 1)
    w = T[:, :-1] * alpha
    return w @ colour + T[:, -1:], (alpha, raw, G, d, T, w)


def blend_gradient(g: Float[Tensor, "pixel 3"], kept: tuple, prints: Footprints) -> Footprints:
    """Gradients in centres, conics, opacities and colours from those in pixels.

    dC/dc_i = w_i        dC/dalpha_i = T_i c_i - (sum_{j>i} w_j c_j + T_end) / (1 - alpha_i)
    """
    (alpha, raw, G, d, T, w), (_, conics, _, rgb) = kept, prints
    shown = g @ rgb.T
    light = w * shown
    behind = light.sum(1, keepdim=True) - light.cumsum(1) + T[:, -1:] * g.sum(1, keepdim=True)
    g_alpha = T[:, :-1] * shown - behind / (1 - alpha)
    g_raw = torch.where((raw < MIN_ALPHA) | (raw > MAX_ALPHA), 0, g_alpha)
    g_q, (dx, dy) = -g_raw * raw / 2, d.unbind(2)
    along_x, along_y = (g_q * dx).sum(0), (g_q * dy).sum(0)  # dq/dmu = -2 C^-1 d
    g_x = -2 * (conics[:, 0] * along_x + conics[:, 1] * along_y)
    g_y = -2 * (conics[:, 1] * along_x + conics[:, 2] * along_y)
    g_conics = torch.stack([(g_q * dx * dx).sum(0), 2 * (g_q * dx * dy).sum(0), (g_q * dy * dy).sum(0)], 1)
    return torch.stack([g_x, g_y], 1), g_conics, (g_raw * G).sum(0), w.T @ g


@torch.no_grad()
def draw(prints: Footprints, depths: Tensor, size: tuple[int, int], target: Tensor | None = None):
    """The picture, and with a target the gradients of its mean absolute error in the footprints."""
    picture, gradients = torch.ones(size[1], size[0], 3), tuple(torch.zeros_like(x) for x in prints)
    for pixels, i in tiles(prints, depths, size):
        some = tuple(x[i] for x in prints)
        rgb, kept = blend(pixels + 0.5, some)
        picture[pixels[:, 1], pixels[:, 0]] = rgb
        if target is not None:
            g = (rgb - target[pixels[:, 1], pixels[:, 0]]).sign() / picture.numel()
            for total, part in zip(gradients, blend_gradient(g, kept, some), strict=True):
                total[i] += part  # each Gaussian once in a tile
    return picture, gradients


@torch.no_grad()
def refine(cloud: Cloud, slopes: Float[Tensor, " gaussian"], spread: float = 0.05) -> Cloud:
    """Density control (section 5): prune what is faint; where the error pulls, clone what is small, split the rest."""
    bright = cloud["logits"].sigmoid() > PRUNE_OPACITY
    room = max(0, min(MOST - int(bright.sum()), len(slopes) // 3))
    pulled = torch.zeros_like(bright)
    pulled[(slopes * bright).argsort(descending=True)[:room]] = True
    pulled &= bright
    large = pulled & (cloud["log_scales"].exp().amax(1) > spread)
    old, new = ({k: v[mask].clone() for k, v in cloud.items()} for mask in (bright, pulled))
    for part, split, moves in (old, large[bright], large[bright]), (new, large[pulled], True):
        within = (part["log_scales"].exp() * torch.randn_like(part["means"]))[..., None]  # of the ellipsoid
        step = (rotations(part["quaternions"]) @ within)[..., 0]
        part["means"] += 0.7 * step * torch.as_tensor(moves).view(-1, 1)
        part["log_scales"] -= torch.where(split, SPLIT_FACTOR, 1.0).log()[:, None]
    return {k: torch.cat([old[k], new[k]]) for k in cloud}


def train(cloud: Cloud, images: Tensor, poses: Tensor, focal: float, steps: int = STEPS) -> tuple[Cloud, list[float]]:
    """One photograph a step; the means' rate falls. Returns the cloud and the mean absolute error of each step."""
    size, begin, losses = (images.shape[2], images.shape[1]), time.perf_counter(), []
    for step in range(steps):
        if step % REFINE_EVERY == 0:
            cloud = refine(cloud, slopes) if 0 < step <= REFINE_UNTIL else cloud
            cloud = {k: v.detach().clone().requires_grad_() for k, v in cloud.items()}
            optimizer = torch.optim.Adam([{"params": [cloud[k]], "lr": rate} for k, rate in RATES.items()], eps=1e-15)
            slopes = torch.zeros(len(cloud["means"]))
        optimizer.param_groups[0]["lr"] = RATES["means"] * 0.02 ** (step / steps)
        k = int(torch.randint(len(images), (1,)))
        prints, depths = project(cloud, poses[k], focal, size)
        picture, gradients = draw(prints, depths, size, images[k])
        optimizer.zero_grad()
        torch.autograd.backward(prints, gradients)  # from the footprints to the ellipsoids
        optimizer.step()
        slopes += gradients[0].norm(dim=1)
        losses.append((picture - images[k]).abs().mean().item())
        if step % 50 == 49:
            spent = time.perf_counter() - begin
            print(f"step {step + 1:4}   {spent:4.0f} s   {len(slopes)} Gaussians   error {losses[-1]:.4f}")
    return cloud, losses


def main() -> None:
    torch.manual_seed(0)
    images, poses, focal = photographs()
    cloud, _ = train(carve(images, poses, focal, COUNT), images, poses, focal)
    images, poses, focal = photographs("test")
    size = images.shape[2], images.shape[1]
    pictures = [draw(*project(cloud, pose, focal, size), size)[0] for pose in poses[:3]]
    print(f"{psnr(torch.stack(pictures), images[:3]):.1f} dB on photographs that it has not seen")
    save("splats", *(x for pair in zip(images, pictures, strict=False) for x in pair))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/methods/gaussian_splatting/` and `components/clouds/`: three more bands, structural
# similarity, moments that outlive density control. `kernels/project/`, `kernels/tile/`, `kernels/rasterize/` are
# `project`, `tiles`, `blend` and its gradient in loops that stop where T is small.
