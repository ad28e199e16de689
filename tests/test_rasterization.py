"""rasterization(): pictures, depths and gradients against the definition, written densely in float64."""

from __future__ import annotations

import pytest
import torch
from budgets import budget

import lumigraph
from lumigraph.errors import LumigraphError
from lumigraph.geometry import to_matrix

pytestmark = budget("kernels", 4)

SIZE = 20, 16  # pixels
FOCAL = 24.0


def cloud(count: int = 12, channels: int = 3) -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(3)
    normal = lambda *shape: torch.randn(*shape, generator=random)  # noqa: E731
    return {
        "means": 0.4 * normal(count, 3),
        "quats": normal(count, 4),
        "scales": torch.exp(0.3 * normal(count, 3) - 2.0),
        "opacities": 0.1 + 0.6 * torch.rand(count, generator=random),
        "colors": torch.rand(count, channels, generator=random),
    }


def cameras(count: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    turns = torch.tensor([[1.0, 0.02 * i, 0.1 * i, 0.03] for i in range(count)])
    viewmats = torch.eye(4).repeat(count, 1, 1)
    viewmats[:, :3, :3] = to_matrix(torch.nn.functional.normalize(turns, dim=-1))
    viewmats[:, 2, 3] = 3.0
    width, height = SIZE
    intrinsics = torch.tensor([[FOCAL, 0.0, width / 2], [0.0, 1.1 * FOCAL, height / 2], [0.0, 0.0, 1.0]])
    return viewmats, intrinsics.repeat(count, 1, 1)


def definition(means, quats, scales, opacities, colors, viewmat, intrinsics, blur=0.3):
    """One picture of gsplat's equations over all Gaussians: colours and depth, opacity."""
    width, height = SIZE
    seen = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    rotation = to_matrix(torch.nn.functional.normalize(quats, dim=-1))
    spread = viewmat[:3, :3] @ rotation @ torch.diag_embed(scales)
    covariance = spread @ spread.transpose(1, 2)
    fx, fy = intrinsics[0, 0], intrinsics[1, 1]
    x, y, z = seen.unbind(-1)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], -1).view(-1, 2, 3)
    flat = jacobian @ covariance @ jacobian.transpose(1, 2) + blur * torch.eye(2, dtype=means.dtype)
    centre = torch.stack([fx * x / z + intrinsics[0, 2], fy * y / z + intrinsics[1, 2]], -1)
    row, column = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    away = torch.stack([column, row], -1)[..., None, :].to(means) - centre
    power = -0.5 * torch.einsum("hwni,nij,hwnj->hwn", away, flat.inverse(), away)
    alpha = opacities * power.exp()
    alpha = torch.where(alpha < 1 / 255, 0.0, alpha)
    order = z.argsort()
    alpha, values = alpha[..., order], torch.cat([colors, z[:, None]], -1)[order]
    light = torch.cumprod(1 - alpha, -1)
    weights = alpha * torch.cat([torch.ones_like(light[..., :1]), light[..., :-1]], -1)
    return weights @ values, weights.sum(-1)


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_pictures_are_those_of_the_definition(channels):
    given, (viewmats, intrinsics) = cloud(channels=channels), cameras()
    backgrounds = torch.rand(2, channels)
    picture, alpha, meta = lumigraph.rasterization(
        **given,
        viewmats=viewmats,
        Ks=intrinsics,
        width=SIZE[0],
        height=SIZE[1],
        backgrounds=backgrounds,
        render_mode="RGB+ED",
    )
    assert picture.shape == (2, SIZE[1], SIZE[0], channels + 1) and alpha.shape == (2, SIZE[1], SIZE[0], 1)
    for i in range(2):
        exact = {name: value.double() for name, value in given.items()}
        values, opacity = definition(**exact, viewmat=viewmats[i].double(), intrinsics=intrinsics[i].double())
        colours = values[..., :-1] + (1 - opacity)[..., None] * backgrounds[i]
        assert torch.allclose(picture[i, ..., :-1].double(), colours, atol=2e-4)
        assert torch.allclose(alpha[i, ..., 0].double(), opacity, atol=2e-4)
        solid = opacity > 0.05
        assert torch.allclose(picture[i, ..., -1].double()[solid], (values[..., -1] / opacity)[solid], rtol=2e-3)
    rows = len(meta["gaussian_ids"])
    assert meta["means2d"].shape == (rows, 2) and 12 < rows <= 24 and (meta["radii"] > 0).all()


