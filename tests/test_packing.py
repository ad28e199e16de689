"""Tensors in few bytes: forms lose what they may, codebooks serve what weighs most, files keep their word."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lumigraph.errors import LumigraphError
from lumigraph.exchange import packing
from lumigraph.exchange.packing import Recipe, Stored, Table
from lumigraph.exchange.packing.file import HEAD, MAGIC
from lumigraph.exchange.packing.forms import Coded, Half, Scaled, clustered, most_important, nearest
from lumigraph.exchange.packing.streams import Stream, packed, unpacked

HERE = Path("weights.packed")


@pytest.mark.parametrize("kind", ["bool", "uint8", "uint16", "int32", "int64", "float16", "float32", "float64"])
@pytest.mark.parametrize("shape", [(), (0,), (7,), (5, 3), (0, 4), (2, 3, 4)])
def test_streams_come_back_to_the_bit(kind, shape):
    array = np.asarray(np.random.default_rng(0).normal(size=shape) * 50).astype(kind)
    stream, data = packed(array)
    back = unpacked(stream, data)
    assert back.dtype == array.dtype and back.shape == shape and np.array_equal(back, array)


def test_what_rises_evenly_is_stored_as_differences():
    array = np.arange(3000, dtype=np.uint16).reshape(1000, 3) * 7
    stream, data = packed(array)
    assert stream.delta and len(data) < 200 and np.array_equal(unpacked(stream, data), array)


@pytest.mark.parametrize("bits", [2, 5, 8, 12, 16])
def test_whole_numbers_are_within_half_a_step(bits, generator):
    values = torch.randn(500, 4, generator=generator) * torch.tensor([1.0, 10.0, 0.1, 0.0])
    form = Scaled(values, bits)
    assert ((form.values() - values).abs() <= 0.501 * form.step + 1e-5).all()
    assert (form.step[:3] <= 8.01 * values[:, :3].std(0, correction=0) / (2**bits - 1) + 1e-3).all()
    assert torch.equal(Scaled.read(form.streams()).values(), form.values())


def test_halves_are_halves(generator):
    values = torch.randn(9, 5, generator=generator)
    assert torch.equal(Half.read(Half(values).streams()).values(), values.half().float())


def test_the_gradient_goes_straight_through_the_rounding(generator):
    values, target = torch.randn(40, 3, generator=generator), torch.randn(40, 3, generator=generator)
    form = Scaled(values, 3)
    (latent, unit), *_ = form.learning()
    latent.requires_grad_()
    (form.values() - target).square().sum().backward()
    assert torch.allclose(latent.grad, 2 * (form.values() - target).detach()) and unit == float(form.step.mean())


def test_a_code_learns_from_all_of_its_rows(generator):
    values = torch.randn(60, 2, generator=generator)
    form = Coded(values, torch.ones(60), 6, 0.1, 8, generator)
    book = form.learning()[0][0].requires_grad_()
    form.values().sum().backward()
    counts = torch.bincount(form.codes, minlength=6).float()
    assert int(form.apart.sum()) == 6 and torch.equal(book.grad, counts[:, None].expand(6, 2))


def test_a_codebook_serves_what_weighs_most(generator):
    """Two clouds and room for few codes: most of them go to the heavy one, and its error is the smaller one."""
    rows = torch.cat([torch.randn(300, 2, generator=generator), torch.randn(300, 2, generator=generator) + 20])
    weights = torch.cat([torch.full((300,), 1e-3), torch.ones(300)])
    book, codes = clustered(rows, weights, 16, generator)
    error = (rows - book[codes]).square().sum(-1)
    assert (book[:, 0] > 10).sum() > 10 and error[300:].mean() < error[:300].mean() / 3
    assert torch.equal(codes, torch.cdist(rows, book).argmin(-1))
    counts = torch.bincount(codes, minlength=16)
    assert (counts.diff() <= 0).all()  # the frequent ones first
    even, codes = clustered(rows, torch.ones(600), 16, generator)
    assert nearest(rows, even)[1].mean() < error.mean()


def test_as_many_codes_as_rows_lose_nothing(generator):
    rows = torch.randn(30, 3, generator=generator)
    book, codes = clustered(rows, torch.rand(30, generator=generator), 30, generator)
    assert torch.allclose(book[codes], rows, atol=1e-6)


def test_the_most_important_add_up():
    weights = torch.tensor([1.0, 5.0, 0.0, 3.0, 1.0])
    assert most_important(weights, 0.5).tolist() == [False, True, False, False, False]
    assert most_important(weights, 0.8).tolist() == [False, True, False, True, False]
    assert most_important(weights, 1.0).tolist() == [True, True, False, True, True]
    assert not most_important(weights, 0.0).any() and not most_important(weights[2:3], 1.0).any()


def sparse(*shape: int, generator: torch.Generator) -> torch.Tensor:
    """Numbers in a fifth of the cells of (grid, channel, x, y, z)."""
    there = torch.rand(shape[0], 1, *shape[2:], generator=generator) < 0.2
    return torch.randn(shape, generator=generator) * there


def some(generator: torch.Generator) -> dict[str, tuple[torch.Tensor, Stored]]:
    cells = sparse(1, 5, 8, 9, 10, generator=generator)
    return {
        "cloud": (torch.randn(400, 4, 3, generator=generator), Stored("coded", plain=3)),
        "grid": (cells, Stored("coded", layout="channels")),
        "density": (torch.where(cells[:, :1] == 0, -4.0, cells[:, :1]), Stored("scaled", layout="channels", fill=-4.0)),
        "plane": (cells[0].permute(1, 2, 3, 0).contiguous(), Stored("scaled", 12, layout="cells")),
        "weights": (torch.randn(16, 8, generator=generator), Stored("half")),
        "memory": (torch.randn(50, generator=generator), Stored("nothing", fill=1.0)),
        "marks": (torch.ones(2, 3, dtype=torch.bool), Stored("nothing")),
    }


def made(generator: torch.Generator) -> dict[str, torch.Tensor | Table]:
    recipe = Recipe(codebook=32, apart=0.3)
    tables = {name: packing.packed(x, how, recipe, None, generator) for name, (x, how) in some(generator).items()}
    return {**tables, "step": torch.tensor(7), "occupied": torch.rand(2, 9, generator=generator) < 0.5}


def test_a_file_holds_what_it_was_given(generator):
    given, before = some(torch.Generator().manual_seed(0)), made(torch.Generator().manual_seed(0))
    data = packing.write(before)
    after = packing.read(data, HERE)
    assert list(after) == list(before)
    for name, value in before.items():
        expected = value.tensor() if isinstance(value, Table) else value
        assert after[name].dtype == expected.dtype and torch.equal(after[name], expected), name
    for name, (tensor, how) in given.items():
        assert after[name].shape == tensor.shape and after[name].dtype == tensor.dtype
        if how.how not in ("nothing", "coded"):
            assert (after[name] - tensor).abs().max() < 0.05, name
    assert torch.equal(after["grid"] == 0, given["grid"][0] == 0)  # where there is nothing, nothing is stored
    assert (after["density"] == -4).float().mean() > 0.7 and (after["memory"] == 1).all() and not after["marks"].any()
    assert len(data) < sum(x.numel() * x.element_size() for x in after.values()) / 3


def test_tensors_share_the_mask_of_what_is_there(generator):
    cells = sparse(1, 3, 20, 20, 20, generator=generator)
    halves = {name: packing.packed(x, Stored("scaled", 2, "channels"), Recipe(), None, generator)
              for name, x in (("a", cells), ("b", cells[:, :2]))}  # fmt: skip
    head, _, streams = declared(packing.write(halves))
    assert head["tensors"]["a"]["kept"] == head["tensors"]["b"]["kept"]


# Files that are not what they say


def declared(data: bytes) -> tuple[dict, int, bytes]:
    _, length = HEAD.unpack(data[: HEAD.size])
    return json.loads(data[HEAD.size : HEAD.size + length]), length, data[HEAD.size + length :]


def with_head(head: dict, streams: bytes) -> bytes:
    text = json.dumps(head).encode()
    return HEAD.pack(MAGIC, len(text)) + text + streams


def bomb(head: dict) -> None:
    """Zeros that unpack to a terabyte, declared honestly."""
    head["tensors"]["occupied"] |= {"shape": [1 << 20, 1 << 20]}


def dense(head: dict) -> None:
    head["streams"][head["tensors"]["occupied"]["exact"]]["shape"] = [1 << 25]


FAULTS = {
    "a bomb": bomb,
    "denser than zstandard": dense,
    "another shape": lambda head: head["tensors"]["cloud"].update(shape=[400, 5, 3]),
    "another mask": lambda head: head["tensors"]["grid"].update(kept=head["tensors"]["occupied"]["exact"]),
    "no such stream": lambda head: head["tensors"]["plane"]["parts"][0].update(streams=[0, 999]),
    "a stream too few": lambda head: head["tensors"]["plane"]["parts"][0]["streams"].pop(),
    "no such form": lambda head: head["tensors"]["plane"]["parts"][0].update(form="pickle"),
    "no such kind": lambda head: head["streams"][0].update(dtype="object"),
    "a negative side": lambda head: head["tensors"]["plane"].update(shape=[-8, 9, 10, 5]),
    "missing bytes": lambda head: head["streams"][0].update(bytes=head["streams"][0]["bytes"] + 1),
    "differences of floats": lambda head: [s.update(delta=True) for s in head["streams"]],
    "codes as scales": lambda head: head["tensors"]["plane"]["parts"][0]["streams"].reverse(),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_lies_is_refused_in_a_sentence(fault):
    head, _, streams = declared(packing.write(made(torch.Generator().manual_seed(0))))
    FAULTS[fault](head)
    with pytest.raises(LumigraphError, match=r"weights\.packed"):
        packing.read(with_head(head, streams), HERE)


def test_a_code_that_is_in_no_codebook_is_refused(generator):
    streams = Coded(torch.randn(90, 2), torch.ones(90), 9, 0.1, 8, generator).streams()
    streams[2] = streams[2] + 9
    with pytest.raises(ValueError, match="is not in a codebook of 9"):
        Coded.read(streams)


def test_streams_are_no_longer_than_declared():
    stream, data = packed(np.zeros((4, 4), np.float32))
    with pytest.raises(EOFError):
        unpacked(replace(stream, shape=(4, 5)), data)
    with pytest.raises(ValueError, match="goes on"):
        unpacked(replace(stream, shape=(4, 3)), data)
    with pytest.raises(ValueError, match="cannot hold"):
        unpacked(Stream("uint8", (1 << 31,), len(data)), data)


@pytest.mark.parametrize("data", [b"", b"LUMIPACK", MAGIC + struct.pack("<I", 1 << 31) + b"{}", b"x" * 100])
def test_what_is_no_file_of_tensors_is_refused(data):
    with pytest.raises(LumigraphError, match="holds no packed tensors"):
        packing.read(data, HERE)
