#!/usr/bin/env python3
"""Draws the pictures of the page in monitor.md: a frame of a recorded run, or a live run after some seconds.

    v2vloc up deploy/scenarios/demo.yaml --dataset scenes/v2vdet-1000-2x60 --method pastat --rate 0.35 --record --name pictures
    deploy/tools/picture_view.py runs/pictures deploy/results/view-live.png --seconds 4     # while it runs
    deploy/tools/picture_view.py runs/pictures deploy/results/view-recorded.png --at 30     # afterwards

Beside the pictures it writes the digest of the page, which check_results compares: a page that has changed since needs
new pictures. Needs Chromium.
"""
import argparse
import base64
import os
import pathlib
import re
import subprocess
import tempfile

import chromium
import page_digest

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROGRAMS = pathlib.Path(os.environ.get("CARGO_TARGET_DIR") or ROOT / "target").resolve() / "release"
# Window of the page, CSS pixels.
WINDOW = (1280, 860)
# The page draws nothing more: two redraws later the canvas shows it.
REDRAWN = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of a run")
    parser.add_argument("out", type=pathlib.Path, help="file to write, .png")
    when = parser.add_mutually_exclusive_group(required=True)
    when.add_argument("--at", type=int, help="frame of a recorded run")
    when.add_argument("--seconds", type=float, help="time that the page of a live run is open before it is drawn")
    return parser.parse_args()


def picture(address: str, options) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        browser = chromium.Chromium(pathlib.Path(folder))
        tab = chromium.Tab(browser, *WINDOW)
        if options.at is None:
            tab.open(address)
            tab.wait("false", options.seconds)
        else:
            tab.open(f"{address}#at={options.at}")
            tab.wait(f"tape.at === {options.at} && !tape.busy")
        tab.value(REDRAWN)
        png = base64.b64decode(tab.call("Page.captureScreenshot")["data"])
        browser.close()
    return png


def main():
    options = arguments()
    view = subprocess.Popen([PROGRAMS / "v2vloc", "view", options.run, "--page", "127.0.0.1:0"], stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True)
    try:
        address = next(match[0] for match in (re.search(r"http://[^\s#]+", line) for line in view.stdout) if match)
        options.out.write_bytes(picture(address, options))
    finally:
        view.terminate()
    page_digest.write(options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
