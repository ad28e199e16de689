"""Hook of the site (mkdocs.yml): fences of the language math, which hold LaTeX, become MathML."""

from __future__ import annotations

import re
from typing import Any
from xml.etree.ElementTree import Element, ParseError, fromstring, tostring

from latex2mathml.converter import convert
from pymdownx.superfences import SuperFencesException

NAMESPACE = ' xmlns="http://www.w3.org/1998/Math/MathML"'
SCRIPTS = {"msub", "msup", "msubsup", "munder", "mover", "munderover"}
LIMITS = {"msub": "munder", "msubsup": "munderover"}
LIMITS_BELOW = {"∑", "∏", "⨁", "max", "min"}  # in displayed equations
THIN_SPACE = {"width": "0.167em"}
CLOSING = (")", "]", "}", "|", "‖")


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
        written = convert(source.replace("{aligned}", "{split}"), display="block")
        tree = fromstring(written.replace(NAMESPACE, ""))
    except ParseError as error:
        raise ValueError("An & or < is outside {aligned} and {cases}; write \\lt for the sign.") from error
    except Exception as error:  # the converter's own have no common base
        raise ValueError(f"LaTeX that latex2mathml does not read: {type(error).__name__} {error}") from error
    for element in tree.iter():
        if "\\" in (element.text or ""):
            raise ValueError(f"LaTeX that latex2mathml does not know: {element.text}")
    for element in list(tree.iter()):
        if element.tag in LIMITS and (element[0].text in LIMITS_BELOW or "movablelimits" in element[0].attrib):
            element.tag = LIMITS[element.tag]
        elif element.tag not in SCRIPTS:
            space(element)
    return tostring(tree, encoding="unicode", short_empty_elements=False)


def space(parent: Element) -> None:
    """Thin spaces around names of functions, as TeX has them; signs of one operand and bars close to it."""
    children = list(parent)
    for before, child, after in zip([None, *children], children, [*children[1:], None], strict=False):
        mark = child[0] if child.tag in SCRIPTS else child
        if mark.tag == "mi" and mark.text == "~":
            mark.tag, mark.text = "mo", "∼"
        if mark.tag == "mo" and mark.text in ("|", "‖") and "fence" not in mark.attrib:
            mark.attrib.update(stretchy="false", lspace="0", rspace="0")
        if mark.tag == "mo" and (mark.text == "/" or is_name(child)):
            mark.attrib.update(lspace="0", rspace="0")
        if child.text in ("−", "+") and before is not None and before.tag == "mo" and before.text not in CLOSING:
            child.set("form", "prefix")
        if not is_name(child):
            continue
        if before is not None and (before.tag not in ("mo", "mspace", "mtext") or before.text in CLOSING):
            parent.insert(list(parent).index(child), Element("mspace", THIN_SPACE))
        if after is not None and (
            after.tag not in ("mo", "mspace", "mtext") or after.text in ("|", "‖") or is_name(after)
        ):
            parent.insert(list(parent).index(child) + 1, Element("mspace", THIN_SPACE))


def is_name(element: Element) -> bool:
    """Name of a function, also with indices."""
    mark = element[0] if element.tag in SCRIPTS else element
    return mark.tag in ("mi", "mo") and bool(re.fullmatch(r"[A-Za-z\s]{2,}", mark.text or ""))
