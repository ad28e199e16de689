"""A photograph as 2-D Gaussians, in NumPy alone: the whole of splatting but the third dimension.

Each Gaussian is a coloured ellipse: a centre mu, an inverse covariance, an opacity o, a colour c. A pixel x meets them
front to back. Every gradient below is written by hand.

    alpha_i = o_i exp(-q_i / 2)        q_i = d^T M_i d        d = x - mu_i
    C = sum_i T_i alpha_i c_i          T_i = prod_{j<i} (1 - alpha_j)                            (Kerbl 2023, eq. 3)
"""

import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from .data import photographs, save

COUNT, STEPS, SIDE = 900, 240, 16  # Gaussians; steps; pixels of a tile's side
RATES = {"mu": 0.35, "log_scale": 0.03, "angle": 0.03, "logit": 0.08, "colour": 0.02}
MIN_ALPHA, MAX_ALPHA = 1 / 255, 0.99
Cloud = dict[str, Float[np.ndarray, "gaussian *values"]]
Pixels = Float[np.ndarray, "pixel 2"]


def random_cloud(image: Float[np.ndarray, "height width 3"], count: int, seed: int = 0) -> Cloud:
    """Gaussians at random places, in the colours of the photograph there."""
    random = np.random.default_rng(seed)
    height, width = image.shape[:2]
    edges = np.abs(np.gradient(image.mean(2))).sum(0) + 0.02
    place = random.choice(height * width, count, p=(edges / edges.sum()).ravel())
    y, x = np.divmod(place, width)
    return {
        "mu": np.stack([x, y], 1) + random.random((count, 2)),
        "log_scale": np.full((count, 2), np.log(0.45 * np.sqrt(height * width / count))),
        "angle": random.uniform(0, np.pi, count),
        "logit": np.zeros(count),
        "colour": image[y, x].astype(float),
    }


def conics(log_scale: Float[np.ndarray, "gaussian 2"], angle: Float[np.ndarray, " gaussian"]):
    """M = R diag(1 / s^2) R^T as (M_xx, M_xy, M_yy), from the standard deviations s and the angle of R."""
    p, q = np.exp(-2 * log_scale).T
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * c * p + s * s * q, c * s * (p - q), s * s * p + c * c * q], 1)


def conics_gradient(log_scale, angle, g: Float[np.ndarray, "gaussian 3"]):
    """Gradients in s and the angle, from those in M."""
    p, q = np.exp(-2 * log_scale).T
    c, s = np.cos(angle), np.sin(angle)
    g_p = c * c * g[:, 0] + c * s * g[:, 1] + s * s * g[:, 2]
    g_q = s * s * g[:, 0] - c * s * g[:, 1] + c * c * g[:, 2]
    g_angle = (p - q) * (-2 * c * s * g[:, 0] + (c * c - s * s) * g[:, 1] + 2 * c * s * g[:, 2])
    return np.stack([-2 * p * g_p, -2 * q * g_q], 1), g_angle  # dp / d log s = -2 p


def forward(pixels: Pixels, mu, M, o, colour) -> tuple[Float[np.ndarray, "pixel 3"], tuple]:
    """Colours of pixels before black, and what the gradient needs again."""
    d = pixels[:, None] - mu
    q = M[:, 0] * d[..., 0] ** 2 + 2 * M[:, 1] * d[..., 0] * d[..., 1] + M[:, 2] * d[..., 1] ** 2
    G = np.exp(-q / 2)
    raw = o * G
    alpha = np.where(raw < MIN_ALPHA, 0, np.minimum(raw, MAX_ALPHA))
    T = np.cumprod(np.concatenate([np.ones((len(pixels), 1)), 1 - alpha[:, :-1]], 1), 1)
    w = T * alpha
    return w @ colour, (d, G, raw, alpha, T, w)


def backward(g: Float[np.ndarray, "pixel 3"], seen: tuple, M, o, colour):
    """Gradients in mu, M, o and colour, from those in the pixels' colours.

        dC/dc_i = w_i        dC/dalpha_i = T_i c_i - (sum_{j>i} w_j c_j) / (1 - alpha_i)

    The second says: more of i shows its colour, and hides that of all behind it.
    """
    d, G, raw, alpha, T, w = seen
    shown = g @ colour.T  # (pixel, gaussian): g . c_i
    light = w * shown
    behind = light.sum(1, keepdims=True) - np.cumsum(light, 1)
    g_alpha = T * shown - behind / (1 - alpha)
    g_raw = np.where((raw < MIN_ALPHA) | (raw > MAX_ALPHA), 0, g_alpha)
    g_q = -g_raw * raw / 2
    dx, dy = d[..., 0], d[..., 1]
    g_M = np.stack([(g_q * dx * dx).sum(0), (2 * g_q * dx * dy).sum(0), (g_q * dy * dy).sum(0)], 1)
    g_x = -2 * (g_q * (M[:, 0] * dx + M[:, 1] * dy)).sum(0)  # dq/dmu = -2 M d
    g_y = -2 * (g_q * (M[:, 1] * dx + M[:, 2] * dy)).sum(0)
    return np.stack([g_x, g_y], 1), g_M, (g_raw * G).sum(0), w.T @ g


