"""Files: atomic writing, typed reading."""

from .atomic import Kind as Kind
from .atomic import check_room as check_room
from .atomic import claim as claim
from .atomic import claim_folder as claim_folder
from .atomic import exchange as exchange
from .atomic import exists as exists
from .atomic import expanded as expanded
from .atomic import explained as explained
from .atomic import from_json as from_json
from .atomic import is_file as is_file
from .atomic import open_anew as open_anew
from .atomic import read_bytes as read_bytes
from .atomic import read_json as read_json
from .atomic import read_text as read_text
from .atomic import refusal as refusal
from .atomic import refuse_link as refuse_link
from .atomic import refuse_links as refuse_links
from .atomic import remove as remove
from .atomic import replacing as replacing
from .atomic import replacing_folder as replacing_folder
from .atomic import scene_name as scene_name
from .atomic import write_bytes as write_bytes
from .atomic import write_json as write_json
