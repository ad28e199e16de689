"""ObjectNeRF: masks teach the branch, what is hidden teaches nothing, and instances go, come and stand alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from budgets import budget

from lumigraph.camera.rays import Rendering
from lumigraph.components.fields.spaces import space_of
from lumigraph.components.instances import Edit, check_labels, edit_of, labels_of, with_beside
from lumigraph.datasets.images import Layer, LayerSource
from lumigraph.datasets.scene import Frame
from lumigraph.errors import LumigraphError, LumigraphWarning
from lumigraph.files.ranges import changed
from lumigraph.methods.object_nerf import ObjectNeRF
from lumigraph.methods.object_nerf.fields import InstanceBoxes
from lumigraph.opening import open_scene
from lumigraph.run import Run, build
from lumigraph.training import fit

pytestmark = budget("methods", 12)


def new(frame=None, **numbers):
    config = changed(ObjectNeRF.smallest(), **numbers)
    return build(ObjectNeRF, frame or tiny.scene().frame, config, torch.device("cpu"), 0)


def rays():
    camera = tiny.scene().cameras[0]
    return camera.rays(camera.pixels())


@pytest.mark.parametrize("guided", [True, False])
def test_samples_behind_the_surface_teach_an_object_nothing_if_guided(guided):
    """A wall at distance 1 hides everything: a mask of 0 carves nothing behind it."""
    method, some = new(guided=guided), rays()
    count = len(some)
    wall = Rendering(torch.zeros(count, 3), torch.ones(count), torch.ones(count))
    labels = torch.full((count,), -1)
    asked, near = torch.zeros(count, dtype=torch.int64), torch.zeros(count, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    known = torch.ones(count, dtype=torch.bool)
    terms = method.object_terms(some, torch.zeros(count, 3), labels, known, asked, near, wall, generator)
    assert terms["object colour"] == 0
    assert (float(terms["object opacity"]) == 0) == guided


def test_a_visible_instance_passes_through_the_guard():
    """The depth may be wrong at first: pixels of the mask teach all along their rays."""
    method, some = new(), rays()
    count = len(some)
    near = Rendering(torch.zeros(count, 3), torch.full((count,), 0.2), torch.ones(count))
    labels, known = torch.zeros(count, dtype=torch.int64), torch.ones(count, dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)
    terms = method.object_terms(some, torch.ones(count, 3), labels, known, labels, known, near, generator)
    own = method.instance_look(some, labels, torch.Generator().manual_seed(0))
    assert len(own.samples) and terms["object colour"] > 0


def test_unknown_pixels_teach_no_object():
    method, some = new(), rays()
    count = len(some)
    seen = Rendering(torch.zeros(count, 3), torch.full((count,), 9.0), torch.ones(count))
    labels, known = torch.full((count,), -1), torch.zeros(count, dtype=torch.bool)
    asked, generator = torch.zeros(count, dtype=torch.int64), torch.Generator().manual_seed(0)
    terms = method.object_terms(some, torch.ones(count, 3), labels, known, asked, known, seen, generator)
    assert sum(map(float, terms.values())) == 0


def test_labels_come_from_their_layer_or_from_alpha():
    alpha = torch.tensor([1.0, 0.0, 1.0])
    labels, known = labels_of({}, alpha, 4)
    assert labels.tolist() == [0, -1, 0] and known.all()
    labels, known = labels_of({"labels": torch.tensor([2, -1, -1])}, alpha, 4)
    assert labels.tolist() == [2, -1, -1] and known.tolist() == [True, True, False]
    with pytest.raises(LumigraphError, match="give --instances 8"):
        labels_of({"labels": torch.tensor([7])}, None, 4)


def test_photographs_without_labels_are_refused():
    bare = replace(tiny.scene(), layers={})
    bare.images.has_alpha = False
    try:
        with pytest.raises(LumigraphError, match="folder `labels` beside them"):
            new().check_data(bare)
    finally:
        bare.images.has_alpha = True


def test_boxes_hold_the_surface_but_for_strays():
    boxes = InstanceBoxes(2, ((-1.0,) * 3, (1.0,) * 3), space_of(Frame()))
    inside = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) * 0.4 + torch.tensor([0.0, -0.5, 0.3])
    stray = torch.tensor([[-0.9, 0.9, -0.9]]).repeat(20, 1)
    boxes.add(torch.cat([inside, stray]), torch.ones(5020, dtype=torch.int64))
    low, high = boxes.box(1)
    assert boxes.learnt.tolist() == [False, True]
    assert (low - torch.tensor([0.0, -0.5, 0.3])).abs().max() < 0.12
    assert (high - torch.tensor([0.4, -0.1, 0.7])).abs().max() < 0.12


def test_boxes_of_an_open_scene_reach_beyond_the_box_of_interest():
    """A thing three units from the middle has a box, a place and a region; a run of before has one row for each."""
    method = new(Frame(reach=8.0))
    inside = torch.rand(5000, 3, generator=torch.Generator().manual_seed(0)) * 0.4 + torch.tensor([3.0, -0.2, -0.2])
    method.boxes.add(inside, torch.ones(5000, dtype=torch.int64))
    assert method.boxes.learnt.tolist() == [False, True, False, False]
    low, high = method.boxes.box(1)
    there = method.boxes.coordinates(inside)
    assert ((there > low) & (there < high)).float().mean() > 0.9 and (high - low).max() < 0.3
    middle, units = method.boxes.points(method.boxes.box(1).mean(0)[None])
    assert (middle - torch.tensor([[3.2, 0.0, 0.0]])).norm() < 0.3 and 5 < float(units) < 40
    method.branch.density = lambda points, codes: 9.0 * (points[:, 1] < 0)  # type: ignore[method-assign]
    assert method.belongs(torch.tensor([[3.2, -0.15, 0.0], [3.2, 0.15, 0.0], [0.0, 0.0, 0.0]]), 1).tolist() == [
        True,
        False,
        False,
    ]
    method.boxes.counts = torch.zeros(4, 3, 64)
    method.boxes.add(inside, torch.ones(5000, dtype=torch.int64))
    assert not method.boxes.learnt.any() and not method.boxes.contracted


def test_pixels_beside_a_mask_are_asked_about_it_and_few_others():
    """A disc in a corner: the layer names it around it, and nowhere else."""
    scene = tiny.scene()
    y, x = np.indices((tiny.SIZE, tiny.SIZE))
    disc = (np.hypot(x - 6, y - 6) < 4).astype(np.uint8)
    about = Layer(scene.images, [LayerSource(lambda: disc)] * len(scene.names), np.dtype(np.uint8), 1, "index")
    labelled = with_beside(replace(scene, layers={"labels": about}))
    assert len(labelled.splits["train"]) == len(scene.splits["train"]) == 9
    few = replace(about, planes=[plane if i in (1, 2) else None for i, plane in enumerate(about.planes)])
    often = with_beside(replace(scene, layers={"labels": few})).splits["train"].tolist()
    assert [often.count(i) for i in (1, 2, 3)] == [4, 4, 1]
    found = labelled.layer("beside").stored(0)
    away = np.hypot(x - 6, y - 6)
    assert found[(away > 4) & (away < 5)].mean() > 0.2 and not found[away > 10].any()
    generator = torch.Generator().manual_seed(0)
    labels, beside = (torch.from_numpy(a.flatten().astype(np.int64)).repeat(40) for a in (disc, found))
    asked, near = new().asked(labels, beside, generator)
    inside, ring = ((labels == 1) & (asked == 1)).sum(), ((labels == 0) & (asked == 1) & near).sum()
    assert 0.1 * inside < ring < inside and near[labels == asked].all()


def test_an_object_that_few_photographs_show_is_warned_of():
    scene = tiny.scene()
    planes = [LayerSource(lambda i=i: np.full((tiny.SIZE, tiny.SIZE), 7 * (i == 1), np.uint8)) for i in range(12)]
    about = Layer(scene.images, planes, np.dtype(np.uint8), 1, "index")
    with pytest.warns(LumigraphWarning, match="Of 9 photographs hardly any shows the objects of labels 7;"):
        check_labels(replace(scene, layers={"labels": about}))


def test_a_place_turns_about_the_middle():
    place = Edit(0, "move", (0.0, 0.0, 1.0), 180.0).place(torch.tensor([1.0, 0.0, 0.0]))
    assert torch.allclose(
        place.points(torch.tensor([[2.0, 0.0, 0.0]])).float(), torch.tensor([[0.0, 0.0, 1.0]]), atol=1e-6
    )


@pytest.fixture(scope="module")
def learnt():
    """A still life of small pictures with its labels."""
    scene = open_scene("procedural:still-life,size=24,views=12")
    config = changed(ObjectNeRF.cpu_preset(), instances=16, samples_per_step=4096)
    method = build(ObjectNeRF, scene.frame, config, torch.device("cpu"), 0)
    return method, scene


def test_an_instance_is_removed_moved_and_singled_out(learnt, tmp_path):
    method, scene = learnt
    run = Run.create(tmp_path / "run", method, scene)
    fit(method, scene, run, steps=80, show=False, rehearsal=False)
    names = scene.layer("labels").names
    number = names.index("turntable")
    camera = scene.cameras[0]
    whole = method.render(camera)
    mask = scene.photograph(0, ("labels",)).extra["labels"] == number
    alone, gone, aside = (
        method.given(**told).render(camera)
        for told in (
            {"edit": f"alone {number}"},
            {"edit": f"remove {number}"},
            {"edit": f"move {number}", "shift_z": 0.3},
        )
    )
    assert alone.opacity[mask].mean() > 0.5 > 0.35 > alone.opacity[~mask].mean()
    assert gone.opacity[mask].mean() < whole.opacity[mask].mean() - 0.3
    assert (aside.rgb - whole.rgb).abs().mean() > 0.01
    assert edit_of(method) is None and {x.name for x in method.controls} >= {"edit", "turn", "shift_x"}
    points = torch.zeros(5, 3)
    assert (method.given(edit=f"remove {number}").density(points) <= method.density(points)).all()


def test_the_paper_s_branches_give_density_and_colour():
    config = replace(ObjectNeRF.Config(), instances=4)
    method = ObjectNeRF(Frame(), config)
    points, directions = torch.zeros(3, 3), torch.nn.functional.normalize(torch.ones(3, 3), dim=-1)
    codes = torch.randn(3, config.code)
    density, rgb = method.branch(points, directions, codes)
    assert density.shape == (3,) and rgb.shape == (3, 3) and (density >= 0).all()
