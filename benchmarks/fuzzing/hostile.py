"""Pickled arrays and files of LiDARs that somebody made to do harm."""

from __future__ import annotations

import pickle
import pickletools
import random
import struct
from typing import Any

import numpy as np

MARK = "ran"  # file that a pickle makes if it runs; the second program below counts its letters
HEADER = 128  # bytes of a .npy file ahead of its pickle
OPCODES = [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
SIZES = (0, 1, 255, 65_535, 2**24, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1)
TYPES = ("f8", "f16", "O8", "V8", "V100000000", "U9999", "S0", "M8", "c16", "i4", "b1", "x9", "f8,i4")
NAMES = (b"os\nsystem", b"builtins\neval", b"numpy\nload", b"numpy\nmemmap", b"functools\npartial", b"numpy\nndarray")
NAMES += (b"numpy.core.multiarray\nscalar", b"lumigraph.files\nremove", b"copyreg\n_reconstructor", b"a b\nc d")
WRONG = (float("nan"), float("inf"), 3e307, -1e300, 0.0, 1e-320, 2**70, "", "\0", "../../x", b"\xff", None, [], {})


class Described:
    """An object that is pickled as a call, with a state."""

    def __init__(self, *parts: Any):
        self.parts = parts

    def __reduce__(self) -> tuple:
        return self.parts


def pickled(data: bytes, chance: random.Random) -> bytes:
    """A pickled .npy file with opcodes, types, shapes or values that are others, or with a program that multiplies.

    data: a file as it should be, for it is unpickled
    """
    head, body = data[:HEADER], data[HEADER:]
    way = chance.choice((swapped, swapped, other_value, other_value, other_state, other_state, program, program))
    return head + way(body, chance)


def swapped(body: bytes, chance: random.Random) -> bytes:
    """Opcodes replaced by others, or with another argument."""
    places = [at for _, _, at in pickletools.genops(body)]
    changed = bytearray(body)
    for at in chance.sample(places, min(len(places), chance.choice((1, 1, 3, 20)))):
        if chance.random() < 0.7:
            changed[at : at + 1] = chance.choice(OPCODES)
        else:
            changed[at + 1 : at + 5] = chance.choice((b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", chance.randbytes(4)))
    return bytes(changed)


def other_value(body: bytes, chance: random.Random) -> bytes:
    """One value of the dictionary replaced, deep inside or not."""
    whole = pickle.loads(body)
    place, key = {"whole": whole[()]}, "whole"
    while isinstance(place[key], dict | list) and place[key] and chance.random() < 0.8:
        place = place[key]
        key = chance.choice(list(place) if isinstance(place, dict) else range(len(place)))
    if isinstance(place[key], np.ndarray) and place[key].size and chance.random() < 0.7:
        place[key] = place[key].astype(float)
        place[key].flat[chance.randrange(place[key].size)] = chance.choice((np.nan, np.inf, 3e307, -1e30, 0.0))
    else:
        place[key] = chance.choice((*WRONG, bomb(chance), described_array(chance)))
    made = np.empty((), object)
    made[()] = place["whole"] if key == "whole" else whole[()]
    return pickle.dumps(made, chance.randrange(6))


def other_state(body: bytes, chance: random.Random) -> bytes:
    """An array, alone or in the place of the matrices, whose type or state is not what NumPy writes."""
    made = described_array(chance)
    whole = {"cams": dict.fromkeys("KDRT", made), "ims": [{"ims": made}], "poses": made, "Rh": made, "Th": made}
    return pickle.dumps(chance.choice((made, whole)), chance.randrange(6))


def described_array(chance: random.Random) -> Described:
    multiarray = np._core.multiarray  # type: ignore[attr-defined]
    junk = (None, b"AAAAAAAA", 0x4141414141414141, -1, ("a", "b"), {"a": (np.dtype("f8"), 2**62)}, 2**31, 1e300)
    state = (3, chance.choice("<>|=?"), *(chance.choice(junk) for _ in range(chance.choice((3, 6, 7)))))
    dtype = Described(np.dtype, (chance.choice(TYPES), False, True), state)
    shape = tuple(chance.choice((0, 1, 3, -1, 2**20, 2**40, 2**63)) for _ in range(chance.choice((0, 1, 2, 3, 40))))
    raw = chance.choice((b"", bytes(24), chance.randbytes(72), "text", [1, 2, 3], None))
    if chance.random() < 0.3:
        return Described(multiarray.scalar, (dtype, raw))
    if chance.random() < 0.2:
        return Described(np._core.numeric._frombuffer, (raw, dtype, shape, chance.choice("CFK")))  # type: ignore
    return Described(multiarray._reconstruct, (np.ndarray, (0,), b"b"), (1, shape, dtype, chance.random() < 0.5, raw))


def bomb(chance: random.Random) -> list:
    """Lists that refer to one list several times, level above level."""
    found: list = [1.0]
    for _ in range(chance.choice((3, 8, 30, 49))):
        found = [found] * chance.choice((2, 10, 100))
    return found


def program(body: bytes, chance: random.Random) -> bytes:
    """A program of few kinds of opcodes: names of functions, lists within themselves, endless stacks, sizes."""
    size = chance.choice(SIZES)
    return chance.choice(
        (
            b"c" + chance.choice(NAMES) + b"\n(S'touch %b'\ntR." % MARK.encode(),
            b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c\x09touch %b\x85R." % MARK.encode(),
            b"]q\x00h\x00a.",
            b"]q\x00(h\x00h\x00h\x00e.",
            b"}q\x00X\x01\0\0\0ah\x00s.",
            b"]" * 100_000 + b"a" * 99_999 + b".",
            b"(" * 1_000_000 + b".",
            chance.choice((b"N", b"]", b"}", b"(", b"K\x01", b")", b"]0")) * 3_000_000 + b".",
            b"]" + b"2" * 1_000_000 + b".",
            b"I" + b"9" * 50_000 + b"\n.",
            b"L" + b"9" * 50_000 + b"L\n.",
            b"\x8b" + struct.pack("<I", size & 0xFFFFFFFF) + bytes(100) + b".",
            b"\x8d" + struct.pack("<Q", size) + b"abc.",
            b"\x95" + struct.pack("<Q", size) + b"N.",
            b"\x96" + struct.pack("<Q", size) + bytes(8) + b".",
            b"r" + struct.pack("<I", size & 0xFFFFFFFF) + b"N.",
            b"S'" + b"\\x41" * 10_000 + b"'\n.",
            b"S'unfinished",
            b"P12\n.",
            b"\x80\x04K\x05Q.",
            b"\x82\x01.",
            b"(lp0\n(lp1\ng0\nag1\na.",
            pickle.dumps(bomb(chance), chance.randrange(6)),
            b"".join([b"(lp0\n", *(b"(lp%d\n" % i + b"g%d\na" % (i - 1) * 10 for i in range(1, 40))]) + b".",
        )
    )


def lidar(data: bytes, chance: random.Random) -> bytes:
    """A .las or .laz file with other counts, offsets, types of points or chunks."""
    if len(data) < 400:
        return data + chance.randbytes(7)
    header, points = struct.unpack_from("<H", data, 94)[0], struct.unpack_from("<I", data, 96)[0]
    table = struct.unpack_from("<q", data, points)[0] if points + 8 < len(data) else 0
    compressor = header + 54  # of a record's own header
    fields: list[tuple[int, str]] = [(94, "<H"), (96, "<I"), (100, "<I"), (104, "<B"), (105, "<H"), (107, "<I")]
    fields += [(107, "<I"), (24, "<B"), (25, "<B"), (131, "<d"), (155, "<d"), (header + 20, "<H"), (points, "<q")]
    fields += [(compressor + at, kind) for at, kind in ((0, "<H"), (2, "<H"), (12, "<I"), (12, "<I"), (32, "<H"))]
    fields += [(compressor + 34 + at, "<H") for at in (0, 2, 2, 4)]
    fields += [(table, "<I"), (table + 4, "<I"), (table + 4, "<I"), (table + 4, "<I"), (table + 8, "<I")]
    changed = bytearray(data)
    for at, kind in chance.sample(fields, chance.choice((1, 1, 2, 4))):
        wide = struct.calcsize(kind)
        if 0 <= at <= len(data) - wide:
            new: Any = chance.choice((float("nan"), 1e300, 0.0)) if kind == "<d" else chance.choice(SIZES)
            changed[at : at + wide] = struct.pack("<d", new) if kind == "<d" else struct.pack("<Q", new)[:wide]
    if chance.random() < 0.3:
        at = chance.randrange(min(points, len(data) - 1), len(data))
        changed[at : at + chance.choice((1, 8, 200))] = chance.randbytes(chance.choice((1, 8, 200)))
    return bytes(changed)
