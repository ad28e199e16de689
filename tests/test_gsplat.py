"""lumigraph.gsplat: stages against definitions, 2-D Gaussians by rays, strategies on dictionaries of tensors."""

from __future__ import annotations

import math

import pytest
import torch
from budgets import budget
from test_rasterization import SIZE, cameras, cloud

from lumigraph import gsplat
from lumigraph.errors import LumigraphError
from lumigraph.geometry import to_matrix
from lumigraph.gsplat import DensitySteps
from lumigraph.gsplat import strategy as ops
from lumigraph.gsplat.tensor_cloud import TensorCloud

pytestmark = budget("kernels", 4)


def test_stages_end_to_end_are_the_whole():
    """Projection, harmonics, tiles and pixels by themselves give the picture of rasterization, packed or not."""
    given, (viewmats, Ks) = cloud(), cameras()
    coefficients = 0.3 * torch.randn(12, 25, 3, generator=torch.Generator().manual_seed(1))
    size = SIZE[0], SIZE[1]
    whole, _, info = gsplat.rasterization(**{**given, "colors": coefficients}, viewmats=viewmats, Ks=Ks, width=size[0],
                                          height=size[1], sh_degree=4, tile_size=8)  # fmt: skip
    shapes = given["means"], None, given["quats"], given["scales"], viewmats, Ks, *size
    radii, means2d, depths, conics, none = gsplat.fully_fused_projection(*shapes, opacities=given["opacities"])
    assert none is None
    colors = (gsplat.spherical_harmonics(4, given["means"], viewmats, coefficients) + 0.5).clamp_min(0)
    tiles, pairs, rows = gsplat.isect_tiles(means2d, radii, depths, 8, 3, 2)
    offsets = gsplat.isect_offset_encode(pairs, 2, 3, 2)
    opacities = given["opacities"].expand(2, -1)
    picture, _ = gsplat.rasterize_to_pixels(means2d, conics, colors, opacities, *size, 8, offsets, rows)
    torch.testing.assert_close(picture, whole, atol=1e-4, rtol=0)
    assert int(tiles.sum()) == len(pairs) and (pairs.diff() >= 0).all()
    batch, camera, gaussian, first, *packed = gsplat.fully_fused_projection(*shapes, packed=True)
    assert first.tolist()[0] == 0 and first.tolist()[-1] == len(gaussian) and not batch.any()
    full = gsplat.fully_fused_projection(*shapes)
    for one, all_of in zip(packed[:4], full[:4], strict=True):
        torch.testing.assert_close(one, all_of[camera.long(), gaussian.long()])
    covars, precis = gsplat.quat_scale_to_covar_preci(given["quats"], given["scales"])
    torch.testing.assert_close(covars @ precis, torch.eye(3).expand(12, 3, 3), atol=1e-3, rtol=0)
    triangle, _ = gsplat.quat_scale_to_covar_preci(given["quats"], given["scales"], triu=True)
    again = gsplat.fully_fused_projection(given["means"], triangle, None, None, viewmats, Ks, *size)
    torch.testing.assert_close(again[3], full[3], rtol=1e-3, atol=1e-4)


