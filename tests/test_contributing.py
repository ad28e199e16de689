"""The method in CONTRIBUTING.md does what is said of it: it is found by its name, and learns."""

from __future__ import annotations

import re
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import tiny
import torch

from lumigraph.run import build
from lumigraph.training import fit

GUIDE = Path(__file__).parent.parent / "CONTRIBUTING.md"


def test_the_method_in_forty_lines_learns(tmp_path, monkeypatch):
    (source,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    (tmp_path / "soft_colours.py").write_text(source)
    spec = spec_from_file_location("lumigraph.methods.soft_colours", tmp_path / "soft_colours.py")
    module = module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    scene = tiny.scene()
    method = build(module.SoftColours, scene.frame, module.SoftColours.smallest(), torch.device("cpu"), 0)
    batch = method.batch(scene, torch.Generator().manual_seed(0))
    before = float(sum(method.loss(batch, 0).values()))
    fit(method, scene, steps=150, show=False, rehearsal=False)
    assert float(sum(method.loss(batch, 0).values())) < before / 3
    assert method.render(scene.cameras[:1]).rgb.isfinite().all()
