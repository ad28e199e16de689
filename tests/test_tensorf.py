"""TensoRF's equations: products of factors, their resampling, and a box that shrinks."""

from __future__ import annotations

from dataclasses import replace

import numba
import pytest
import tiny
import torch
from budgets import budget

from lumigraph import kernels
from lumigraph.datasets.scene import Forward, Frame
from lumigraph.kernels.factor_grid import Factors
from lumigraph.methods.tensorf import DENSITY_SCALE, UPSAMPLINGS, TensoRF
from lumigraph.methods.tensorf.factorised import FactorGrid, nodes_in

pytestmark = budget("methods")

WHOLE = (torch.zeros(3), torch.ones(3))


def grid(kind, nodes, components=3, seed=0):
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return FactorGrid(kind, nodes, components)


def at_nodes(nodes):
    return torch.cartesian_prod(*[torch.linspace(0, 1, n) for n in nodes])


def test_vm_at_nodes_is_the_sum_of_matrices_times_vectors():
    """Equation 3: M_yz v_x + M_xz v_y + M_xy v_z, written out over the whole tensor."""
    made = grid("vm", nodes := (4, 5, 3))
    yz, xz, xy, x, y, z = made.factors.split(made.table)
    tensor = torch.einsum("yzr,xr->xyz", yz, x) + torch.einsum("xzr,yr->xyz", xz, y)
    tensor += torch.einsum("xyr,zr->xyz", xy, z)
    found = made(at_nodes(nodes), summed=True).view(nodes)
    torch.testing.assert_close(found, tensor)


def test_cp_at_nodes_is_the_sum_of_outer_products():
    """Equation 2."""
    made = grid("cp", nodes := (4, 5, 3))
    tensor = torch.einsum("xr,yr,zr->xyz", *made.factors.split(made.table))
    torch.testing.assert_close(made(at_nodes(nodes), summed=True).view(nodes), tensor)


@pytest.mark.parametrize("kind", ["vm", "cp"])
def test_finer_nodes_between_the_old_ones_change_nothing(kind):
    """Linear interpolation of linear interpolation, where every old node stays a node."""
    made, fine = grid(kind, (4, 3, 5)), grid(kind, (7, 5, 9))
    fine.table = torch.nn.Parameter(made.resampled((7, 5, 9), WHOLE))
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(fine(points), made(points))


@pytest.mark.parametrize("kind", ["vm", "cp"])
def test_a_part_of_the_cube_keeps_its_values(kind):
    made, part = grid(kind, (5, 5, 9)), grid(kind, (3, 2, 5))
    low, high = torch.tensor([0.25, 0.5, 0.5]), torch.tensor([0.75, 0.75, 1.0])
    part.table = torch.nn.Parameter(made.resampled((3, 2, 5), (low, high)))
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(part(points), made(low + points * (high - low)))


@pytest.mark.parametrize("nodes", [(4, 5, 4), (4, 1, 8), (-4, 5, 3)])
def test_a_table_that_does_not_fit_its_nodes_is_refused(nodes):
    made = grid("vm", (4, 5, 3))
    with pytest.raises(RuntimeError, match="rows|nodes"):
        made.load_state_dict(made.state_dict() | {"nodes": torch.tensor(nodes)})


def test_variation_and_sparsity_are_means_over_each_factor():
    made = grid("cp", (3, 3, 3), components=1)
    with torch.no_grad():
        made.table.copy_(torch.tensor([[0.0], [1], [3], [2], [2], [2], [-1], [0], [1]]))
    assert float(made.variation().detach()) == pytest.approx((1 + 4) / 2 + 0 + 1)
    assert float(made.sparsity().detach()) == pytest.approx(4 / 3 + 2 + 2 / 3)


def test_nodes_are_as_far_apart_along_all_axes():
    x, y, z = nodes_in(torch.tensor([[-1.0, -0.5, -0.25], [1.0, 0.5, 0.25]]), 64)
    assert x == pytest.approx(2 * y, abs=1) and y == pytest.approx(2 * z, abs=1)
    assert x * y * z == pytest.approx(64**3, rel=0.05)


@pytest.mark.parametrize(("kind", "summed"), [("vm", True), ("vm", False), ("cp", False)])
def test_the_gradient_is_the_same_for_any_number_of_threads(kind, summed):
    factors = Factors(kind, (9, 8, 7))
    chance = torch.Generator().manual_seed(0)
    points, table = torch.rand(3000, 3, generator=chance), torch.randn(factors.rows, 16, generator=chance)
    found, before = [], numba.get_num_threads()
    try:
        for threads in {1, min(2, before)}:
            numba.set_num_threads(threads)
            asked = table.clone().requires_grad_()
            kernels.factor_grid(points, asked, factors, summed).square().sum().backward()
            found.append(asked.grad)
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(x, found[0]) for x in found)


