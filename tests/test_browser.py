"""The browser of the tests: it draws what WebGL is told, and tells what goes wrong."""

from __future__ import annotations

import io

import numpy as np
from budgets import budget
from PIL import Image

pytestmark = budget("exports")

PAGE = """<body style="margin:0"><canvas width=40 height=30></canvas><script>
const gl = document.querySelector("canvas").getContext("webgl2");
gl.clearColor(0.2, 0.4, 0.6, 1);
gl.clear(gl.COLOR_BUFFER_BIT);
</script>"""


def test_webgl_draws(page, faults):
    page.set_content(PAGE)
    pixels = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"))
    assert pixels.shape == (30, 40, 3)
    assert np.abs(pixels - np.array([51, 102, 153])).max() <= 1
    assert faults == []


def test_faults_are_heard(page, faults):
    page.set_content("<script>console.error('first'); console.log('nothing'); throw new Error('second')</script>")
    page.wait_for_function("true")
    assert len(faults) == 2 and faults[0] == "first" and "second" in faults[1]