def discs_by_rays(given, viewmat, K):
    """2-D Gaussians by the intersection of each pixel's ray with each disc's plane, in float64."""
    rotation = viewmat[:3, :3] @ to_matrix(given["quats"])
    centre = given["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    row, column = torch.meshgrid(torch.arange(SIZE[1]) + 0.5, torch.arange(SIZE[0]) + 0.5, indexing="ij")
    rays = torch.stack([column, row, torch.ones_like(row)], -1).to(centre) @ K.inverse().T
    normal = rotation[..., 2] * -torch.sign((rotation[..., 2] * centre).sum(-1, keepdim=True))
    t = (normal * centre).sum(-1) / (rays[:, :, None] * normal).sum(-1)
    local = torch.einsum("nij,hwni->hwnj", rotation[..., :2], t[..., None] * rays[:, :, None] - centre)
    apart = (local / given["scales"][:, :2]).square().sum(-1)
    u = centre @ K.T
    transforms = K @ torch.cat([rotation[..., :2] * given["scales"][:, None, :2], centre[..., None]], -1)
    low = transforms[:, 2] * torch.tensor([1.0, 1.0, -1.0]).to(u)
    middle = (transforms[:, :2] * low[:, None]).sum(-1) / (transforms[:, 2] * low).sum(-1, keepdim=True)
    screen = 2 * (torch.stack([column, row], -1)[:, :, None].to(u) - middle).square().sum(-1)
    raw = given["opacities"] * torch.exp(-0.5 * torch.minimum(apart, screen))
    alpha = torch.where(raw < 1 / 255, 0.0, raw)
    order = centre[:, 2].argsort()
    alpha = alpha[..., order]
    light = torch.nn.functional.pad(1 - alpha, (1, 0), value=1.0).cumprod(-1)[..., :-1]
    weights, z = alpha * light, centre[order, 2]
    colours = torch.cat([given["colors"], centre[:, 2:]], -1)[order]
    pairs = weights[..., :, None] * weights[..., None, :] * (z[:, None] - z).abs()
    median = torch.where(light > 0.5, torch.arange(len(z)), -1)
    median = torch.where(alpha > 0, median, -1).amax(-1)
    z_median = torch.where(median >= 0, z[median.clamp_min(0)], 0.0)
    normals = weights @ normal[order] @ viewmat[:3, :3]
    return weights @ colours, weights.sum(-1), normals, pairs.sum((-1, -2)), z_median


@pytest.mark.parametrize("packed", [False, True])
def test_discs_are_where_rays_cross_them(packed):
    given, (viewmats, Ks) = cloud(), cameras(1)
    given["scales"] = given["scales"] * 1.5
    exact = {name: value.double().requires_grad_() for name, value in given.items()}
    ours = {name: value.clone().requires_grad_() for name, value in given.items()}
    outputs = gsplat.rasterization_2dgs(
        **ours, viewmats=viewmats, Ks=Ks, width=SIZE[0], height=SIZE[1], render_mode="RGB+D", packed=packed,
        distloss=True)  # fmt: skip
    picture, alpha, normals, surfaces, distortion, median, info = outputs
    wanted = discs_by_rays(exact, viewmats[0].double(), Ks[0].double())
    found = picture[0], alpha[0, ..., 0], normals[0], distortion[0, ..., 0], median[0, ..., 0]
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one.double(), other, atol=1e-4 * float(other.abs().max()), rtol=1e-4)
    weight = torch.rand(SIZE[1], SIZE[0], generator=torch.Generator().manual_seed(0)) - 0.3
    sum((x.flatten(2).sum(-1) if x.ndim > 2 else x).mul(weight).sum() for x in found[:4]).backward()
    sum((x.flatten(2).sum(-1) if x.ndim > 2 else x).mul(weight).sum() for x in wanted[:4]).backward()
    for name in ("means", "quats", "opacities", "colors"):
        largest = float(exact[name].grad.abs().max())
        torch.testing.assert_close(ours[name].grad.double(), exact[name].grad, atol=1e-3 * largest, rtol=1e-3)
    assert info["gradient_2dgs"].grad.abs().sum() > 0 and surfaces.shape == normals.shape
    assert torch.isclose(surfaces[0, 5:-5, 5:-5].norm(dim=-1), torch.ones(1)).float().mean() > 0.9


def trained(count: int = 40) -> tuple[dict, dict]:
    """Parameters with the moments of one step, in which Adam's mean of a row is its number."""
    random = torch.Generator().manual_seed(0)
    shapes = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "extra": (count, 2),
    }
    params = {name: torch.nn.Parameter(torch.randn(shape, generator=random)) for name, shape in shapes.items()}
    params["scales"].data.sub_(3)
    optimizers = {name: torch.optim.Adam([value], lr=0.0) for name, value in params.items()}
    for name, value in params.items():
        value.grad = torch.arange(float(count)).view(-1, *[1] * (value.ndim - 1)).expand_as(value) + 1
        optimizers[name].step()
    return params, optimizers


def test_rows_moments_and_state_follow_every_operation():
    params, optimizers = trained()
    before = {name: value.detach().clone() for name, value in params.items()}
    state = {"count": torch.arange(40.0), "scale": 2.0}
    mask = torch.zeros(40, dtype=torch.bool)
    mask[[3, 7]] = True
    ops.duplicate(params, optimizers, state, mask)
    assert len(params["means"]) == 42 and state["count"][-2:].tolist() == [3.0, 7.0]
    assert torch.equal(params["extra"][40:], before["extra"][mask])
    moment = optimizers["extra"].state[params["extra"]]["exp_avg"]
    assert torch.allclose(moment[:40, 0], 0.1 * (torch.arange(40.0) + 1)) and not moment[40:].any()
    ops.remove(params, optimizers, state, torch.arange(42) >= 40)
    ops.split(params, optimizers, state, mask)
    assert len(params["means"]) == 42 and torch.equal(params["means"][:38], before["means"][~mask])
    halves = params["scales"][38:]
    torch.testing.assert_close(halves, (before["scales"][mask] - math.log(1.6)).repeat(2, 1))
    ops.reset_opa(params, optimizers, state, 0.01)
    assert float(params["opacities"].sigmoid().max()) <= 0.0100001
    assert not optimizers["opacities"].state[params["opacities"]]["exp_avg"].any()
    for name, value in params.items():  # and they learn on
        assert optimizers[name].param_groups[0]["params"][0] is value
        value.grad = torch.ones_like(value)
        optimizers[name].step()
    del optimizers["extra"]
    with pytest.raises(LumigraphError, match="extra needs gradients"):
        TensorCloud(params, optimizers).rebuild(torch.arange(3), torch.zeros(3, dtype=torch.bool))