def test_gradients_are_those_of_the_definition():
    given, (viewmats, intrinsics) = cloud(), cameras(1)
    weight = torch.rand(SIZE[1], SIZE[0], 3, generator=torch.Generator().manual_seed(0))
    axis = torch.zeros(3, requires_grad=True)
    shift = torch.zeros(3, requires_grad=True)

    def moved(axis, shift, start):
        cross = torch.stack(
            [
                axis.new_zeros(()),
                -axis[2],
                axis[1],
                axis[2],
                axis.new_zeros(()),
                -axis[0],
                -axis[1],
                axis[0],
                axis.new_zeros(()),
            ]
        ).view(3, 3)
        pose = torch.cat([(torch.eye(3).to(axis) + cross) @ start[:3, :3], start[:3, 3:] + shift[:, None]], 1)
        return torch.cat([pose, start[3:]])

    ours = {name: value.clone().requires_grad_() for name, value in given.items()}
    seen, _, meta = lumigraph.rasterization(
        **ours, viewmats=moved(axis, shift, viewmats[0])[None], Ks=intrinsics, width=SIZE[0], height=SIZE[1]
    )
    meta["means2d"].retain_grad()
    (seen[0] * weight).sum().backward()
    exact = {name: value.double().requires_grad_() for name, value in given.items()}
    pose = [x.detach().double().requires_grad_() for x in (axis, shift)]
    values, _ = definition(**exact, viewmat=moved(*pose, viewmats[0].double()), intrinsics=intrinsics[0].double())
    (values[..., :-1] * weight).sum().backward()
    pairs = {name: (ours[name].grad, exact[name].grad) for name in given}
    pairs |= {"axis": (axis.grad, pose[0].grad), "shift": (shift.grad, pose[1].grad)}
    for name, (found, wanted) in pairs.items():
        assert torch.allclose(found.double(), wanted, rtol=0.02, atol=2e-3 * float(wanted.abs().max())), name
    assert meta["means2d"].grad.abs().sum() > 0


def test_rows_of_the_dictionary_are_those_of_gsplat():
    """Packed and not: the same picture, the same gradient of each pair's centre, radii that hold the footprint."""
    given, (viewmats, intrinsics) = cloud(), cameras()
    given["means"][3, 2] = -50.0  # behind both cameras
    asked = {"viewmats": viewmats, "Ks": intrinsics, "width": SIZE[0], "height": SIZE[1]}
    found = {}
    for packed in (True, False):
        ours = {name: value.clone().requires_grad_() for name, value in given.items()}
        picture, _, meta = lumigraph.rasterization(**ours, **asked, packed=packed)
        meta["means2d"].retain_grad()
        picture.square().sum().backward()
        found[packed] = picture, meta, {name: value.grad for name, value in ours.items()}
    (one, rows, ours), (other, whole, theirs) = found[True], found[False]
    assert torch.equal(one, other) and whole["gaussian_ids"] is None and whole["means2d"].shape == (2, 12, 2)
    for name, gradient in ours.items():
        torch.testing.assert_close(gradient, theirs[name])
    pairs = rows["camera_ids"], rows["gaussian_ids"]
    assert 3 not in pairs[1] and torch.equal(torch.stack(pairs, -1), (whole["radii"] > 0).all(-1).nonzero())
    torch.testing.assert_close(rows["means2d"].grad, whole["means2d"].grad[pairs])
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert torch.equal(rows[name], whole[name][pairs]), name
    xx, xy, yy = rows["conics"].unbind(-1)
    width = (yy / (xx * yy - xy * xy)).sqrt()
    reach = (2 * (255 * rows["opacities"]).log()).sqrt().clamp_max(3.33)
    assert torch.equal(rows["radii"][:, 0], (reach * width).ceil().int()) and rows["radii"].dtype == torch.int32


def test_harmonics_give_the_colours_of_each_camera():
    given, (viewmats, intrinsics) = cloud(), cameras()
    coefficients = torch.zeros(12, 4, 3)
    coefficients[:, 2] = 0.5  # grows along z
    given["colors"] = coefficients
    size = {"width": SIZE[0], "height": SIZE[1]}
    picture, alpha, _ = lumigraph.rasterization(**given, viewmats=viewmats, Ks=intrinsics, sh_degree=1, **size)
    plain, _, _ = lumigraph.rasterization(**given, viewmats=viewmats, Ks=intrinsics, sh_degree=0, **size)
    assert torch.allclose(plain[..., 0], 0.5 * alpha[..., 0], atol=1e-5)
    assert (picture >= plain - 1e-6).all() and (picture > plain + 0.05).any()  # both cameras look along +z


def test_far_and_small_gaussians_are_left_out():
    given, (viewmats, intrinsics) = cloud(), cameras(1)
    asked = {"viewmats": viewmats, "Ks": intrinsics, "width": SIZE[0], "height": SIZE[1]}
    assert lumigraph.rasterization(**given, **asked, far_plane=1.0)[1].max() == 0
    assert lumigraph.rasterization(**given, **asked, radius_clip=1e3)[1].max() == 0


@pytest.mark.parametrize(
    "option",
    [
        {"render_mode": "RGD"},
        {"rasterize_mode": "sharp"},
        {"absgrad": True},
        {"camera_model": "fisheye"},
        {"sh_degree": 4},
        {"with_ut": True},
    ],
)
def test_what_there_is_not_is_refused_in_one_sentence(option):
    given, (viewmats, intrinsics) = cloud(), cameras(1)
    with pytest.raises(LumigraphError, match=next(iter(option))):
        lumigraph.rasterization(**given, viewmats=viewmats, Ks=intrinsics, width=20, height=16, **option)
