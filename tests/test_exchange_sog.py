"""SOG: what comes back, what a file put together by hand says, the first version, folders, and every fault."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_exchange import C0, apart, components_apart, make, opacity_apart, refusal, round_trip, same
from test_gaussians import camera
from test_gaussians import cloud as soft_cloud

from lumigraph.commands import cli
from lumigraph.errors import LumigraphError
from lumigraph.exchange import is_splat_file, read_gaussians, write_gaussians
from lumigraph.exchange.checks import zipped
from lumigraph.exchange.codes import levels, nearest_level
from lumigraph.exchange.sog import encode
from lumigraph.gaussians.splatting import render
from lumigraph.large import open_any
from lumigraph.metrics import psnr

MEANS = ("means_l.webp", "means_u.webp")


@pytest.mark.parametrize("count", [1, 257, 1500])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_it_keeps_what_it_promises(tmp_path, degree, count):
    cloud = make(count, degree, antialiased=degree == 1)
    found = round_trip(cloud, tmp_path / "a.sog")
    assert (len(found), found.degree, found.antialiased) == (count, degree, cloud.antialiased)
    folded = cloud.means.sign() * cloud.means.abs().log1p()
    step = (folded.amax(0) - folded.amin(0)) / 131070
    assert ((found.means - cloud.means).abs() <= 1.01 * step * (1 + cloud.means.abs()) + 1e-6).all()
    assert components_apart(found, cloud) <= 3 * 0.0028  # the largest is worked out from the others
    assert opacity_apart(found, cloud) <= 1 / 510 + 1e-6
    assert apart(found.log_scales, cloud.log_scales) <= 6 / 150  # they lie between 6 apart
    assert C0 * apart(found.harmonics[:, 0], cloud.harmonics[:, 0]) <= 1 / 150
    if degree:
        off = (found.harmonics[:, 1:] - cloud.harmonics[:, 1:]).square().mean().sqrt()
        assert off < (0.004 if count <= 1024 else 0.7 * 1.8 / math.sqrt(12))  # noise is what a palette holds worst


def test_it_looks_the_same(tmp_path):
    cloud = soft_cloud(200, degree=2)
    write_gaussians(tmp_path / "a.sog", cloud)
    eye = camera()
    before, after = (render(x, eye, (0.0, 0.0, 0.0)).rgb for x in (cloud, read_gaussians(tmp_path / "a.sog")))
    assert before.max() > 0.3 and psnr(before, after) > 50


def test_levels_are_better_than_even_ones():
    values = np.random.default_rng(0).normal(size=5000) ** 3
    book = levels(values)
    assert len(book) == 256 and (np.diff(book) > 0).all()
    off = np.abs(values - book[nearest_level(values, book)])
    assert off.mean() == pytest.approx(np.abs(values[:, None] - book).min(1).mean())
    even = np.linspace(values.min(), values.max(), 256)
    assert np.square(off).mean() < 0.1 * np.square(values[:, None] - even).min(1).mean()
    few = np.array([3.0, -1, 3])
    assert np.array_equal(levels(few)[nearest_level(few, levels(few))], few)


def picture(*pixels: tuple[int, ...], width: int = 2) -> bytes:
    held = io.BytesIO()
    rgba = np.array(pixels, np.uint8).reshape(-1, width, 4)
    Image.fromarray(rgba).save(held, "WEBP", lossless=True, exact=True)
    return held.getvalue()


def by_hand(old: bool = False) -> dict[str, bytes]:
    """Two Gaussians, degree 1: the first at the lower ends, the second at the upper ones."""
    means = {"mins": [-1.0, 0.0, 0.0], "maxs": [1.0, 2.0, math.log(3)], "files": MEANS}
    book = [0.1 * (i - 128) for i in range(256)]
    meta = {"version": 2, "count": 2, "means": means, "quats": {"files": ["q.webp"]}, "model": "antialiased"}
    meta |= {"scales": {"codebook": book, "files": ["s.webp"]}, "sh0": {"codebook": book, "files": ["c.webp"]}}
    meta |= {"shN": {"count": 64, "bands": 1, "codebook": book, "files": ["p.webp", "l.webp"]}}
    if old:
        ends = {"mins": [-9.0, -8.0, -7.0], "maxs": [-3.0, -2.0, -1.0]}
        colours = {"mins": [-1.0, -1.0, -1.0, -4.0], "maxs": [1.0, 1.0, 1.0, 6.0]}
        meta = {"means": means | {"shape": [2, 3]}, "quats": meta["quats"]}
        meta |= {"scales": ends | {"files": ["s.webp"]}, "sh0": colours | {"files": ["c.webp"]}}
        meta |= {"shN": {"mins": -0.5, "maxs": 0.5, "files": ["p.webp", "l.webp"]}}
    entries = [(i, 2 * i, 128, 255) for i in range(64) for _ in range(3)]
    return {
        "meta.json": json.dumps(meta).encode(),
        "means_l.webp": picture((0, 0, 0, 255), (255, 255, 255, 255)),
        "means_u.webp": picture((0, 0, 0, 255), (255, 255, 255, 255)),
        "s.webp": picture((0, 1, 2, 255), (255, 254, 253, 255)),
        "q.webp": picture((255, 0, 128, 252), (0, 128, 255, 254)),
        "c.webp": picture((0, 128, 255, 0), (255, 0, 128, 51)),
        "p.webp": picture(*entries, width=192),
        "l.webp": picture((3, 0, 0, 255), (63, 0, 0, 255)),
    }


@pytest.mark.parametrize("old", [False, True])
def test_it_reads_what_was_put_together_by_hand(tmp_path, old):
    (tmp_path / "a.sog").write_bytes(zipped(by_hand(old)))
    found = read_gaussians(tmp_path / "a.sog")
    assert len(found) == 2 and found.degree == 1 and found.antialiased is not old
    torch.testing.assert_close(found.means, torch.tensor([[1 - math.e, 0, 0], [math.e - 1, math.exp(2) - 1, 2]]))
    h, z = math.sqrt(0.5), (128 / 255 - 0.5) * math.sqrt(2)  # of w, x, y, z the first, then the third is the largest
    expected = torch.tensor([[0.0, h, -h, z], [-h, z, 0, h]])
    torch.testing.assert_close(found.quaternions, expected, atol=1e-5, rtol=0)
    if old:
        torch.testing.assert_close(found.log_scales[0], torch.tensor([-9, -8 + 6 / 255, -7 + 12 / 255]))
        torch.testing.assert_close(found.opacities, torch.tensor([-4.0, -2]))
        torch.testing.assert_close(found.harmonics[0, 0], torch.tensor([-1, 1 / 255, 1]))
        torch.testing.assert_close(found.harmonics[0, 2], torch.tensor([3, 6, 128]) / 255 - 0.5)
    else:
        torch.testing.assert_close(found.log_scales[0], torch.tensor([-12.8, -12.7, -12.6]))
        torch.testing.assert_close(found.opacities.sigmoid(), torch.tensor([0.5 / 255, 0.2]))
        torch.testing.assert_close(found.harmonics[0, 0], torch.tensor([-12.8, 0, 12.7]))
        torch.testing.assert_close(found.harmonics[1, 3], torch.tensor([-6.5, -0.2, 0]), atol=1e-5, rtol=0)


def test_a_folder_says_the_same(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cloud = make(40, 1)
    write_gaussians("a.sog", cloud)
    assert cli.main(["export", "splats", "a.sog", "new/meta.json"]) == 0
    assert (Path("new") / "shN_labels.webp").is_file() and is_splat_file("new") and is_splat_file("new/meta.json")
    bundled = read_gaussians("a.sog")
    for name in ("new", "new/meta.json"):
        assert same(read_gaussians(name), bundled) and len(open_any(name).gaussians) == 40
        assert open_any(name).title == "new"
    assert cli.main(["info", "new"]) == 0 and "40 Gaussians" in capsys.readouterr().out
    assert cli.main(["export", "splats", "new", "new/meta.json"]) == 2  # what it reads stays
    assert cli.main(["export", "splats", "a.sog", "new/meta.json"]) == 0  # what Lumigraph wrote may go
    (Path("new") / "holiday.jpg").write_bytes(b"the only copy")
    assert cli.main(["export", "splats", "a.sog", "new/meta.json", "--overwrite"]) == 2
    assert (Path("new") / "holiday.jpg").exists() and "holiday.jpg" in capsys.readouterr().err


def bent(path: Path, **changes: object) -> Path:
    """A file whose meta.json says other values; shN_count is that of the palette."""
    files = by_hand()
    meta = json.loads(files["meta.json"])
    for name, value in changes.items():
        *above, last = name.split("_")
        place = meta
        for part in above:
            place = place[part]
        place[last] = value
    path.write_bytes(zipped(files | {"meta.json": json.dumps(meta).encode()}))
    return path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"count": 3}, "has 2 pixels where 3 are needed"),
        ({"count": 10**8}, "promises 100,000,000 Gaussians"),
        ({"count": 0}, "holds no Gaussians"),
        ({"version": 3}, "version 3"),
        ({"shN_count": 63}, "entries that 'l.webp' names"),
        ({"shN_bands": 2}, "entries that 'l.webp' names"),
        ({"scales_files": ["elsewhere.webp"]}, "lacks the file 'elsewhere.webp'"),
        ({"quats_files": ["../a.webp"]}, "lacks the file '../a.webp'"),
        ({"quats_files": ["c.webp"]}, "no rotations"),
    ],
    ids=str,
)
def test_what_meta_says_is_held_against_what_is_there(tmp_path, change, said):
    assert said in refusal(bent(tmp_path / "a.sog", **change))


@pytest.mark.parametrize(
    "change",
    [{"count": -1}, {"count": 10**30}, {"scales_codebook": [0.0] * 255}, {"means_mins": [0, 0]}, {"means_files": ["a"]}]
    + [{"means": 3}, {"quats": None}, {"means_maxs": ["a", 0, 0]}],
    ids=lambda change: next(iter(change)),
)
def test_what_meta_says_is_of_the_right_kind(tmp_path, change):
    with pytest.raises(LumigraphError, match=r"meta\.json .* does not hold what it should") as caught:
        read_gaussians(bent(tmp_path / "a.sog", **change))
    assert next(iter(change)).replace("_", ".") in str(caught.value)


@pytest.mark.parametrize("name", [name for name in by_hand()])
def test_a_picture_that_is_missing_or_cut(tmp_path, name):
    files = by_hand()
    (tmp_path / "a.sog").write_bytes(zipped({key: data for key, data in files.items() if key != name}))
    assert f"lacks the file {name!r}" in refusal(tmp_path / "a.sog")
    folder = tmp_path / "scene"
    folder.mkdir()
    for key, data in files.items():
        (folder / key).write_bytes(data)
    assert same(read_gaussians(folder), read_gaussians_of(tmp_path, files))
    if name != "meta.json":
        (folder / name).write_bytes(files[name][:-3])
        assert f"{name!r} cannot be read as a picture" in refusal(folder)
        (folder / name).unlink()
        assert f"lacks the file {name!r}" in refusal(folder)


def read_gaussians_of(tmp_path: Path, files: dict[str, bytes]):
    (tmp_path / "whole.sog").write_bytes(zipped(files))
    return read_gaussians(tmp_path / "whole.sog")


def test_bombs_are_refused(tmp_path):
    """A picture of 16383 x 16383 equal pixels in a few kilobytes; an entry that unpacks to gigabytes."""
    held = io.BytesIO()
    Image.new("RGBA", (5000, 5000)).save(held, "WEBP", lossless=True)
    (tmp_path / "a.sog").write_bytes(zipped(by_hand() | {"s.webp": held.getvalue()}))
    assert "no cloud can be packed into" in refusal(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "b.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in by_hand().items():
            archive.writestr(name, data if name != "s.webp" else bytes(1 << 27))
    assert "would unpack to" in refusal(tmp_path / "b.sog")


def test_a_cloud_of_none_is_not_written(tmp_path):
    for name in ("a.sog", "a.glb", "new/meta.json"):
        with pytest.raises(LumigraphError, match=r"no Gaussians; write it as \.ply"):
            write_gaussians(tmp_path / name, make(0))
    assert not list(tmp_path.iterdir())


def test_pictures_have_the_sizes_that_other_programs_make():
    files = encode(make(1500, 1))
    for name, size in {
        "means_l": (40, 40),
        "sh0": (40, 40),
        "shN_labels": (40, 40),
        "shN_centroids": (192, 16),
    }.items():
        with Image.open(io.BytesIO(files[f"{name}.webp"])) as image:
            assert image.size == size and image.format == "WEBP"