def test_upsampling_is_even_in_the_logarithm_and_shrinks_the_box_once():
    """Section 5: from the first resolution to the last in as many equal ratios as there are upsamplings."""
    method = TensoRF(Frame(), TensoRF.smallest())
    method.sampler.grid.box.copy_(torch.tensor([[-0.5, -0.5, -0.5], [0.5, 0.25, 0.5]]))
    method.sampler.before_step = lambda *_: None
    sizes = []
    for number, share in enumerate(UPSAMPLINGS):
        method.before_step(number, share)
        sizes.append(float(method.network.density_grid.nodes.prod()) ** (1 / 3))
        if not number:
            shrunk = method.network.box.clone()
    assert method.network.box.equal(shrunk) and shrunk[1].tolist() == [0.5, 0.25, 0.5]
    first, last = method.config.initial_resolution, method.config.final_resolution
    assert sizes == pytest.approx([first * (last / first) ** (k / 5) for k in range(1, 6)], rel=0.1)


def test_a_mask_without_cells_leaves_the_box_alone():
    method = TensoRF(Frame(), TensoRF.smallest())
    method.sampler.grid.rule_out(torch.zeros(1, 4, 4, 4, dtype=torch.bool))
    method._shrink()
    assert method.network.box.tolist() == [[-1.0] * 3, [1.0] * 3]


def test_nothing_is_outside_the_box():
    method = TensoRF(Frame(), TensoRF.smallest())
    method.network.box = torch.tensor([[-0.5] * 3, [0.5] * 3])
    found = method.density(torch.tensor([[0.6, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert found[0] == 0 < found[1]


def density_in_cube(field, places):
    """Eq. 5 at places of the grid's cube, per unit of the coordinates."""
    config, total = field.config, field.density_grid(places, summed=True)[:, 0]
    return DENSITY_SCALE * torch.nn.functional.softplus(total + config.density_shift)


AHEAD = Forward(((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, -1.0)), (1.0, 1.0), 0.5)


@pytest.mark.parametrize("frame", [Frame(reach=8.0), Frame(reach=8.0, forward=AHEAD)], ids=["contracted", "ahead"])
def test_in_the_open_density_is_per_unit_of_the_scene(frame):
    """A length of the scene is `stretch` times as long in coordinates, on which the grid's density lies."""
    method = TensoRF(frame, TensoRF.smallest())
    points = torch.tensor([[0.1, 0.2, 0.3], [0.5, -0.4, 3.0], [-1.0, 1.0, 6.0]])
    places = method.network.space.warp(points) / 2 + 0.5
    expected = density_in_cube(method.network, places) * method.network.space.stretch(points)
    torch.testing.assert_close(method.density(points), expected)
    density, rgb = method.field(points, torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3))
    assert density.equal(method.density(points)) and rgb.shape == (3, 3) and method.network.step_length > 0
    before = method.network.box.clone()
    method._shrink()
    assert method.network.box.equal(before)


def test_before_the_plane_of_a_forward_capture_is_nothing():
    method = TensoRF(Frame(reach=8.0, forward=AHEAD), TensoRF.smallest())
    found = method.density(torch.tensor([[0.0, 0.0, -0.6], [0.0, 0.0, -0.4]]))
    assert found[0] == 0 < found[1]


@pytest.mark.parametrize(("factors", "shading"), [("cp", "mlp"), ("vm", "sh")])
def test_other_factors_and_shading_learn(factors, shading):
    """A few steps through all upsamplings lower the loss."""
    scene = tiny.scene()
    method = TensoRF(scene.frame, replace(TensoRF.smallest(), factors=factors, shading=shading)).train()
    optimizers, losses = method.optimizers(), []
    method.begin(scene)
    for step in range(24):
        method.before_step(step, step / 24)
        batch = method.batch(scene, torch.Generator().manual_seed(step))
        terms = method.loss(batch, step)
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)
        sum(terms.values()).backward()
        for optimizer in optimizers:
            optimizer.step()
        method.after_step(step)
        losses.append(method.figures["mse"])
    assert int(method.network.stage) == len(UPSAMPLINGS)
    assert sum(losses[-4:]) < 0.7 * sum(losses[:4])
