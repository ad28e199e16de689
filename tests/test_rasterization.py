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


def rays_in(points, intrinsics, model):
    """Pixels of points in the camera's frame, of each camera model's equation."""
    x, y, z = points.unbind(-1)
    if model == "ortho":
        flat = points[..., :2]
    elif model == "fisheye":
        r = torch.hypot(x, y)
        flat = points[..., :2] * (torch.atan2(r, z) / r)[..., None]
    else:
        flat = points[..., :2] / z[..., None]
    return flat * intrinsics[[0, 1], [0, 1]] + intrinsics[:2, 2]


def exactly(given, viewmat, intrinsics, model="pinhole", antialiased=False, blur=0.3, exclusive=True, spread=None):
    """One picture of the equations in float64: the Jacobian is autograd's. spread: gets absolute gradients."""
    seen = given["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    if "covars" in given:
        covariance = viewmat[:3, :3] @ given["covars"] @ viewmat[:3, :3].T
    else:
        axes = viewmat[:3, :3] @ to_matrix(given["quats"]) @ torch.diag_embed(given["scales"])
        covariance = axes @ axes.mT
    jacobian = torch.func.vmap(torch.func.jacrev(lambda p: rays_in(p, intrinsics, model)))(seen)
    narrow = jacobian @ covariance @ jacobian.mT
    flat = narrow + blur * torch.eye(2, dtype=narrow.dtype)
    factor = (narrow.det() / flat.det()).clamp_min(0.005**2).sqrt() if antialiased else 1.0
    row, column = torch.meshgrid(torch.arange(SIZE[1]) + 0.5, torch.arange(SIZE[0]) + 0.5, indexing="ij")
    away = torch.stack([column, row], -1)[..., None, :].to(narrow) - rays_in(seen, intrinsics, model)
    if spread is not None:
        away.register_hook(lambda g: (spread.add_(g.abs().sum((0, 1))), None)[1])
    raw = given["opacities"] * factor * torch.exp(-0.5 * torch.einsum("hwni,nij,hwnj->hwn", away, flat.inverse(), away))
    alpha = torch.where(raw < 1 / 255, 0.0, raw.clamp(max=0.99))
    order = seen[:, 2].argsort()
    alpha, values = alpha[..., order], torch.cat([given["colors"], seen[:, 2:]], -1)[order]
    light = torch.nn.functional.pad(1 - alpha, (1, 0), value=1.0).cumprod(-1)
    ended = light[..., 1:] <= 1e-4 if exclusive else light[..., :-1] < 1e-4
    weights = torch.where(ended, 0.0, alpha * light[..., :-1])
    return weights @ values, weights.sum(-1)


def largest(found, wanted):
    """Largest error, of the largest value."""
    return float((found.double() - wanted).abs().max() / wanted.abs().max().clamp_min(1e-9))


WAYS = {
    "ortho": ({"camera_model": "ortho"}, {"model": "ortho"}),
    "fisheye": ({"camera_model": "fisheye"}, {"model": "fisheye"}),
    "antialiased": ({"rasterize_mode": "antialiased"}, {"antialiased": True}),
    "antialiased fisheye": (
        {"rasterize_mode": "antialiased", "camera_model": "fisheye"},
        {"antialiased": True, "model": "fisheye"},
    ),
    "covars": ({"covars": True}, {}),
    "eps2d": ({"eps2d": 0.05}, {"blur": 0.05}),
    "last": ({"include_last": True}, {"exclusive": False}),
    "not last": ({}, {}),
    "float64": ({"double": True}, {}),
}


@pytest.mark.parametrize("way", WAYS)
def test_each_way_has_values_and_gradients_of_its_equations(way):
    options, exact = WAYS[way]
    options, given, (viewmats, intrinsics) = dict(options), cloud(), cameras(1)
    if "last" in way:
        given["opacities"] = 0.9 + 0.09 * torch.rand(12)
    if options.get("camera_model") == "ortho":
        intrinsics[:, [0, 1], [0, 1]] /= 3
    if options.pop("double", False):
        given = {name: value.double() for name, value in given.items()}
    if options.pop("covars", False):
        axes = to_matrix(given["quats"]) * given["scales"][:, None]
        given = {**given, "covars": axes @ axes.mT}
        given.pop("quats"), given.pop("scales")
    truth = {name: value.detach().double().requires_grad_() for name, value in given.items()}
    ours = {name: value.detach().clone().requires_grad_() for name, value in given.items()}
    poses = viewmats.clone().requires_grad_()
    spare = {} if "quats" in ours else {"quats": None, "scales": None}
    sizes = {"Ks": intrinsics, "width": SIZE[0], "height": SIZE[1], "render_mode": "RGB+D", "absgrad": True}
    picture, alpha, info = lumigraph.rasterization(**ours, **spare, viewmats=poses, **sizes, **options)
    spread = torch.zeros(12, 2, dtype=torch.float64)
    pose = viewmats[0].double().requires_grad_()
    values, opacity = exactly(truth, pose, intrinsics[0].double(), **exact, spread=spread)
    weight = torch.rand(SIZE[1], SIZE[0], 5, generator=torch.Generator().manual_seed(0)).double() - 0.3
    (torch.cat([picture[0], alpha[0]], -1).double() * weight).sum().backward()
    (torch.cat([values, opacity[..., None]], -1) * weight).sum().backward()
    assert largest(picture[0], values) < 1e-4 and largest(alpha[0, ..., 0], opacity) < 1e-4
    for name in truth:
        assert largest(ours[name].grad, truth[name].grad) < 1e-4, name
    assert largest(poses.grad[0, :3, 3], pose.grad[:3, 3]) < 1e-4
    assert largest(info["means2d"].absgrad, spread[info["gaussian_ids"]]) < 1e-4
    assert "last" not in way or float((1 - opacity).min()) < 1e-2


def test_the_unscented_transform_of_a_straight_lens_is_nearly_the_affine_one():
    """Small Gaussians, where a lens is straight; and distortion moves centres as OpenCV's equation does."""
    given, (viewmats, intrinsics) = cloud(), cameras(1)
    given["scales"] *= 0.02
    asked = {"viewmats": viewmats, "Ks": intrinsics, "width": SIZE[0], "height": SIZE[1], "packed": False}
    for model in ("pinhole", "fisheye"):
        plain = lumigraph.rasterization(**given, **asked, camera_model=model)[0]
        bent, _, info = lumigraph.rasterization(**given, **asked, camera_model=model, with_ut=True)
        torch.testing.assert_close(bent, plain, atol=2e-3, rtol=0)
    coefficients = {"radial_coeffs": torch.tensor([[0.1, 0.02, 0.0, 0.0, 0.0, 0.0]]),
                    "tangential_coeffs": torch.tensor([[0.01, -0.02]])}  # fmt: skip
    _, _, info = lumigraph.rasterization(**given, **asked, with_ut=True, **coefficients)
    seen = given["means"] @ viewmats[0, :3, :3].T + viewmats[0, :3, 3]
    x, y = (seen[:, :2] / seen[:, 2:]).unbind(-1)
    r = x * x + y * y
    q = 1 + 0.1 * r + 0.02 * r * r
    bent = torch.stack(
        [x * q + 0.02 * x * y - 0.02 * (r + 2 * x * x), y * q + 0.01 * (r + 2 * y * y) - 0.04 * x * y], -1
    )
    shown = (info["radii"][0] > 0).all(-1)
    wanted = bent * intrinsics[0, [0, 1], [0, 1]] + intrinsics[0, :2, 2]
    torch.testing.assert_close(info["means2d"][0][shown], wanted[shown], atol=1e-3, rtol=0)
    assert shown.sum() > 6


def test_batches_colours_of_cameras_signals_and_background_are_those_of_single_calls():
    clouds, (viewmats, intrinsics) = [cloud(channels=5), cloud(channels=5)], cameras()
    clouds[1]["means"] = clouds[1]["means"] + 0.1
    for given in clouds:
        given["colors"] = torch.stack([given["colors"], given["colors"].flip(-1)])  # of two cameras
    both = {name: torch.stack([x[name] for x in clouds]) for name in clouds[0]}
    asked = {"width": SIZE[0], "height": SIZE[1], "render_mode": "RGB+ED"}
    backgrounds, signals = torch.rand(2, 2, 5), torch.rand(2, 12, 4)
    for packed in (True, False):
        picture, alpha, info = lumigraph.rasterization(
            **both, viewmats=viewmats.expand(2, 2, 4, 4), Ks=intrinsics.expand(2, 2, 3, 3), **asked, packed=packed,
            backgrounds=backgrounds, extra_signals=signals)  # fmt: skip
        assert info["n_batches"] == 2 and info["render_extra_signals"].shape == (2, 2, SIZE[1], SIZE[0], 4)
        for b in range(2):
            for c in range(2):
                own = {**clouds[b], "colors": clouds[b]["colors"][c]}
                camera = {"viewmats": viewmats[c : c + 1], "Ks": intrinsics[c : c + 1]}
                one, _, _ = lumigraph.rasterization(**own, **camera, **asked, backgrounds=backgrounds[b, c][None])
                torch.testing.assert_close(picture[b, c], one[0])
                extra, _, _ = lumigraph.rasterization(**{**own, "colors": signals[b]}, **camera, **asked)
                torch.testing.assert_close(info["render_extra_signals"][b, c], extra[0, ..., :4])
        if packed:
            assert set(info["batch_ids"].tolist()) == {0, 1} == set(info["camera_ids"].tolist())
    depth = lumigraph.rasterization(
        **{**clouds[0], "colors": None}, viewmats=viewmats, Ks=intrinsics, width=20, height=16, render_mode="ED"
    )[0]
    torch.testing.assert_close(depth[..., 0], picture[0, ..., -1])


def test_harmonics_of_degree_four_are_orthonormal_and_lists_of_tiles_hold_each_pair():
    from lumigraph.gaussians.rasterization import harmonics

    random = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=random), dim=-1)
    basis = harmonics(directions, 4)
    product = basis.T @ basis * 4 * torch.pi / len(directions)
    assert float((product - torch.eye(25)).abs().max()) < 0.03
    given, (viewmats, intrinsics) = cloud(), cameras()
    picture, _, info = lumigraph.rasterization(
        **given, viewmats=viewmats, Ks=intrinsics, width=20, height=16, tile_size=8
    )
    from lumigraph import gsplat

    for masked in (False, True):
        masks = torch.ones(2, 2, 3, dtype=torch.bool)
        masks[1, 0, 1] = not masked
        again, alpha = gsplat.rasterize_to_pixels(
            info["means2d"], info["conics"], given["colors"][info["gaussian_ids"]], info["opacities"], 20, 16, 8,
            info["isect_offsets"], info["flatten_ids"], masks=masks, packed=True)  # fmt: skip
        shown = masks.repeat_interleave(8, 1).repeat_interleave(8, 2)[:, :16, :20]
        torch.testing.assert_close(again, picture * shown[..., None])
    assert "isect_ids" in info and int(info["tiles_per_gauss"].sum()) == len(info["isect_ids"])


@pytest.mark.parametrize(
    "option",
    [
        {"render_mode": "RGD"},
        {"rasterize_mode": "sharp"},
        {"camera_model": "ftheta"},
        {"sh_degree": 5},
        {"with_eval3d": True},
        {"rays": torch.zeros(1)},
        {"distributed": True},
    ],
)
def test_what_there_is_not_is_refused_in_one_sentence(option):
    given, (viewmats, intrinsics) = cloud(), cameras(1)
    with pytest.raises(LumigraphError, match=next(iter(option))):
        lumigraph.rasterization(**given, viewmats=viewmats, Ks=intrinsics, width=20, height=16, **option)
