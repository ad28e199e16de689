"""Method: one paper, trained on a dataset and rendered for cameras."""

from __future__ import annotations

import copy
import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..budget import BY_PHOTOGRAPH, Efforts, Quality
from ..camera import Camera
from ..camera.rays import Rays, Rendering
from ..datasets.scene import Frame, Scene
from ..errors import LumigraphError
from ..exchange.packing import Stored
from ..files.ranges import Seed
from .controls import Control, Value
from .part import Part

SEED_STRIDE = 0x9E3779B1  # between the generators of two seeds, odd (Knuth 1998, section 6.4)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseConfig:
    """Numbers of the Config of every method here."""

    seed: Seed = 0  # seed of all random numbers; another seed gives another run


@runtime_checkable
class Lesson(Protocol):
    """Input of one step: rays, a photograph, points of a shape. Its length is their number.

    unit: of the length, in the plural: "rays", "points"
    """

    unit: ClassVar[str]

    def __len__(self) -> int: ...


@runtime_checkable
class Descend(Protocol):
    """Descent of one step: gradients of summed terms, checked to be finite, then the optimizers' step."""

    def __call__(self, terms: dict[str, Tensor], optimizers: Sequence[torch.optim.Optimizer] | None = None) -> None: ...


class Method(nn.Module, ABC):
    """One paper: trained on a dataset's batches, and rendered for a Camera.

    frame:   bounds, reach, near distance, background, number of images. It is stored in a run, so that a method can be
             built again without the photographs
    config:  the paper's numbers, a frozen dataclass named Config in the method's file
    figures: of the last step, by name, for metrics.jsonl; "mse", the squared error of colours, becomes the PSNR of
             training
    settings: values set by `given`, by the names of the controls
    progress: spent share of the budget (steps or seconds), in [0, 1]; the trainer sets it before each step
    All state that must survive a resume is in parameters, buffers and optimizers.
    """

    Config: ClassVar[type]
    learns_from: ClassVar[type] = Scene  # the kind of dataset
    accepts: ClassVar[tuple[type, ...]] = ()  # the kinds of evidence that `given` takes
    in_blocks: ClassVar[bool] = False  # whether `train` divides a large scene into blocks, each a run of its own
    any_lens: ClassVar[bool] = False  # whether `render` follows every lens, or flat pictures alone
    efforts: ClassVar[Efforts] = BY_PHOTOGRAPH  # what each --quality asks for
    default_quality: ClassVar[Quality | None] = None  # budget of `train` where none is asked for; None: by seconds
    idle_render_share: ClassVar[float] = 0.03  # of training's time, for viewers whose camera is at rest
    taught_steps: ClassVar[int | None] = None  # default steps after another method's field; None: by seconds
    _place: Tensor

    def __init__(self, frame: Frame, config: Any):
        super().__init__()
        self.frame, self.config = frame, config
        self.figures: dict[str, float] = {}
        self.settings: dict[str, Value] = {}
        self.progress = 1.0
        self.register_buffer("_place", torch.empty(0), persistent=False)  # knows the device, also without parameters

    def __repr__(self) -> str:
        """Name, number of parameters, space and device in one line."""
        count, space = sum(x.numel() for x in self.parameters()), "unbounded" if self.frame.is_open else "bounded"
        return f"{type(self).__name__}: {count:,} parameters, {space}, on {self.device}"

    @classmethod
    def preset(cls, device: torch.device) -> Any:
        """Default Config: the paper's on a GPU, `cpu_preset` elsewhere."""
        return cls.Config() if device.type == "cuda" else cls.cpu_preset()

    @classmethod
    def cpu_preset(cls) -> Any:
        """Config for best results after a minute on a CPU; the paper's by default."""
        return cls.Config()

    @classmethod
    def taught_preset(cls, device: torch.device) -> Any:
        """Default Config of a method initialised from a teacher's field."""
        return cls.preset(device)

    @classmethod
    def further_bytes(cls, frame: Frame, config: Any, learning: bool) -> int:
        """Lower bound of the bytes needed beside the initial parameters: grids that are refined and, with `learning`,
        activations for gradients. By default the sum over the Config's parts."""
        held = (getattr(config, x.name) for x in dataclasses.fields(config))
        return sum(x.further_bytes(frame, learning) for x in held if hasattr(x, "further_bytes"))

    def growth_bytes(self) -> int:
        """Bytes by which the method may grow in training, within free memory."""
        return 0

    # Learning

    def steps_per_pass(self, data: Any) -> float:
        """Number of steps of one pass over the "train" split, on average; by default one item a step."""
        return len(data.splits["train"])

    def steps_for(self, quality: Quality, data: Any) -> int:
        """Number of steps of a quality on these data: a budget that is the same on every machine."""
        return self.efforts[quality].steps(self.steps_per_pass(data))

    @abstractmethod
    def batch(self, data: Any, generator: torch.Generator) -> Lesson:
        """Input of one step. All randomness comes from `generator`, on the CPU."""

    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        """Loss terms by name; their sum is minimised."""
        raise NotImplementedError(f"{type(self).__name__} has neither `loss` nor a `step` of its own")

    def step(self, batch: Any, step: int, descend: Descend) -> dict[str, Tensor]:
        """One training step; returns the terms to record. One descent by default; a method may call `descend` several
        times (adversaries, tracking), with some of its optimizers, or never (fusion)."""
        terms = self.loss(batch, step)
        descend(terms)
        return terms

    def optimizers(self) -> list[torch.optim.Optimizer]:
        """Fresh optimizers over the parameters; the trainer calls this once. By default those of the parts."""
        return [optimizer for part in self.parts for optimizer in part.optimizers()]

    def learning_rate(self, step: int, progress: float) -> float | dict[str, float] | None:
        """Learning rate of this step: one for all groups of parameters, or by their "name"; each group multiplies it by
        its own "scale". None keeps the current ones.

        progress: spent share of the budget (steps or seconds), in [0, 1]
        """
        return None

    def learning_rates(self, step: int, progress: float) -> dict[str, float]:
        """Learning rates by the names of groups, "" for groups without one: the parts' and `learning_rate`."""
        rates = {name: rate for part in self.parts for name, rate in part.learning_rates(step, progress).items()}
        own = self.learning_rate(step, progress)
        return rates if own is None else rates | (own if isinstance(own, dict) else {"": own})

    @property
    def complete(self) -> bool:
        """True if training is complete at any budget, such as after the last photograph of a fusion."""
        return False

    def check_data(self, data: Any) -> None:
        """Raise LumigraphError for data that this method cannot learn from; called before a new run compiles or learns
        anything. Nothing is refused by default."""

    def begin(self, data: Any, seconds: float = math.inf) -> None:
        """Initialise from the data; called once, before the first step of a new run.

        seconds: the whole budget, of which a small share may be used; infinite for a budget in steps
        """
        for part in self.parts:
            part.begin(self, data, seconds)

    def compile_begin(self) -> None:
        """Compile kernels that only `begin` uses; called on a copy before the clock starts."""
        for part in self.parts:
            part.compile_begin()

    def before_step(self, step: int, progress: float) -> None:
        """Hook before each step. progress: spent share of the budget (steps or seconds), in [0, 1]"""
        for part in self.parts:
            part.before_step(self, step, progress)

    def after_step(self, step: int) -> None:
        """Hook after each step."""
        for part in self.parts:
            part.after_step(self, step)

    def statistics(self) -> dict[str, float]:
        """Figures of the last step for metrics.jsonl, e.g. rays and samples."""
        return self.figures

    # Being seen

    @abstractmethod
    def render(self, camera: Camera) -> Rendering:
        """Rendering of one camera, (height, width, ...), without gradients, in eval mode."""

    @property
    def background(self) -> Float[Tensor, "1 3"]:
        """Background colour of the scene, one row for all rays."""
        return torch.tensor([self.frame.background], device=self.device)

    # Parts

    @property
    def parts(self) -> list[Part]:
        """All submodules with hooks, in the order in which they were assigned."""
        return [module for module in self.modules() if isinstance(module, Part)]

    @property
    def moves_cameras(self) -> bool:
        """True if a part optimises poses; `begin` then derives nothing from the given ones."""
        return any(part.moves_cameras for part in self.parts)

    def storage(self) -> dict[str, Stored]:
        """Storage of tensors in a compressed run by their names; see `CanCompress`."""
        parts = ((name, part) for name, part in self.named_modules() if isinstance(part, Part))
        return {f"{name}.{tensor}": how for name, part in parts for tensor, how in part.storage().items()}

    # Being told something

    @property
    def controls(self) -> tuple[Control, ...]:
        """Settings that a user may change, beside the camera."""
        return tuple(control for part in self.parts for control in part.controls)

    @property
    def takes(self) -> tuple[type, ...]:
        """Kinds of evidence that `given` currently accepts: those of the class, and of the trained parts."""
        parts = (part for part in self.children() if isinstance(part, Part))
        return (*self.accepts, *(kind for part in parts for kind in part.accepts))

    @property
    def evidence_views(self) -> int | None:
        """Default number of a scene's photographs used as evidence; None for all training ones."""
        return None

    def evidence_bytes(self, scene: Scene) -> int:
        """Least bytes for a scene as evidence."""
        return 0

    def given(self, *evidence: Any, **controls: Value) -> Method:
        """The method with evidence (photographs, points, a light ...) or values of `controls`.

        The result shares all parameters and is an ordinary method for films, viewer and exports.
        Raises LumigraphError for anything that the method does not accept.
        """
        for piece in evidence:
            if not isinstance(piece, self.takes):
                kinds = " or ".join(kind.__name__ for kind in self.takes) or "nothing but its controls"
                kind = type(piece).__name__
                raise LumigraphError(f"{type(self).__name__} cannot be given a {kind}; it takes {kinds}")
        known = {control.name: control for control in self.controls}
        for name in controls:
            if name not in known:
                there = f"there are: {', '.join(known)}" if known else "it has none"
                raise LumigraphError(f"{type(self).__name__} has no control {name!r}; {there}")
        told = copy.copy(self)
        for held in ("_parameters", "_buffers", "_modules"):  # the same tensors, in dictionaries of its own
            told.__dict__[held] = dict(self.__dict__[held])
        told.figures = {}
        told.settings = self.settings | {name: known[name].checked(value) for name, value in controls.items()}
        for piece in evidence:
            for name, part in told.named_children():
                if isinstance(part, Part) and isinstance(piece, part.accepts):
                    told._modules[name] = part.adapted(told, piece)
        told.take_evidence([piece for piece in evidence if isinstance(piece, self.accepts)], controls)
        return told

    def take_evidence(self, evidence: Sequence[Any], controls: dict[str, Value]) -> None:
        """Change the copy that `given` returns, by evidence of the class's own kinds and values of controls."""

    def control(self, name: str) -> Value:
        """Value of a control: as set, or its default."""
        if name in self.settings:
            return self.settings[name]
        return next(x.default for x in self.controls if x.name == name)

    def moments(self, rays: Rays) -> Float[Tensor, " ray"]:
        """Time of each ray, for methods of dynamic scenes with `controls.moment`: the control `time`, else the camera's
        time, else the first time of the capture."""
        if "time" not in self.settings and rays.time is not None:
            return rays.time
        first, _ = self.frame.times or (0.0, 0.0)
        return torch.full_like(rays.radius, float(self.settings.get("time", first)))

    def refined(self, cameras: Camera) -> Camera:
        """Cameras of photographs with learnt pose corrections, by their `image_index`; unchanged without pose
        optimisation. Evaluation, films and exports use these."""
        for part in self.parts:
            cameras = part.refined(cameras)
        return cameras

    # Being made of another

    @classmethod
    def of(cls, other: Method, config: Any) -> Method:
        """A method of this kind converted from another one. Raises LumigraphError if that is impossible."""
        raise LumigraphError(f"{cls.__name__} cannot be made of {type(other).__name__}; it learns from data alone")

    def random(self, number: int) -> torch.Generator:
        """Random generator seeded by the config's seed and a number, such as the step, for exact resuming. Of its own
        seed PyTorch's CPU generator reads the low 32 bits alone."""
        return torch.Generator().manual_seed((SEED_STRIDE * self.config.seed + number) % (1 << 32))

    @property
    def device(self) -> torch.device:
        return self._place.device
