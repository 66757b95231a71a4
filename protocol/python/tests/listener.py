"""A live fleet, and runs that are not there."""
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import v2vloc

from data_set import refuses
from fleet import AREA_M, FRAMES, background, call, free_endpoint

WAITS = """
import signal, sys, v2vloc
# A process that a shell has started in the background ignores Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)
listener = v2vloc.listen(sys.argv[1], run="empty", timeout_s=None)
print("listening", flush=True)
next(listener)
"""


def test_a_live_fleet_is_followed(run):
    frames = run.live
    assert len(frames) == FRAMES, frames
    assert [frame.tick for frame in frames] == list(range(FRAMES))
    assert run.counts["messages"] > 0 and not any(run.counts[name] for name in run.counts if name != "messages"), run.counts
    for frame in frames:
        assert frame.source == "fleet" and len(frame.agents) == 2, frame
        for agent in frame.agents.values():
            assert agent.pose.world_from_cav.shape == (4, 4) and 0 <= agent.pose.confidence <= 1
            channels, height, width = agent.bev.features.shape
            assert agent.bev.features.dtype == np.float32 and min(channels, height, width) > 1
            assert np.isclose(agent.bev.x_min_m, AREA_M[0]) and agent.bev.payload_bytes > 0
            np.testing.assert_array_equal(agent.bev.pose.world_from_cav, agent.pose.world_from_cav)
            assert len(agent.objects) > 0 and agent.world_from_lidar is not None
        found = frame.detections[frame.ego]
        assert found.method == "max" and found.boxes.shape == (len(found.scores), 7)
        assert {one["cav"] for one in found.fused} == set(frame.agents) - {frame.ego}
        assert "detections of 1" in repr(frame), repr(frame)
        tracks = frame.tracks[frame.ego]
        count = len(tracks)
        assert (tracks.cav, tracks.agent_frame, tracks.left_out) == (frame.ego, found.agent_frame, 0)
        assert tracks.boxes.shape == (count, 7) and tracks.velocities_mps.shape == (count, 2)
        assert tracks.covariances.shape == (count, 4, 4) and tracks.scores.shape == (count,)
        assert (np.diff(tracks.ids) > 0).all() and (tracks.unseen_s <= tracks.ages_s).all() and (tracks.hits > 0).all()
    last = frames[-1].tracks[frames[-1].ego]
    assert last.hits.max() >= FRAMES // 2 and (last.unseen_s == 0).any(), last


def test_a_closed_listener_ends(run):
    assert run.live and next(run.listener, None) is None
    assert "closed" in repr(run.listener)


def test_what_is_not_there_is_named(run):
    endpoint = free_endpoint()
    refuses(lambda: v2vloc.listen(endpoint, run="fleet", timeout_s=0.5), f"no router at {endpoint}")
    refuses(lambda: v2vloc.listen("127.0.0.1", run="fleet"), "is not an endpoint")
    refuses(lambda: v2vloc.listen(endpoint), "give the name of the run")
    refuses(lambda: v2vloc.listen(endpoint, run="*"), "*")
    refuses(lambda: v2vloc.listen(endpoint, run="fleet", streams=["sonar"]), "streams: \"sonar\"")
    refuses(lambda: v2vloc.listen(endpoint, run="fleet", credentials=run.work), "ca.pem")


def test_a_certificate_permits_its_streams(run):
    keys, endpoint = run.work / "keys", free_endpoint().replace("tcp/", "quic/")
    call("v2vloc", "keys", "--out", keys, "--agents", "1000", "--egos", "1000", "--hosts", "127.0.0.1")
    refuses(lambda: v2vloc.listen(endpoint, run="secure", credentials=keys / "viewer", streams=["lidar"]),
            "a certificate of viewer does not permit \"lidar\"")
    with background("v2vloc", "router", "--listen", endpoint, "--keys", keys / "router"):
        v2vloc.listen(endpoint, run="secure", credentials=keys / "viewer", streams=["camera/3"], timeout_s=30).close()
        listener = v2vloc.listen(endpoint, run="secure", credentials=keys / "recorder", timeout_s=30)
        call("sim-replay", "stream", run.scene, "--run", "secure", "--connect", endpoint, "--keys", keys / "replay",
             "--frames", 2, "--await-agents=false")
        with listener:
            assert [list(frame.agents) for frame in listener] == [list(v2vloc.read(run.scene)[0].agents)] * 2


def test_losses_are_counted_after_the_end_too(run):
    endpoint = free_endpoint()
    with background("v2vloc", "router", "--listen", endpoint):
        with v2vloc.listen(endpoint, run="fast", timeout_s=30) as listener:
            # More than 64 messages of a topic, of which none is taken.
            for _ in range(64 // FRAMES + 1):
                call("sim-replay", "stream", run.scene, "--run", "fast", "--connect", endpoint, "--rate", 0, "--await-agents=false")
            inside = listener.counts
    assert inside["overwritten"] > 0 and listener.counts == inside, (inside, listener.counts)


def test_a_silent_run_ends_and_ctrl_c_interrupts(run):
    endpoint = free_endpoint()
    with background("v2vloc", "router", "--listen", endpoint):
        v2vloc.listen(endpoint, run="empty").close()  # the router is there
        counted = other_thread_counts(lambda: refuses(
            lambda: next(v2vloc.listen(endpoint, run="empty", timeout_s=1)), "no message of run \"empty\""))
        assert counted > 20, f"another thread ran {counted} times"
        waiting = subprocess.Popen([sys.executable, "-c", WAITS, endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert waiting.stdout.readline() == b"listening\n"
        time.sleep(0.3)
        began = time.monotonic()
        os.kill(waiting.pid, signal.SIGINT)
        _, errors = waiting.communicate(timeout=10)
        assert b"KeyboardInterrupt" in errors and time.monotonic() - began < 5, errors


def other_thread_counts(action) -> int:
    """Steps of a Python thread, 10 ms each, while `action` waits."""
    is_over, steps = threading.Event(), []

    def count():
        while not is_over.wait(0.01):
            steps.append(None)

    thread = threading.Thread(target=count)
    thread.start()
    try:
        action()
    finally:
        is_over.set()
        thread.join()
    return len(steps)
