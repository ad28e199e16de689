"""What grids without a bound share: smoothness, thin beginnings."""

import tiny
import torch

from lumigraph.camera.rays import Rays
from lumigraph.components.fields.voxels import VoxelGrid, corners
from lumigraph.components.training.smoothness import variation
from lumigraph.datasets.scene import Forward, Frame
from lumigraph.methods.dvgo import DVGO
from lumigraph.volume import weights_of

CUBE = [[-1.0] * 3, [1.0] * 3]
AHEAD = Forward(((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)), (1.0, 1.0), 1.0)
FORWARD = Frame(reach=8.0, near=0.05, forward=AHEAD)


def straight_ahead(count: int = 3) -> Rays:
    across = torch.linspace(-0.2, 0.2, count)
    directions = torch.stack([across, across / 2, torch.ones(count)], -1)
    return Rays(torch.zeros(count, 3), torch.nn.functional.normalize(directions, dim=-1), torch.full((count,), 1e-3))


def test_only_what_samples_touch_is_smoothed(generator):
    grid = VoxelGrid(CUBE, 8**3, 2, (1.0, 1.0, 0.5))
    x, y, z = grid.shape
    assert x == y == 2 * (z - 1) + 1
    grid.values.data = torch.randn(grid.values.shape, generator=generator)
    sample = torch.tensor([[0.01, -0.99, 0.3]])
    variation(grid, sample, 5, generator).backward()
    touched = (grid.values.grad != 0).any(-1)
    away = (corners(grid.box, grid.shape) - sample).abs() >= 2 / (grid.size - 1)
    assert 0 < int(touched.sum()) <= 4 and not (touched & away.any(-1)).any()


def test_a_plane_varies_as_it_rises(generator):
    grid = VoxelGrid(CUBE, 8**3, 1)
    grid.values.data = 3 * corners(grid.box, grid.shape)[:, :1]
    inside = torch.rand(50, 3, generator=generator) - 0.5
    rise = 3 * 2 / (grid.shape[0] - 1)
    torch.testing.assert_close(variation(grid, inside, 200, generator), torch.tensor(rise), atol=1e-4, rtol=1e-4)


def test_what_no_photograph_has_shown_yet_is_no_fog():
    """Long rays through a new grid pass nearly all light, whatever the stage."""
    for frame in (FORWARD, Frame(reach=8.0, near=0.05)):
        for stage in (0, 1):
            method = DVGO(frame, DVGO.smallest())
            method.network.stage.fill_(stage)
            (look,) = method.looks(straight_ahead())
            assert float(weights_of(look.samples, look.density).sum()) < 0.1


def test_smoothness_is_learnt_in_the_open_alone():
    scene = tiny.scene()
    method = DVGO(scene.frame, DVGO.smallest())
    terms = method.loss(scene.sample_rays(32, torch.Generator().manual_seed(0)), 0)
    assert ("tv_density" in terms) == (scene.frame.reach > 1)
