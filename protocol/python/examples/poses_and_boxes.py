"""Poses and boxes of a recorded run (poses_and_boxes.py RUN-FOLDER) or of a live one (... ENDPOINT RUN)."""
import sys

import v2vloc

frames = v2vloc.read(sys.argv[1]) if len(sys.argv) == 2 else v2vloc.listen(sys.argv[1], run=sys.argv[2])
for frame in frames:
    for cav, agent in frame.agents.items():
        print(f"t={frame.capture_time_ns / 1e9:.1f} s  {cav}: {agent.pose}, feature map {agent.bev}")
    for ego, found in frame.detections.items():
        print(f"  ego {ego}: {len(found)} boxes of {len(frame.ground_truth(ego))} objects, best {found.scores[:3]}")
