#!/usr/bin/env python3
"""Camera picture: the images of all cameras of a frame, side by side, with the annotated boxes projected onto them.

    pip install pillow pyyaml
    deploy/tools/draw_cameras.py SCENARIO/AGENT/FRAME.yaml OUT.png

Reads the OPV2V layout: left-handed, x ahead, y right, z up, metres and degrees.
"""

import math
import sys
from pathlib import Path

import yaml
from PIL import Image, ImageDraw

EDGES = [(0, 1), (1, 3), (3, 2), (2, 0), (4, 5), (5, 7), (7, 6), (6, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
FARTHEST_M = 60.0
NEAREST_M = 0.3


def matrix(x, y, z, roll, yaw, pitch):
    """World from body, rows of a 4x4 matrix, as CARLA composes it."""
    cy, sy = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    cr, sr = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    cp, sp = math.cos(math.radians(pitch)), math.sin(math.radians(pitch))
    return [
        [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr, x],
        [sy * cp, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr, y],
        [sp, -cp * sr, cp * cr, z],
    ]


def into(pose, point):
    """A point of the world in the body's frame."""
    off = [point[axis] - pose[axis][3] for axis in range(3)]
    return [sum(pose[row][axis] * off[row] for row in range(3)) for axis in range(3)]


def out_of(pose, point):
    """A point of the body's frame in the world."""
    return [sum(pose[axis][row] * point[row] for row in range(3)) + pose[axis][3] for axis in range(3)]


def corners(vehicle):
    """Corners of an annotated box in the world."""
    roll, yaw, pitch = vehicle["angle"]
    centre = [vehicle["location"][axis] + vehicle["center"][axis] for axis in range(3)]
    pose = matrix(*centre, roll, yaw, pitch)
    half = vehicle["extent"]
    signs = [(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    return [out_of(pose, [sign[axis] * half[axis] for axis in range(3)]) for sign in signs]


def draw(image, camera, vehicles):
    """Draws every box that lies ahead of the camera."""
    pose = matrix(*camera["cords"])
    (fx, _, cx), (_, fy, cy), _ = camera["intrinsic"]
    pen = ImageDraw.Draw(image)
    drawn = 0
    for vehicle in vehicles.values():
        seen = [into(pose, corner) for corner in corners(vehicle)]
        if any(not NEAREST_M < corner[0] < FARTHEST_M for corner in seen):
            continue
        pixels = [(fx * y / x + cx, -fy * z / x + cy) for x, y, z in seen]
        drawn += any(0 <= u < image.width and 0 <= v < image.height for u, v in pixels)
        for start, end in EDGES:
            pen.line([pixels[start], pixels[end]], fill=(255, 176, 0), width=1)
    return drawn


def main(frame, out):
    frame = Path(frame)
    content = yaml.safe_load(frame.read_text())
    images = []
    for number in range(10):
        files = [frame.with_name(f"{frame.stem}_camera{number}.{ending}") for ending in ("png", "jpg", "jpeg")]
        file = next((file for file in files if file.is_file()), None)
        if file is None or f"camera{number}" not in content:
            continue
        image = Image.open(file).convert("RGB")
        count = draw(image, content[f"camera{number}"], content.get("vehicles") or {})
        print(f"{file.name}: {image.width} x {image.height}, {count} boxes in view")
        images.append(image)
    if not images:
        sys.exit(f"{frame}: no image of a camera beside it that it has the calibration of")
    columns = 2 if len(images) > 1 else 1
    rows = math.ceil(len(images) / columns)
    width, height = images[0].size
    picture = Image.new("RGB", (columns * width, rows * height))
    for place, image in enumerate(images):
        picture.paste(image, (place % columns * width, place // columns * height))
    picture.save(out, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
