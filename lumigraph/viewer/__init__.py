"""The viewer: a scene in the browser, while it is learnt and afterwards. It knows Method.render and no method."""

from .address import Address as Address
from .address import choose_address as choose_address
from .subject import Subject as Subject
from .viewer import Viewer as Viewer
