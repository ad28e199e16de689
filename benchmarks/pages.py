"""Likeness of pages of splats and volumes to our own renderings, and seconds of a picture.

    lumigraph export web RUN scene.html
    python benchmarks/pages.py RUN scene.html --output pages

Opens the page in a headless Chromium, which draws in software unless --webgl gives other switches. For some of the
run's cameras, at 400x400 pixels: PSNR of a screenshot against `Method.render`, and the milliseconds that a volume's
picture takes to draw in full, all its bands together. Writes both pictures beside each other with four times their
difference, and what the page shows at first at a desktop's and at a phone's size; and frames per second there while
the scene turns. Bytes of the programs in the page are told before and after unpacking, and seconds to the first
picture and to the whole one at a desktop's size.
"""

from __future__ import annotations

import base64
import gzip
import io
import math
import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from PIL import Image
from tyro.conf import Positional

from lumigraph.camera import Camera
from lumigraph.camera.lens import Pinhole
from lumigraph.files import write_json
from lumigraph.geometry import evenly
from lumigraph.large import open_any

SIZE, ANGLE = 400, 40.0  # pixels, degrees
WINDOWS = {"desktop": (1280, 800, 1), "phone": (390, 844, 2)}
SOFTWARE = "--use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist"
# Adds up what passes between the call that draws and the one that waits for it, of pictures as wide as the window.
CLOCK = """{
  const { drawArrays, readPixels, viewport } = WebGL2RenderingContext.prototype;
  let begin = 0, width = 0;
  window.spent = 0;
  Object.assign(WebGL2RenderingContext.prototype, {
    viewport(...all) { width = all[2]; viewport.apply(this, all); },
    drawArrays(...all) { begin = performance.now(); drawArrays.apply(this, all); },
    readPixels(...all) { readPixels.apply(this, all); if (width === innerWidth) spent += performance.now() - begin; },
  });
}"""
# Turns the scene by its keys, one turn for each frame that the browser shows; frames per second.
TURN = """async (seconds) => {
  const canvas = document.querySelector("#stage canvas"), begin = performance.now();
  let frames = 0;
  for (; performance.now() - begin < 1000 * seconds; frames++) {
    canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
    await new Promise(requestAnimationFrame);
  }
  return frames / seconds;
}"""
TURNED = 4.0  # seconds
BARE = "#caption, #buttons, #wait { display: none !important } * { transition: none !important }"


@dataclass(frozen=True)
class Options:
    run: Annotated[Positional[Path], tyro.conf.arg(metavar="RUN")]
    page: Annotated[Positional[Path], tyro.conf.arg(metavar="PAGE")]
    output: Path = Path("pages")
    views: int = 4
    chromium: Path = Path("/usr/bin/chromium")
    webgl: str = SOFTWARE


def main(options: Options) -> None:
    from playwright.sync_api import sync_playwright

    options.output.mkdir(parents=True, exist_ok=True)
    opened = open_any(options.run)
    method, cameras = opened.method(), opened.cameras()
    some = cameras.get("test", cameras["train"])
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=options.chromium, args=options.webgl.split())
        page, loading = visited(browser, options.page, SIZE, SIZE, 1)
        found = []
        for i in evenly(range(len(some)), options.views):
            found.append(compared(page, method, square(some[i]), options.output / f"{options.page.stem}-{i}.png"))
            print(found[-1], flush=True)
        turning, opening = {}, {}
        for name, window in WINDOWS.items():
            shown, first = visited(browser, options.page, *window)
            begin = time.perf_counter()
            shown.evaluate("lumigraph.rest()")
            opening[name] = [round(first, 2), round(first + time.perf_counter() - begin, 2)]
            shown.screenshot(path=options.output / f"{options.page.stem}-{name}.png")
            turning[name] = round(shown.evaluate(TURN, TURNED), 1)
            shown.close()
        browser.close()
    about = {"page": options.page.name, "megabytes": options.page.stat().st_size / 1e6, "seconds_to_open": loading}
    about |= {
        "frames_per_second": turning,
        "seconds_to_first_and_whole": opening,
        "program_kilobytes": programs(options),
    }
    write_json(options.output / f"{options.page.stem}.json", about | {"views": found})
    print(about)


def programs(options: Options) -> list[float]:
    """Kilobytes of the programs in the page, packed and unpacked."""
    found = re.search(r'<script id="program"[^>]*>([^<]*)<', options.page.read_text("utf-8"))
    assert found, f"{options.page} has no program"
    packed = base64.b64decode(found[1])
    return [round(len(data) / 1e3, 1) for data in (packed, gzip.decompress(packed))]


def visited(browser: Any, path: Path, width: int, height: int, density: int) -> tuple[Any, float]:
    """A page in a window of that size, ready, and how many seconds that took."""
    context = browser.new_context(
        viewport={"width": width, "height": height}, device_scale_factor=density, reduced_motion="reduce", offline=True
    )
    page, begin = context.new_page(), time.perf_counter()
    page.set_default_timeout(600_000)
    page.add_init_script(CLOCK)
    page.goto(path.resolve().as_uri())
    page.evaluate("lumigraph.ready")
    return page, time.perf_counter() - begin


def compared(page: Any, method: Any, camera: Camera, path: Path) -> dict[str, float]:
    page.add_style_tag(content=BARE)
    page.evaluate("spent = 0")
    page.evaluate("([pose, angle]) => lumigraph.setCamera(pose, angle)", [camera.pose[0].tolist(), ANGLE])
    spent = page.evaluate("spent")
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255
    begin = time.perf_counter()
    ours = method.render(camera).rgb.clamp(0, 1).cpu().numpy()
    taken = time.perf_counter() - begin
    beside = np.concatenate([shown, ours, (4 * np.abs(shown - ours)).clip(0, 1)], 1)
    Image.fromarray(np.round(255 * beside).astype(np.uint8)).save(path)
    psnr = -10 * math.log10(max(float(np.square(shown - ours).mean()), 1e-10))
    return {"psnr": round(psnr, 2), "milliseconds": round(spent, 1), "our_milliseconds": round(1000 * taken, 1)}


def square(camera: Camera) -> Camera:
    """A pinhole camera in the same place."""
    focal = SIZE / 2 / math.tan(math.radians(ANGLE) / 2)
    lens = Pinhole(torch.tensor([[focal, focal]]), torch.tensor([[SIZE / 2, SIZE / 2]]))
    return replace(camera.to("cpu"), lens=lens, size=torch.tensor([[SIZE, SIZE]]))


if __name__ == "__main__":
    main(tyro.cli(Options))
