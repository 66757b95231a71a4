#!/usr/bin/env python3
"""Localizes generated sweeps with map-closures, a public method of place recognition in bird's-eye views, for comparison.

    pip install map-closures==2.2.0 numpy
    deploy/tools/compare_map_closures.py DRIVE QUERIES

A reference is a local map of the drive every 5 m: its sweeps within `--merge-m`, by their true poses. A query is one sweep,
as a vehicle that has just started has no more. It gets the pose of its best reference, times the motion between the two that
map-closures finds; queries without one do not count as found. Prints the share of poses under 3 m and 1 m, the median error of
those under 3 m, the number of wrong ones and the time of a query.
"""
import argparse
import pathlib
import re
import time

import numpy as np
from map_closures.config import MapClosuresConfig
from map_closures.map_closures import MapClosures

SPACING_M = 5.0
VOXEL_M = 0.5
WRONG_M = 3.0
# Poses that the method itself accepts have at least so many inliers.
INLIERS = MapClosuresConfig().inliers_threshold


def cloud(path: pathlib.Path) -> np.ndarray:
    """Points of a file of four floats each, as sim-replay writes them: one in each voxel, `[N, 3]` in metres."""
    data = path.read_bytes()
    start = data.index(b"DATA binary\n") + len(b"DATA binary\n")
    points = np.frombuffer(data[start:], dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    _, kept = np.unique(np.floor(points / VOXEL_M).astype(np.int64), axis=0, return_index=True)
    return points[kept]


def pose(path: pathlib.Path) -> np.ndarray:
    """World from LiDAR, `[4, 4]`: x, y, z (metres), roll, yaw, pitch (degrees), of which roll and pitch are small."""
    numbers = re.search(r"^lidar_pose:\n((?:- .*\n){6})", path.read_text(), re.MULTILINE)[1]
    x, y, z, _, yaw, _ = (float(line[2:]) for line in numbers.splitlines())
    world_from_lidar = np.eye(4)
    cos, sin = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    world_from_lidar[:2, :2] = [[cos, -sin], [sin, cos]]
    world_from_lidar[:3, 3] = x, y, z
    return world_from_lidar


def sweeps(folder: pathlib.Path) -> list[tuple[pathlib.Path, np.ndarray]]:
    """Clouds of a data set and their poses, drive by drive in the order of time."""
    clouds = sorted(path for path in folder.glob("*/*/*.pcd") if "radar" not in path.name)
    return [(path, pose(path.with_suffix(".yaml"))) for path in clouds]


def merged(near: list[tuple[pathlib.Path, np.ndarray]], world_from_reference: np.ndarray) -> np.ndarray:
    """Points of several sweeps in the frame of one, `[N, 3]` in metres, one in each voxel."""
    reference_from_world = np.linalg.inv(world_from_reference)
    moved = []
    for path, world_from_sweep in near:
        motion = reference_from_world @ world_from_sweep
        moved.append(cloud(path) @ motion[:3, :3].T + motion[:3, 3])
    points = np.concatenate(moved)
    _, kept = np.unique(np.floor(points / VOXEL_M).astype(np.int64), axis=0, return_index=True)
    return points[kept]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drive", type=pathlib.Path, help="data set of the references")
    parser.add_argument("queries", type=pathlib.Path, help="data set of the sweeps to localize")
    parser.add_argument("--merge-m", type=float, default=0.0, help="radius of a local map, metres; 0: one sweep")
    args = parser.parse_args()
    closures, references = MapClosures(), []
    drive = sweeps(args.drive)
    for path, world_from_reference in drive:
        here = world_from_reference[:2, 3]
        if references and np.linalg.norm(here - references[-1][:2, 3]) < SPACING_M:
            continue
        near = [one for one in drive if np.linalg.norm(one[1][:2, 3] - here) < args.merge_m]
        closures.get_best_closure(len(references), merged(near, world_from_reference) if near else cloud(path))
        references.append(world_from_reference)
    errors, seconds = [], []
    queries = sweeps(args.queries)
    for index, (path, truth) in enumerate(queries):
        points, began = cloud(path), time.perf_counter()
        found = closures.get_top_k_closures(len(references) + index, points, 10)
        seconds.append(time.perf_counter() - began)
        known = [one for one in found if one.source_id < len(references) and one.number_of_inliers >= INLIERS]
        if known:
            best = max(known, key=lambda one: one.number_of_inliers)
            world_from_query = references[best.source_id] @ np.linalg.inv(best.pose)
            errors.append(np.linalg.norm((world_from_query - truth)[:2, 3]))
    errors = np.array(errors)
    right = errors[errors < WRONG_M]
    median = np.median(right) if len(right) else np.nan
    print(f"{len(references)} references, {len(queries)} queries: {len(right) / len(queries):.0%} under 3 m, "
          f"{np.sum(errors < 1) / len(queries):.0%} under 1 m, median {median:.3f} m, {len(errors) - len(right)} wrong, "
          f"{np.median(seconds):.2f} s")


if __name__ == "__main__":
    main()
