#!/usr/bin/env python3
"""Makes the animation of README: the page of `v2vloc view` on a recorded run, as an animated WebP.

    v2vloc up deploy/scenarios/demo.yaml --dataset scenes/v2vdet-1000-2x60 --method pastat --set scene.lockstep=true --record --name animation
    deploy/tools/animate_view.py runs/animation deploy/results/demo.webp      # needs Chromium and Pillow

`--every 2` takes every second frame of the run. The animation has the speed of the run.
"""
import argparse
import base64
import io
import os
import pathlib
import re
import subprocess
import tempfile

from PIL import Image

import chromium
import page_digest

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROGRAMS = pathlib.Path(os.environ.get("CARGO_TARGET_DIR") or ROOT / "target").resolve() / "release"
# Window of the page, CSS pixels; pictures are WIDTH pixels wide.
WINDOW = (1000, 640)
WIDTH = 900
# Times belong to the machine; the rest is what README has no room for.
HIDDEN = """#timeline, .tools, aside, .facts div:has(#latency), .facts div:has(#answered) { display: none !important }
    main { grid-template-columns: 1fr !important }"""


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of a recorded run")
    parser.add_argument("out", type=pathlib.Path, help="file to write, .webp")
    parser.add_argument("--every", type=int, default=1, help="frames of the run for one of the animation [default: 1]")
    parser.add_argument("--quality", type=int, default=60, help="of the WebP, 0 to 100 [default: 60]")
    return parser.parse_args()


def pictures(address: str, every: int) -> tuple[list[Image.Image], float]:
    """A picture of each frame, and the time from one to the next, seconds."""
    with tempfile.TemporaryDirectory() as folder:
        browser = chromium.Chromium(pathlib.Path(folder))
        tab = chromium.Tab(browser, *WINDOW)
        tab.open(address)
        tab.wait("tape.at === 0")
        tab.value(f"document.head.append(element('style', {{}}, {HIDDEN!r}))")
        times = tab.value("tape.timeline.map((moment) => moment.capture_s)")
        found = []
        for at in range(0, len(times), every):
            tab.value(f"seek({at})")
            tab.wait(f"tape.at === {at} && !tape.busy")
            # Two redraws later the canvas shows it.
            tab.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
            png = base64.b64decode(tab.call("Page.captureScreenshot")["data"])
            picture = Image.open(io.BytesIO(png)).convert("RGB")
            found.append(picture.resize((WIDTH, round(WIDTH * picture.height / picture.width)), Image.Resampling.LANCZOS))
        browser.close()
    return found, (times[-1] - times[0]) / (len(times) - 1) * every


def main():
    options = arguments()
    view = subprocess.Popen([PROGRAMS / "v2vloc", "view", options.run, "--page", "127.0.0.1:0"], stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True)
    try:
        address = next(match[0] for match in (re.search(r"http://\S+", line) for line in view.stdout) if match)
        frames, period_s = pictures(address, options.every)
    finally:
        view.terminate()
    frames[0].save(options.out, save_all=True, append_images=frames[1:], duration=round(1000 * period_s), loop=0,
                   quality=options.quality, method=6)
    page_digest.write(options.out)
    print(f"{options.out}: {len(frames)} frames, {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
