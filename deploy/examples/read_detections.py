#!/usr/bin/env python3
"""Prints the detections of the ego of a running fleet, from one JSON message per frame.

    pip install eclipse-zenoh
    read_detections.py --connect tcp/127.0.0.1:7447 [--run RUN] [--count FRAMES]

Boxes are in the frame of the ego's LiDAR: x forward, y left, z up; metres and radians. `agent_frame` counts the
frames of the ego's own agent; a number left out is a frame that was never decided. `tick`, of the scene, is known to
the scorer alone, which writes it to detections.jsonl; capture times are the same everywhere.
"""
import argparse
import json

import zenoh

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--connect", default="tcp/127.0.0.1:7447", help="the router of the run")
parser.add_argument("--run", default="*", help="its name; all by default")
parser.add_argument("--count", type=int, default=0, help="end after so many frames; 0: never")
args = parser.parse_args()

config = zenoh.Config()
for key, value in {"mode": "client", "connect/endpoints": [args.connect], "scouting/multicast/enabled": False}.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config) as session:
    # Kept under a name: a subscriber without a reference ends.
    subscriber = session.declare_subscriber(f"v2v/{args.run}/*/detections/json")
    for number, sample in enumerate(subscriber, start=1):
        frame = json.loads(sample.payload.to_string())
        ages = ", ".join(f"{one['cav']} ({one['age_nanos'] / 1e6:.0f} ms old)" for one in frame["fused"])
        print(f"ego {frame['ego']} frame {frame['agent_frame']} at {frame['capture_nanos'] / 1e9:.1f} s,"
              f" {frame['method']}, with {ages or 'no neighbour'}:")
        for found in frame["detections"]:
            (x, y, z), (l, w, h) = found["box"]["center_m"], found["box"]["size_m"]
            print(f"  score {found['score']:.2f}  x {x:6.1f}  y {y:6.1f}  z {z:5.1f}  {l:.1f} x {w:.1f} x {h:.1f} m"
                  f"  heading {found['box']['heading_rad']:5.2f}", flush=True)
        if number == args.count:
            break
