"""Text guidance: models that score pictures by a prompt, and the part that optimises a scene with them."""

from .guides import DistillationNumbers as DistillationNumbers
from .guides import Guide as Guide
from .opening import open_guide as open_guide
from .part import CPU_GUIDANCE as CPU_GUIDANCE
from .part import TINY_GUIDANCE as TINY_GUIDANCE
from .part import Guidance as Guidance
from .part import GuidanceNumbers as GuidanceNumbers
from .views import PromptedViews as PromptedViews
