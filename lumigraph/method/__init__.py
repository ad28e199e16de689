"""Method, and its interfaces: Field, Sampler, Parts."""

from .contexts import frozen as frozen
from .contexts import seeded as seeded
from .field import Features as Features
from .field import Field as Field
from .field_method import FieldMethod as FieldMethod
from .method import BaseConfig as BaseConfig
from .method import Descend as Descend
from .method import Lesson as Lesson
from .method import Method as Method
from .part import Part as Part
from .ray_method import RayMethod as RayMethod
from .sampler import Pass as Pass
from .sampler import Sampler as Sampler
