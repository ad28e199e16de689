"""Does the kernels' test notice? Faults are written into a copy of an engine, and the same comparison must turn red."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numba
import pytest
from agreement import assert_agrees, cases, edit_engine, plain_lanes

pytestmark = pytest.mark.filterwarnings("ignore:overflow encountered")  # hashes wrap around, in Python aloud


class Fault(NamedTuple):
    """In one function of one engine, `old` becomes `new`."""

    operation: str
    engine: str
    function: str
    old: str
    new: str


FAULTS = {
    # compositing
    "sign": Fault("composite", "gpu", "_backward", " - after", " + after"),
    "off-by-one transmittance": Fault("composite", "gpu", "_backward", "tl.exp(-in_front - t)", "tl.exp(-in_front)"),
    "opacity forgotten": Fault("composite", "gpu", "_backward", "1) + g_opacity +", "1) +"),
    "gradient behind the stop": Fault("composite", "gpu", "_backward", "tl.where(seen, ", "tl.where(i < b, "),
    "attenuation forgotten": Fault("composite", "cpu", "_backward", "worth * through - behind", "worth * through"),
    # hash encoding
    "corner forgotten": Fault("hash_encode", "gpu", "_backward_table", "tl.static_range(8)", "tl.static_range(7)"),
    "weight forgotten": Fault("hash_encode", "gpu", "_backward_table", "weight[:, None] * g", "g"),
    "slope's sign": Fault("hash_encode", "gpu", "_backward_points", "(corner % 2 * 2 - 1)", "(1 - corner % 2 * 2)"),
    "clamped, yet with gradient": Fault("hash_encode", "gpu", "_backward_points", "where(inside_y", "where(here"),
    "gradient of another sample": Fault("hash_encode", "cpu", "_table_gradient", "plane + first + i", "plane + first"),
    "slope's sign on the cpu": Fault("hash_encode", "cpu", "_point_gradient", "(2 * by - 1)", "(1 - 2 * by)"),
    # spherical harmonics
    "sign in band 3": Fault("spherical_harmonics", "gpu", "_backward", "- sectoral * g15", "+ sectoral * g15"),
    "never written": Fault(
        "spherical_harmonics", "gpu", "_backward", "d_directions + 3 * r + 2", "d_directions + 3 * r"
    ),
    "term forgotten": Fault("spherical_harmonics", "cpu", "slope", " - zonal * g[13]", ""),
    # perceptrons
    "a layer that no gate closes": Fault("perceptron", "cpu", "_backward", "layer == 0)", "True)"),
    "the wrong gate": Fault("perceptron", "cpu", "_downwards", "gate + i", "target + i"),
    "the last block's rest counted twice": Fault(
        "perceptron", "cpu", "_fetch", "block[(row + f) * BLOCK : (row + f + 1) * BLOCK] = 0", "pass"
    ),
    # structural similarity
    "the wrong image": Fault("ssim", "cpu", "_gradient", "other[x] * products", "own[x] * products"),
    "the variance's sign": Fault("ssim", "cpu", "_likeness", "= -S * B1 * r", "= S * B1 * r"),
    "the other image's derivative": Fault("ssim", "cpu", "backward", "MEAN_B if i and", "MEAN_A if i and"),
    "the loss's gradient forgotten": Fault("ssim", "cpu", "backward", "grad.item() / a", "1 / a"),
    "a square's slope": Fault("ssim", "gpu", "_gradient", "2 * mine", "mine"),
    "a slope's sign": Fault("ssim", "gpu", "_likeness", "(B1 - B2)", "(B2 - B1)"),
    "the neighbouring channel": Fault("ssim", "gpu", "_along", "(k - REACH) * C", "k - REACH"),
    # projecting
    "held, yet with gradient": Fault("project", "gpu", "_lens_backward", "where(x == X", "where(z > 0"),
    "a lens's second slope": Fault("project", "gpu", "_bend_backward", "6 * p2", "2 * p2"),
    "blur in the compensation": Fault("project", "gpu", "_covariance_backward", "(a + c - blur)", "(a + c)"),
    "a quaternion's length": Fault("project", "gpu", "_matrix_backward", "along * y", "0 * y"),
    "a colour below zero": Fault("project", "gpu", "_backward", "colour[1] > 0", "seen"),
    "the direction's length": Fault("project", "gpu", "_backward", "-_dot(d, d_d)", "0.0"),
    "a lens's second slope on the cpu": Fault("project", "cpu", "_curve", "6 * p2", "2 * p2"),
    "held, yet with gradient on the cpu": Fault("project", "cpu", "_backward", "g_x if over == 0 else 0", "g_x"),
    "the direction's length on the cpu": Fault("project", "cpu", "_backward", "tx - dx * inward", "tx"),
    "the cross product's order": Fault("project", "cpu", "_pulled", "turn * nT[n]", "-turn * nT[n]"),
    # tiling
    "the circle for the ellipse": Fault("tile", "cpu", "_span", " - ellipse[4] * y\n    y =", "\n    y ="),
    "equal depths the other way round": Fault("tile", "cpu", "_near_first", "= order[k]", "= order[-1 - k]"),
    "a column too many": Fault("tile", "cpu", "_hand_out", "- side + HALF", "- side - ONE"),
    "the box for the ellipse": Fault("tile", "gpu", "_tile", "& (least <= reach)", ""),
    "a tile too few": Fault("tile", "gpu", "_span", "last - first + 1", "last - first"),
    "another row's tile": Fault("tile", "gpu", "_tile", "row * across + column", "column * down + row"),
    # rasterising
    "light not lost": Fault("rasterize", "gpu", "_backward", "after / (1 - alpha)", "after"),
    "cut off, yet with gradient": Fault("rasterize", "gpu", "_backward", " & (raw <= OPAQUEST)", ""),
    "an opacity behind the stop": Fault("rasterize", "gpu", "_backward", " & (before >= stop)", ""),
    "all that is behind, again": Fault("rasterize", "gpu", "_backward", "rest -= tl.sum(w * worth, 0)", "rest -= 0"),
    "the other axis": Fault("rasterize", "gpu", "_backward", "conic[2] * sum_y", "conic[0] * sum_y"),
    "a block too few": Fault("rasterize", "cpu", "_blocks", "np.float32(1.5)", "np.float32(0.5)"),
    "spent blocks visited": Fault("rasterize", "cpu", "_alpha", "& (light >= stop)", "& (light >= ZERO)"),
    "light not lost on the cpu": Fault("rasterize", "cpu", "_backward", "behind * inverse(ONE - alpha)", "behind"),
    "0.99, yet with gradient on the cpu": Fault("rasterize", "cpu", "_backward", "raw < OPAQUEST", "raw >= ZERO"),
    "half a square": Fault("rasterize", "cpu", "_gather", "-HALF * s[5]", "-s[5]"),
    "only one block's sums": Fault("rasterize", "cpu", "_gather", "and masks[p]", "and masks[p] == 1"),
    # marching has no backward pass
    "empty cells counted": Fault("march", "gpu", "_march", "count += kept", "count += held"),
    "a cell too far": Fault("march", "gpu", "_first_at", "- 0.02)", "+ 1.0)"),
    "spent, yet going on": Fault("march", "gpu", "_march", "alive &= thickness <= most", "pass"),
}


def seed(fault: Fault, folder: Path, monkeypatch) -> None:
    """Put a copy of the engine, with the fault in it, in the engine's place."""

    def edit(source: str) -> str:
        before, function = source.split(f"def {fault.function}(", 1)
        assert fault.old in function, f"{fault.operation}/{fault.engine}.py no longer says {fault.old!r}"
        return plain_lanes(f"{before}def {fault.function}({function.replace(fault.old, fault.new, 1)}")

    monkeypatch.setattr(numba.config, "DISABLE_JIT", True)  # as plain Python, which spares compiling each copy
    edit_engine(fault.operation, fault.engine, edit, folder, monkeypatch)


def compare(fault: Fault) -> None:
    for inputs in cases(fault.operation):
        assert_agrees(fault.operation, fault.engine, inputs)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_turns_the_test_red(name, tmp_path, monkeypatch):
    seed(FAULTS[name], tmp_path, monkeypatch)
    with pytest.raises(AssertionError, match="result"):
        compare(FAULTS[name])


@pytest.mark.parametrize(("operation", "engine"), [("composite", "cpu"), ("spherical_harmonics", "gpu")])
def test_a_copy_without_a_fault_stays_green(operation, engine, tmp_path, monkeypatch):
    sound = Fault(operation, engine, "_backward", "", "")
    seed(sound, tmp_path, monkeypatch)
    compare(sound)