def tiles(width: int, height: int, mu, M, o) -> Iterator[tuple[Int[np.ndarray, " pixel"], Int[np.ndarray, " some"]]]:
    """Squares of pixels, each with the Gaussians that reach it: o exp(-q/2) >= 1/255 where |d_x| <= sqrt(r M^-1_xx)."""
    r = 2 * np.log(np.maximum(o / MIN_ALPHA, 1))
    det = M[:, 0] * M[:, 2] - M[:, 1] ** 2
    reach = np.sqrt(r[:, None] * np.stack([M[:, 2], M[:, 0]], 1) / det[:, None])
    low, high = mu - reach, mu + reach
    for top in range(0, height, SIDE):
        for left in range(0, width, SIDE):
            y, x = np.mgrid[top : min(top + SIDE, height), left : min(left + SIDE, width)]
            meet = (high >= (left, top)).all(1) & (low <= (left + SIDE, top + SIDE)).all(1)
            yield (y * width + x).ravel(), np.flatnonzero(meet)


def draw(cloud: Cloud, width: int, height: int, target: Float[np.ndarray, "pixel 3"] | None = None):
    """The picture, and with a target the gradient of half its squared error in everything."""
    M, o = conics(cloud["log_scale"], cloud["angle"]), 1 / (1 + np.exp(-cloud["logit"]))
    picture = np.zeros((height * width, 3))
    g_mu, g_M, g_o, g_colour = (np.zeros_like(x) for x in (cloud["mu"], M, o, cloud["colour"]))
    for pixels, i in tiles(width, height, cloud["mu"], M, o):
        centres = np.stack([pixels % width, pixels // width], 1) + 0.5
        picture[pixels], seen = forward(centres, cloud["mu"][i], M[i], o[i], cloud["colour"][i])
        if target is not None:
            parts = backward(picture[pixels] - target[pixels], seen, M[i], o[i], cloud["colour"][i])
            for total, part in zip((g_mu, g_M, g_o, g_colour), parts, strict=True):
                total[i] += part
    g_scale, g_angle = conics_gradient(cloud["log_scale"], cloud["angle"], g_M)
    gradient = {"mu": g_mu, "log_scale": g_scale, "angle": g_angle, "logit": g_o * o * (1 - o), "colour": g_colour}
    return picture, gradient


def adam(values: Cloud, gradient: Cloud, state: dict, step: int, rate: float) -> None:
    """Adam (Kingma and Ba 2015): the mean of gradients over the root of the mean of their squares."""
    for name, x in values.items():
        m, v = state.setdefault(name, (np.zeros_like(x), np.zeros_like(x)))
        m += 0.1 * (gradient[name] - m)
        v += 0.01 * (gradient[name] ** 2 - v)
        x -= rate * RATES[name] * (m / (1 - 0.9**step)) / (np.sqrt(v / (1 - 0.99**step)) + 1e-12)


def fit(
    image: Float[np.ndarray, "height width 3"], count: int = COUNT, steps: int = STEPS
) -> tuple[Cloud, list[float]]:
    """A cloud that shows the photograph, and the mean squared error of each step."""
    height, width = image.shape[:2]
    cloud, state, errors, begin = random_cloud(image, count), {}, [], time.perf_counter()
    target = image.reshape(-1, 3).astype(float)
    for step in range(1, steps + 1):
        picture, gradient = draw(cloud, width, height, target)
        errors.append(float(((picture - target) ** 2).mean()))
        adam(cloud, gradient, state, step, 0.1 ** (step / steps))
        if step % 40 == 0 or step == 1:
            print(f"step {step:4}   {time.perf_counter() - begin:4.0f} s   {-10 * np.log10(errors[-1]):.1f} dB")
    return cloud, errors


def main() -> None:
    import torch

    image = photographs("test")[0][1].numpy()
    height, width = image.shape[:2]
    first, (cloud, _) = random_cloud(image, COUNT), fit(image)
    bare = cloud | {"log_scale": cloud["log_scale"] - 1.2, "logit": cloud["logit"] + 3}
    shown = [draw(x, width, height)[0].reshape(image.shape) for x in (first, bare, cloud)]
    save("microsplat", *(torch.tensor(x) for x in (*shown, image)))


if __name__ == "__main__":
    main()

# In the large one: `lumigraph/kernels/rasterize/` is `forward` and `backward` for splats, in loops over pixels that
# stop where T is small; `kernels/tile/` sorts Gaussians into tiles by one key of tile and depth. `splats.py` is the
# next file: the same ellipses, as shadows of ellipsoids in space.
