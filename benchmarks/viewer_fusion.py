"""The viewer in a headless Chromium while depth maps are fused: growth of the surface, and the longest stall.

    python benchmarks/viewer_fusion.py SCAN [--output fusing] [--chromium /usr/bin/chromium] [--voxel-size 0.006]

SCAN and --voxel-size are those of `lumigraph train tsdf-fusion`. Written: a strip of screenshots, the share of the
window that shows a surface in each, the longest time between two pictures that the browser received while frames were
fused, and the longest time in which the page itself did not draw.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image
from viewer_drag import browser

WINDOW = 640, 480
MIN_PICTURE = 2000  # bytes of a message that holds a picture
SHOTS_EVERY = 4.0  # seconds; a screenshot itself holds the page up
GAPS = """() => { window.longest = 0; let last = performance.now();
  const tick = now => {
    window.longest = Math.max(window.longest, now - last); last = now; requestAnimationFrame(tick); };
  requestAnimationFrame(tick); }"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scan")
    parser.add_argument("--output", type=Path, default=Path("fusing"))
    parser.add_argument("--chromium", type=Path, default=Path("/usr/bin/chromium"))
    parser.add_argument("--voxel-size", type=float, help="smaller: slower, so that more is seen of it")
    given = parser.parse_args()
    options = ["--voxel-size", str(given.voxel_size)] if given.voxel_size else []
    given.output.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as place, browser(given.chromium) as chromium:
        run = Path(place) / "run"
        command = [sys.executable, "-u", "-m", "lumigraph", "train", "tsdf-fusion", given.scan, *options]
        process = subprocess.Popen([*command, "--view", "--port", "8190", "--output", str(run)], stdout=subprocess.PIPE)
        assert process.stdout is not None
        address = None
        while address is None:
            line = process.stdout.readline().decode()
            assert line, "the command ended before its viewer began"
            found = re.search(r"http://[\d.]+:\d+", line)
            address = found and found[0]
        page = chromium.new_context(viewport={"width": WINDOW[0], "height": WINDOW[1]}).new_page()
        pictures: list[float] = []

        def listen(socket) -> None:
            socket.on("framereceived", lambda data: pictures.append(time.monotonic()) if len(data) > MIN_PICTURE else 0)

        page.on("websocket", listen)
        page.goto(address, timeout=120_000)
        page.evaluate(GAPS)
        shots, ended = [], None
        while ended is None or time.monotonic() < ended + 2 * SHOTS_EVERY:
            path = given.output / f"{len(shots):03d}.png"
            page.screenshot(path=str(path))
            shots.append(path)
            page.wait_for_timeout(1000 * SHOTS_EVERY)
            if ended is None and fused(run):
                ended = time.monotonic()
        process.terminate()
        process.wait()
        gaps = np.diff([t for t in pictures if t <= ended])
        shares = [surface_share(path) for path in shots]
        print("share of the window with a surface:", " ".join(f"{share:.2f}" for share in shares))
        print(f"pictures received: {len(pictures)}; longest time between two: {max(gaps, default=0):.2f} s")
        print(f"longest time in which the page did not draw: {page.evaluate('window.longest') / 1000:.2f} s")
    chosen = [Image.open(shots[i]) for i in np.linspace(0, len(shots) - 1, 6).astype(int)]
    strip = Image.new("RGB", (WINDOW[0] // 2 * len(chosen), WINDOW[1] // 2))
    for i, shot in enumerate(chosen):
        strip.paste(shot.resize((WINDOW[0] // 2, WINDOW[1] // 2)), (i * WINDOW[0] // 2, 0))
    strip.save(given.output / "strip.png")


def fused(run: Path) -> bool:
    """True after the last depth map, when the run's state is complete."""
    states = sorted((run / "checkpoints").glob("*/state.json"))
    complete = (run / "photographs.json").exists()  # written last
    return complete and bool(states) and json.loads(states[-1].read_text()).get("step", 0) > 0


def surface_share(path: Path) -> float:
    """Share of a screenshot's left three quarters, without the panel, that is not the colour of its corner."""
    picture = np.asarray(Image.open(path).convert("RGB"), np.int64)[:, : WINDOW[0] * 3 // 4]
    return float((np.abs(picture - picture[2, 2]).sum(-1) > 24).mean())


if __name__ == "__main__":
    main()
