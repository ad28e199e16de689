"""Hook of the site (mkdocs.yml): fences of the language math, which hold LaTeX, become MathML, which browsers draw by themselves."""

from __future__ import annotations

import re
from typing import Any
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

from latex2mathml.converter import convert
from pymdownx.superfences import SuperFencesException

NAMESPACE = ' xmlns="http://www.w3.org/1998/Math/MathML"'
SCRIPTS = {"msub", "msup", "msubsup", "munder", "mover", "munderover"}
THIN_SPACE = {"width": "0.167em"}


def on_config(config: Any) -> Any:
    """Register the fence. Its name is written here, so that mkdocs.yml stays free of Python objects."""
    fence = {"name": "math", "class": "equation", "format": equation}
    config.mdx_configs.setdefault("pymdownx.superfences", {})["custom_fences"] = [fence]
    return config


def equation(source: str, *_: Any, **__: Any) -> str:
    """HTML of a fence. MkDocs adds the page's name to the error."""
    try:
        return f'<div class="equation">{mathml(source)}</div>'
    except ValueError as error:
        raise SuperFencesException(f"{error}\nin this equation:\n{source}") from error


def mathml(source: str) -> str:
    """MathML of an equation in LaTeX, or a ValueError: the converter itself keeps commands that it does not know."""
    bare = re.sub(r"\\[{}\\]", "", source)
    if bare.count("{") != bare.count("}"):
        raise ValueError("Braces do not match.")
    try:
        written = convert(re.sub(r"{aligned}", "{split}", source), display="block")
        tree = fromstring(written.replace(NAMESPACE, ""))
    except ParseError as error:
        raise ValueError("An & or < is outside {aligned} and {cases}; write \\lt for the sign.") from error
    except Exception as error:  # the converter's own have no common base
        raise ValueError(f"LaTeX that latex2mathml does not read: {type(error).__name__} {error}") from error
    for element in tree.iter():
        if "\\" in (element.text or ""):
            raise ValueError(f"LaTeX that latex2mathml does not know: {element.text}")
    for element in list(tree.iter()):
        if element.tag not in SCRIPTS:
            space(element)
    return tostring(tree, encoding="unicode", short_empty_elements=False)


def space(parent: Element) -> None:
    """Set names of functions upright, with TeX's thin spaces around them."""
    children = list(parent)
    for before, child, after in zip([None, *children], children, [*children[1:], None], strict=False):
        name = child[0] if child.tag in SCRIPTS else child
        if name.tag not in ("mi", "mo") or not re.fullmatch(r"[a-z\s]{2,}", name.text or "", re.IGNORECASE):
            continue
        if name.tag == "mo":
            name.attrib.update(lspace="0", rspace="0")
        if before is not None and (before.tag not in ("mo", "mspace", "mtext") or before.text in (")", "]", "}")):
            parent.insert(list(parent).index(child), Element("mspace", THIN_SPACE))
        if after is not None and after.tag not in ("mo", "mspace", "mtext"):
            parent.insert(list(parent).index(child) + 1, Element("mspace", THIN_SPACE))
