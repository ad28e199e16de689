"""An opened block run: every block in its place; a camera renders the blocks in its reach.

RUN/
├── blocks.json    see `plan`;  blocks.png  map of the plan
├── blocks/0/      an ordinary run for each block, in a frame of its own
└── eval.json, eval.png, renders/ ...   as of any run
"""

import math
import warnings
from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .. import files, methods
from ..camera import Camera
from ..components.fields.appearance import Appearance
from ..composition import PickedCloud, Placed
from ..datasets.alignment import aligning
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphError, LumigraphWarning
from ..files.names import natural
from ..geometry import Similarity
from ..method import Method
from ..method.capabilities import HasGaussians, RefinesPoses, can
from ..opening import open_dataset
from ..readers import Before, CapturePart
from ..run.checkpoint import State
from ..run.folder import Run
from ..run.opened import Trained, controlled
from ..run.records import warn_of_changes
from ..run.settings import Settings, Source
from .block_cache import Nearby
from .compositing import InBlocks, merged
from .plan import BLOCKS_FOLDER, PLAN_FILE, Block, Plan

MAX_REACH = 64.0


class BlockRun(Trained):
    """A folder with a block run. Raises LumigraphError if none of its blocks has a state.

    plan:   contents of blocks.json
    blocks: runs by name of those with a state; the others are named in a LumigraphWarning
    frame:  upright, all blocks within [-1, 1]^3
    """

    def __init__(self, folder: Path | str):
        self.path = self.folder = Path(folder)
        self.plan = Plan.read(self.folder / PLAN_FILE)
        self.runs = {block.name: run for block in self.plan.blocks if (run := state_of(self.folder, block)) is not None}
        self.blocks = [block for block in self.plan.blocks if block.name in self.runs]
        if not self.blocks:
            raise LumigraphError(
                f"{self.folder} cannot be shown: it has no block that has learnt anything yet; `lumigraph train` with "
                "the same options goes on with it"
            )
        if missing := [block.name for block in self.plan.blocks if block.name not in self.runs]:
            warnings.warn(
                f"{self.folder} is shown without {len(missing)} of its blocks, which have learnt nothing yet: "
                f"{', '.join(missing[:20])}",
                LumigraphWarning,
                2,
            )
        self.frame = self._frame()

    @property
    def centres(self) -> Float[Tensor, "block 3"]:
        """Centres of the blocks, in the frame."""
        source = torch.tensor([block.centre for block in self.blocks], dtype=torch.float64)
        return self.frame.to_source.inverse.points(source).float()

    @property
    def radii(self) -> Float[Tensor, " block"]:
        """Radii of the blocks, in the frame's units."""
        return torch.tensor([block.radius for block in self.blocks]) / self.frame.to_source.scale

    @cached_property
    def _around(self) -> CapturePart:
        """Bounding ball of all blocks of the plan, centred on the ground, in the source's frame."""
        upright = np.array(self.plan.upright)
        centres = np.array([block.centre for block in self.plan.blocks]) @ upright.T
        radii = np.array([[block.radius] for block in self.plan.blocks])
        low, high = (centres - radii).min(0), (centres + radii).max(0)
        x, y, z = (0.5 * (low + high) @ upright).tolist()
        return CapturePart([], (x, y, z), 0.5 * float((high - low)[:2].max()))

    def _frame(self) -> Frame:
        around, upright = self._around, np.array(self.plan.upright)
        rotation = torch.from_numpy(upright.T).double()
        to_source = Similarity.make(around.radius, rotation, torch.tensor(around.centre, dtype=torch.float64))
        frames = [self.runs[block.name].frame for block in self.blocks]
        own = Frame(source_from_scene=to_source.rows)
        centres = torch.stack([(own.to_source.inverse @ frame.to_source).matrix[:3, 3] for frame in frames])
        numbers = [(frame.to_source.scale / around.radius, frame.reach, frame.near) for frame in frames]
        scale, reach, near = torch.tensor(numbers, dtype=torch.float64).unbind(-1)
        low = (centres - scale[:, None]).amin(0).clamp(-1, 1)
        high = (centres + scale[:, None]).amax(0).clamp(-1, 1)
        farthest = float((centres.abs().amax(1) + scale * reach).max())
        times = [time for frame in frames if frame.times for time in frame.times]
        return replace(
            own,
            bounds=(tuple(low.tolist()), tuple(high.tolist())),
            reach=min(2.0 ** max(1, math.ceil(math.log2(farthest))), MAX_REACH),
            near=float((near * scale).min()),
            background=frames[0].background,
            has_alpha=any(frame.has_alpha for frame in frames),
            image_count=sum(len(block.photographs) for block in self.blocks),
            times=(min(times), max(times)) if times else None,
        )

    def method(
        self, device: torch.device | str = "cpu", exposures: Float[Tensor, " photograph"] | None = None
    ) -> Method:
        """All blocks as one method; clouds of Gaussians, each cropped to its cell, as one cloud.

        exposures: of photographs that will be passed to it, by their `image_index`
        """
        if all(can(methods.find(run.method_name), HasGaussians) for run in self.runs.values()):
            parts = [self.placed(block, device) for block in self.blocks]
            level = self.centres
            level[:, 2] = level[:, 2].mean()  # so that cells stand upright
            refined = any(can(part.method, RefinesPoses) for part in parts)
            return PickedCloud(self.frame, merged(parts, level), refined).to(device)
        nearby = Nearby(lambda i: self.placed(self.blocks[i], device), len(self.blocks))
        return InBlocks(self.frame, nearby, self.centres, self.radii, exposures=exposures).to(device)

    def placed(self, block: Block, device: torch.device | str = "cpu") -> Placed:
        """A block with its place in the common frame, in its aligned appearance if any. A run with pose optimisation
        has a frame of its own, which is aligned by its training photographs."""
        run = self.runs[block.name]
        method = run.method(device).requires_grad_(False)
        if code := self.plan.appearance.get(block.name):
            method = method.given(Appearance(torch.tensor(code, device=device)))
        place = self.frame.to_source.inverse @ run.frame.to_source
        if can(method, RefinesPoses):
            given = run.cameras()["train"]
            place = place @ aligning(method.refined(given), given)
        return Placed(method, place)

    @cached_property
    def _photographs(self) -> dict[tuple[str, str], tuple[str, str]]:
        """Nearest block and split of each photograph, by source and name."""
        found: dict[tuple[str, str], tuple[float, str, str]] = {}
        for block in self.blocks:
            run, source = self.runs[block.name], self._source(block)
            centre, cameras = torch.tensor(block.centre, dtype=torch.float64), run.cameras()
            for split, names in run.view_names().items():
                away = (run.frame.to_source.points(cameras[split].position.double()) - centre).norm(dim=-1)
                for name, distance in zip(names, away.tolist(), strict=True):
                    if (source, name) not in found or distance < found[source, name][0]:
                        found[source, name] = distance, block.name, split
        return {key: (block, split) for key, (_, block, split) in found.items()}

    def _source(self, block: Block) -> str:
        return (block.scene or self.plan.scene).source

    def cameras(self) -> dict[str, Camera]:
        """The photographs' cameras by split, in the frame; each once, from its nearest block."""
        return {split: Camera.cat([camera for _, camera in some]) for split, some in self._views.items()}

    def view_names(self) -> dict[str, list[str]]:
        return {split: [name for name, _ in some] for split, some in self._views.items()}

    @cached_property
    def _views(self) -> dict[str, list[tuple[str, Camera]]]:
        """Names and cameras of photographs by split, the training ones first."""
        found: dict[str, list[tuple[str, Camera]]] = {"train": []}
        for block in self.blocks:
            run, names = self.runs[block.name], self.runs[block.name].view_names()
            place = (self.frame.to_source.inverse @ run.frame.to_source).matrix
            for split, cameras in run.cameras().items():
                moved = replace(cameras.transformed(place), image_index=None)
                for i, name in enumerate(names[split]):
                    if self._photographs[self._source(block), name] == (block.name, split):
                        found.setdefault(split, []).append((name, moved[i]))
        return found

    @property
    def photographed(self) -> bool:
        return True

    @property
    def conversion_fault(self) -> str:
        return f"is a run in blocks; convert each by itself: {self.folder / BLOCKS_FOLDER / self.blocks[0].name}"

    def dataset(self, source: str | None = None, split: str | None = None) -> Scene:
        """Open the photographs again, in the frame.

        source: their present path, if they have moved; that of a retrained block opens its photographs alone
        split:  only this one and a training photograph, which every scene needs; None for all
        """
        again = {self._source(block) for block in self.blocks if block.scene is not None}
        asked = str(Path(source).resolve()) if source and Path(source).exists() else source
        origin = asked if asked in again else self.plan.scene.source
        there = {name: use for (place, name), (_, use) in self._photographs.items() if place == origin}
        names = [name for name, purpose in there.items() if split in (None, purpose)]
        if split not in (None, "train"):
            names += [name for name, purpose in there.items() if purpose == "train"][:1]
        names = sorted(dict.fromkeys(names), key=natural)
        options = {name: value for name, value in self.plan.scene.options.items() if value is not None}
        part = replace(self._around, photographs=names)
        before = Before(names, np.array(self.plan.upright))
        data = open_dataset(source or origin, Scene, **options, part=part, before=before)
        assert isinstance(data, Scene)
        runs = [self.runs[block.name] for block in self.blocks if self._source(block) == origin]
        warn_of_changes({name: digest for run in runs for name, digest in run.digests().items()}, data, self.folder)
        return replace(data, frame=self.frame)

    def scene(self, source: str | None = None) -> Scene:
        """All photographs."""
        return self.dataset(source)

    @property
    def learnt_from(self) -> Source:
        return self.plan.scene

    def method_and_data(
        self, device: torch.device | str, settings: Iterable[str] = (), source: str | None = None, split: str = "test"
    ) -> tuple[Method, Scene]:
        """Method by the exposures of the photographs that it will be given, and these."""
        data = self.dataset(source, split)
        return controlled(self, self.method(device, data.about.get("exposure")), settings), data

    @property
    def method_name(self) -> str:
        return self.plan.method

    @property
    def state(self) -> State:
        """Steps and seconds of all blocks together, and the largest peak memory."""
        states = [run.state for run in self.runs.values()]
        return State(
            sum(x.step for x in states),
            sum(x.seconds for x in states),
            sum(x.compile_seconds for x in states),
            max(x.peak_memory for x in states),
        )

    @property
    def model_bytes(self) -> int:
        return sum(run.model_bytes for run in self.runs.values())

    @property
    def settings(self) -> Settings:  # type: ignore[override]  # from all blocks, when it is asked for
        """Settings of an equivalent ordinary run."""
        plan, counts = self.plan, dict[str, int]()
        for _, split in self._photographs.values():
            counts[split] = counts.get(split, 0) + 1
        return Settings(
            plan.method, plan.config, self.frame, plan.scene, counts, plan.seed, {}, plan.device, plan.processor,
            plan.versions,
        )  # fmt: skip


def state_of(folder: Path, block: Block) -> Run | None:
    """The run of a block, if it has a state."""
    place = folder / BLOCKS_FOLDER / block.name
    if not files.is_file(place / "config.json"):
        return None
    run = Run(place)
    if run.method_name not in methods.available():
        run.new_method()  # says which methods there are
    return run if run.has_state else None
