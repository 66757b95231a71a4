#!/usr/bin/env python3
"""Measures the cost of an open page for a run: the same fleet repeatedly, with and without a reader of the page's stream.

    cargo build --release --workspace --bins
    deploy/tools/page_cost.py [--rounds 4] [--frames 150] [--method max] [--dataset DIR]

A round is a run with and one without, in alternating order, so that other load of the machine affects both. The reader
reads and discards every frame, as a browser on another machine would; the server of the page runs on this one. Where Linux
allows it the reader computes only on idle processor time, since on another machine it would use none of this one's.
Prints the 95th percentile of the latency from capture to detection of every run, of both sides pooled, and their ratio.
"""

import argparse
import csv
import http.client
import os
import pathlib
import re
import signal
import subprocess
import sys
import tempfile
import threading

ROOT = pathlib.Path(__file__).resolve().parents[2]
PROGRAMS = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release"


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--method", default="max")
    parser.add_argument("--scenario", help="left out: recorded poses and all defaults, for which two cores suffice")
    parser.add_argument("--dataset", help="data set, split or scenario; left out: two vehicles are generated")
    return parser.parse_args()


def generate(folder, frames):
    """Two vehicles of seed 1000, as in the demo."""
    command = [PROGRAMS / "sim-replay", "synth", "--out", folder, "--subset", "v2vdet", "--seed", "1000"]
    subprocess.run([*command, "--frames", str(frames), "--vehicles", "2"], check=True, stdout=subprocess.DEVNULL)
    return folder


def scenario(folder, scene):
    """Without localization, which takes most of the time of an agent."""
    file = folder / "scenario.yaml"
    file.write_text(f"scene: {{dir: {scene}}}\nmodels: {{weights: {ROOT / 'deploy/weights'}}}\nagents: {{pose: recorded}}\n")
    return file


def line_with(stream, pattern):
    """The first match among the lines of a process; the rest is read and discarded, so that the process never blocks."""
    for line in stream:
        if match := re.search(pattern, line):
            threading.Thread(target=lambda: all(stream), daemon=True).start()
            return match
    sys.exit(f"no line with {pattern!r}: it ended")


class Page:
    """A viewer, and a reader of its stream."""

    def __init__(self, name, router):
        command = [PROGRAMS / "v2vloc", "view", "--run", name, "--connect", router, "--page", "127.0.0.1:0"]
        self.viewer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.address = line_with(self.viewer.stderr, r"http://([\d.:]+)/")[1]
        self.moments = 0
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def read(self):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))  # of this thread
        connection = http.client.HTTPConnection(self.address)
        connection.request("GET", "/live")
        answer = connection.getresponse()
        try:
            while len(length := answer.read(4)) == 4:
                moment = answer.read(int.from_bytes(length, "little"))
                self.moments += bool(moment)
        except (http.client.HTTPException, OSError):
            pass

    def close(self):
        self.viewer.send_signal(signal.SIGINT)
        self.viewer.wait()
        self.reader.join()


def run(options, scene, folder, name, with_page):
    """Latencies of one run, and the number of frames that the page received."""
    command = [PROGRAMS / "v2vloc", "up", options.scenario, "--dataset", scene, "--method", options.method]
    command += ["--frames", str(options.frames), "--name", name, "--runs", folder, "--json"]
    fleet = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    router = line_with(fleet.stderr, rf"run {name} at (\S+):")[1]
    page = Page(name, router) if with_page else None
    code = fleet.wait()
    if page:
        page.close()
    # 3: a machine too slow for live traffic drops frames and reports it.
    if code not in (0, 3):
        sys.exit(f"the run {name} ended with {code}")
    with open(folder / name / "frames.csv") as frames:
        latencies = [float(row["latency_ms"]) for row in csv.DictReader(frames) if row["latency_ms"]]
    return latencies, page.moments if page else 0


def p95(latencies):
    ordered = sorted(latencies)
    return ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1)))]


def main():
    options = arguments()
    with tempfile.TemporaryDirectory() as work:
        work = pathlib.Path(work)
        scene = pathlib.Path(options.dataset).resolve() if options.scene else generate(work / "scene", options.frames)
        options.scenario = options.scenario or scenario(work, scene)
        run(options, scene, work, "warm-up", False)
        pooled = {False: [], True: []}
        for index in range(options.rounds):
            for with_page in [False, True] if index % 2 == 0 else [True, False]:
                name = f"round{index}-{'page' if with_page else 'alone'}"
                latencies, moments = run(options, scene, work, name, with_page)
                pooled[with_page] += latencies
                shown = f", {moments} moments shown" if with_page else ""
                print(f"{name}: p95 {p95(latencies):.1f} ms of {len(latencies)} frames{shown}", flush=True)
        alone, page = p95(pooled[False]), p95(pooled[True])
        print(f"all: p95 {alone:.1f} ms without a page, {page:.1f} ms with it, ratio {page / alone:.3f}")


if __name__ == "__main__":
    main()
