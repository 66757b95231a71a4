"""A generated scene, and a fleet that has run over it while a listener followed."""
import concurrent.futures
import contextlib
import json
import os
import pathlib
import socket
import subprocess
from functools import cached_property

import v2vloc

PROGRAMS = pathlib.Path(os.environ["V2VLOC_PROGRAMS"])
ROOT = pathlib.Path(__file__).resolve().parents[3]
FRAMES = 8
#: Range of the released detector, metres in the LiDAR frame: x, y, z low, then high.
AREA_M = (-51.2, -38.4, -3.0, 51.2, 38.4, 1.0)
ENVIRONMENT = {**os.environ, "RAYON_NUM_THREADS": "1"}


def call(program: str, *options: object) -> str:
    """Standard output of a program that must succeed."""
    done = subprocess.run([PROGRAMS / program, *map(str, options)], capture_output=True, text=True, env=ENVIRONMENT)
    assert done.returncode == 0, f"{program}: exit code {done.returncode}\n{done.stderr}"
    return done.stdout


@contextlib.contextmanager
def background(program: str, *options: object):
    """A program that runs meanwhile."""
    command = [PROGRAMS / program, *map(str, options)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=ENVIRONMENT)
    try:
        yield
    finally:
        process.terminate()
        process.wait(10)


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Run:
    """Everything is made when a test first asks for it."""

    def __init__(self, work: pathlib.Path):
        self.work = work

    @cached_property
    def scene(self) -> pathlib.Path:
        folder = self.work / "scene"
        call("sim-replay", "synth", "--subset", "v2vdet", "--seed", 1000, "--scenes", 1, "--frames", FRAMES,
             "--period-s", 0.1, "--vehicles", 2, "--out", folder)
        return folder

    @cached_property
    def live(self) -> list[v2vloc.Frame]:
        """Frames of a fleet that answers every tick, as they arrived."""
        endpoint = free_endpoint()
        # Lockstep waits for those who compute: the rate leaves time to the recorder and the two listeners.
        settings = ("scene.lockstep=true", "scene.rate=0.4", "agents.pose=recorded", f"network.listen={endpoint}")
        command = [PROGRAMS / "v2vloc", "up", ROOT / "deploy/scenarios/demo.yaml", "--dataset", self.scene, "--name", "fleet",
                   "--runs", self.work / "runs", "--method", "max", "--record", "--json"]
        command += [word for setting in settings for word in ("--set", setting)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT) as fleet:
            try:
                # Two listeners, in two threads; a frame waits for its last message on a busy machine too.
                with concurrent.futures.ThreadPoolExecutor() as pool:
                    streams = ["lidar", "descriptor", "bev", "truth", "stats"]
                    others = v2vloc.listen(endpoint, run="fleet", timeout_s=60, streams=streams)
                    messages = pool.submit(lambda: list(others.messages()))
                    with v2vloc.listen(endpoint, run="fleet", timeout_s=60, settle_s=3) as listener:
                        frames = list(listener)
                        self.listener = listener
                        self.counts = listener.counts
                    self.messages = messages.result()
                    others.close()
            finally:
                output, errors = fleet.communicate(timeout=60)
        assert fleet.returncode == 0, errors
        self.metrics = json.loads(output)
        return frames

    @cached_property
    def recording(self) -> v2vloc.DataSet:
        assert self.live
        return v2vloc.read(self.work / "runs/fleet")
