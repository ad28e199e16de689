"""Names in the order in which people count, and guesses at what a misspelt one meant."""

from __future__ import annotations

import pytest

from lumigraph.errors import LumigraphError
from lumigraph.files.names import meant, natural
from lumigraph.methods import available, check


def test_numbers_in_names_count_as_numbers():
    assert sorted(["10", "1", "2"], key=natural) == ["1", "2", "10"]
    names = ["b/2.jpg", "a/12.jpg", "a/3.jpg", "a/3b.jpg", "a/03.jpg", "a/.jpg"]
    assert sorted(names, key=natural) == ["a/.jpg", "a/03.jpg", "a/3.jpg", "a/3b.jpg", "a/12.jpg", "b/2.jpg"]


@pytest.mark.parametrize(
    "names",
    [
        [f"IMG_{i:04d}.jpg" for i in (0, 7, 10, 99, 1000)],
        ["DSC(1).jpg", "DSC-1.jpg", "DSC1.jpg", "DSC_1.jpg", "DSCa.jpg", "dsc1.jpg"],
        ["20240131_120000.jpg", "20240131_120000(1).jpg", "20240131_120001.jpg"],
        ["1305031102.175304.png", "1305031102.211214.png", "1305031103.000000.png"],
    ],
)
def test_names_with_numbers_of_equal_length_keep_their_order(names):
    assert sorted(names, key=natural) == sorted(names)


@pytest.mark.parametrize(
    ("said", "method"),
    [
        ("gaussian", "gaussian-splatting"),
        ("3dgs", "gaussian-splatting"),
        ("GS", "gaussian-splatting"),
        ("ngp", "instant-ngp"),
        ("instantngp", "instant-ngp"),
        ("nref", "nerf"),
        ("mip", "mip-nerf"),
    ],
)
def test_a_close_miss_is_guessed(said, method):
    with pytest.raises(LumigraphError, match=f"did you mean {method}\\?"):
        check(said)


@pytest.mark.parametrize("said", ["", "42", "quux"])
def test_what_is_far_from_all_is_not_guessed(said):
    assert meant(said, available()) is None
