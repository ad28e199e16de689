"""Licences of everything that the project's requirements install, its extras and tools among them, transitively.

The metadata of each installed package count: License-Expression, or else the classifiers and a License of one line. A
package without any of these, or with a name that ALLOWED lacks, fails the test until EXCEPTIONS has a reason for it.
Requirements that are not installed here, as of other systems, must be in NOT_INSTALLED, with a licence read by hand.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator
from fnmatch import fnmatch
from importlib.metadata import Distribution, distributions
from pathlib import Path

from budgets import budget
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

pytestmark = budget("house", 2)
PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
ALLOWED = {  # without the words licence, software and version, and without punctuation
    *("mit", "mit cmu", "mit 0", "isc", "isc iscl", "zlib", "0bsd", "cc0 1.0", "bsl 1.0", "unlicense"),
    *("bsd", "bsd 2 clause", "bsd 3 clause", "3 clause bsd", "apache", "apache 2.0", "apache 2.0 with llvm exception"),
    *("psf 2.0", "python foundation", "cnri python"),
}
EXCEPTIONS = {
    "pi-heif": "LGPL: decodes HEIC photographs by libheif, a shared library that can be exchanged; nothing is copied",
    "certifi": "MPL: a list of certificates, unchanged; of the tools and of guidance by words",
    "tqdm": "MPL: unchanged; of the weights' download in guidance by words",
    "pathspec": "MPL: unchanged; of the type checker",
    "frozendict": "LGPL: plain Python, imported by the reader of Minecraft's worlds, extra `worlds`",
    "openexr": "BSD 3-clause, by the LICENSE.md in its wheel; its metadata name none",
    "usd-core": "Tomorrow Open Source Technology 1.0: Apache 2.0 with other words on trademarks; extra `usd`",
    "nvidia-*": "NVIDIA's own: libraries of CUDA that PyTorch's build for GPUs requires; nothing of ours contains them",
    "cuda-*": "NVIDIA's own: as nvidia-*",
}
NOT_INSTALLED = {
    "pyliblzfse": "MIT, of extra `record3d`, whose wheel few systems have",
    "wandb": "MIT; hundreds of megabytes with what it needs, as the three below",
    "trackio": "MIT",
    "rerun-sdk": "MIT or Apache-2.0",
    "mujoco": "Apache-2.0",
}


def requirements(words: Iterable[str], extras: Iterable[str] = ()) -> Iterator[Requirement]:
    """Requirements that hold on this system, with some extras."""
    for requirement in map(Requirement, words):
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": x}) for x in ("", *extras)):
            yield requirement


def needed(known: dict[str, Distribution], words: Iterable[str]) -> tuple[set[str], set[str]]:
    """Names of packages that requirements install, transitively: those that are here, and those that are not."""
    todo, seen = list(requirements(words)), set()
    while todo:
        one = todo.pop()
        key = canonicalize_name(one.name), frozenset(one.extras)
        if key not in seen:
            seen.add(key)
            todo += requirements(known[key[0]].requires or () if key[0] in known else (), key[1])
    names = {name for name, _ in seen}
    return names & {*known}, names - {*known}


def licences(package: Distribution) -> list[list[str]]:
    """Alternatives, each a list of licences that hold together; an empty one where the metadata have none."""
    metadata, line = package.metadata, (package.metadata["License"] or "").strip()
    if expression := metadata["License-Expression"]:
        return said(expression)
    classifiers = [x.split("::")[-1] for x in metadata.get_all("Classifier") or () if x.startswith("License ::")]
    if "\n" in line:  # the whole text
        line = "" if classifiers else line.partition("\n")[0]
    return [[*map(plain, classifiers), *all_of] for all_of in said("" if line == "UNKNOWN" else line)]


def said(expression: str) -> list[list[str]]:
    alternatives = re.sub("[()]", " ", expression).split(" OR ")
    return [[plain(part) for part in one.split(" AND ") if part.strip()] for one in alternatives]


def plain(name: str) -> str:
    words = re.sub(r"[^a-z0-9.]+", " ", name.lower()).split()
    return " ".join(dict.fromkeys(word for word in words if word not in ("the", "license", "software", "version")))


def faults(known: dict[str, Distribution], words: Iterable[str]) -> list[str]:
    here, absent = needed(known, words)
    refused = {name: licences(known[name]) for name in here}
    return [
        *(f"{name} is not installed, so its licence is unknown" for name in absent - {*NOT_INSTALLED}),
        *(
            f"{name} is under {found}"
            for name, found in sorted(refused.items())
            if not any(all_of and {*all_of} <= ALLOWED for all_of in found)
            and not any(fnmatch(name, pattern) for pattern in EXCEPTIONS)
        ),
    ]


def installed(*path: str) -> dict[str, Distribution]:
    """Packages by their name. path: folders to look in instead of Python's"""
    found = distributions(path=[*path]) if path else distributions()
    return {canonicalize_name(one.metadata["Name"]): one for one in found}


REQUIRED = [*PROJECT["dependencies"], *sum(PROJECT["optional-dependencies"].values(), [])]


def test_everything_that_is_installed_has_a_licence_that_suits():
    assert len(needed(installed(), REQUIRED)[0]) > 80
    assert not (found := faults(installed(), REQUIRED)), "\n".join(found)


def test_what_does_not_suit_is_found(tmp_path):
    """Metadata as packages have them, plyfile's of 1.1 among them; one is required by another alone."""
    cases = {
        "plyfile": ["License: GNU GENERAL PUBLIC LICENSE\n        Version 3, 29 June 2007",
                    "Classifier: License :: OSI Approved :: GNU General Public License v3 or later (GPLv3+)"],
        "line": ["License: GPL-3.0"],
        "lesser": ["License: BSD-3-Clause",
                   "Classifier: License :: OSI Approved :: GNU Lesser General Public License v3"],
        "both": ["License-Expression: MIT AND AGPL-3.0-only"],
        "silent": [],
        "unknown": ["License: UNKNOWN"],
        "text": ["License: Proprietary, all rights reserved\n        and more"],
    }  # fmt: skip
    suited = {
        "either": ["License-Expression: (GPL-3.0-only OR Apache-2.0)", "Requires-Dist: plyfile"],
        "short": ["License: The MIT License (MIT)\n        Copyright (c)"],
        "gpu": ["License-Expression: MIT", 'Requires-Dist: line; extra == "not-asked-for"'],
    }
    for name, lines in (cases | suited).items():
        place = tmp_path / f"{name}-1.1.dist-info"
        place.mkdir()
        (place / "METADATA").write_text(
            "\n".join(["Metadata-Version: 2.4", f"Name: {name}", "Version: 1.1", *lines, ""])
        )
    known = installed(str(tmp_path))
    for name in cases:
        assert [x.partition(" ")[0] for x in faults(known, [f"{name}>=1.1"])] == [name]
    assert [x.partition(" ")[0] for x in faults(known, ["either"])] == ["plyfile"]
    assert faults(known, ["short", "gpu", "gone; python_version < '3'"]) == []
    assert faults(known, ["gone"]) == ["gone is not installed, so its licence is unknown"]