def test_relocated_copies_render_like_one():
    """Along a ray through the centre n copies hide as much as one did."""
    opacities, copies = torch.tensor([0.3, 0.9, 0.99]), torch.tensor([2, 3, 5])
    found, scales = ops.compute_relocation(opacities, torch.ones(3, 3), copies)
    torch.testing.assert_close(1 - (1 - found) ** copies, opacities, atol=1e-5, rtol=0)
    r = torch.linspace(-8, 8, 4001, dtype=torch.float64)
    for one, other, scale, n in zip(opacities, found, scales[:, 0].double(), copies, strict=True):
        once = (one.double() * torch.exp(-0.5 * r**2)).sum()
        together = (1 - (1 - other.double() * torch.exp(-0.5 * (r / scale) ** 2)) ** n).sum()
        assert abs(float(together / once) - 1) < 1e-3


@pytest.mark.parametrize("absgrad", [False, True])
def test_strategies_change_the_gaussians_of_a_training(absgrad):
    params, optimizers = trained()
    viewmats, Ks = cameras()
    default = gsplat.DefaultStrategy(absgrad=absgrad, grow_grad2d=1e-7, refine_start_iter=0, refine_every=2)
    state = default.initialize_state(scene_scale=1.0)
    default_sane = {name: params[name] for name in params}
    default.check_sanity(default_sane, optimizers)
    for step in range(3):
        shapes = params["means"] * 0.2, params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
        colours = torch.cat([params["extra"], params["extra"][:, :1]], -1).sigmoid()
        picture, _, info = gsplat.rasterization(*shapes, colours, viewmats, Ks, *SIZE, packed=absgrad, absgrad=absgrad)
        default.step_pre_backward(params, optimizers, state, step, info)
        picture.square().sum().backward()
        rows = info["gaussian_ids"] if absgrad else (info["radii"] > 0).all(-1).nonzero()[:, 1]
        seen = torch.bincount(rows, minlength=len(params["means"]))
        default.step_post_backward(params, optimizers, state, step, info, packed=absgrad)
        if step == 0:
            assert torch.equal(state["count"], seen.float())
            own = info["means2d"].absgrad if absgrad else info["means2d"].grad
            assert float(state["grad2d"].sum()) > 0 and own.shape == info["means2d"].shape
    assert len(params["means"]) > 50
    chain = gsplat.MCMCStrategy(cap_max=200, refine_start_iter=0, refine_every=1)
    count = len(params["means"])
    chain.step_post_backward(params, optimizers, chain.initialize_state(), 1, {}, lr=1e-4)
    assert len(params["means"]) == int(1.05 * count) and params["means"].isfinite().all()


def test_our_density_control_divides_in_a_loop_of_ones_own():
    for kind in ("adaptive", "error"):
        params, optimizers = trained()
        viewmats, Ks = cameras(1)
        steps = DensitySteps(20, cap=60, kind=kind)
        state = steps.initialize_state(40)
        changes = 0
        for step in range(14):
            explained = torch.zeros(len(params["means"]), requires_grad=True)
            shapes = params["means"] * 0.2, params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
            picture, _, info = gsplat.rasterization(
                *shapes, params["extra"].sigmoid(), viewmats, Ks, *SIZE, extra_signals=explained[:, None]
            )
            info["means2d"].retain_grad()
            error = (picture - 0.5).abs().mean(-1).detach()
            loss = 50 * (picture - 0.5).square().sum() + (info["render_extra_signals"][..., 0] * error).sum()
            loss.backward()
            info["explained"] = explained
            changes += steps.step(params, optimizers, state, step, info)
        assert changes and 40 < len(params["means"]) <= 60, kind
    with pytest.raises(LumigraphError, match="means2d has no gradient"):
        picture, _, info = gsplat.rasterization(*shapes, params["extra"], viewmats, Ks, *SIZE)
        DensitySteps(20, cap=60).step(params, optimizers, DensitySteps(20, 60).initialize_state(40), 0, info)
    with pytest.raises(LumigraphError, match="kind='more'"):
        DensitySteps(20, 60, kind="more").initialize_state(40)
