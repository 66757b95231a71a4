"""Training samples of a fusion in PyTorch: maps on the ego's grid, and the detection loss of what a fusion makes of them.

Reads a data set, the maps that `v2vloc eval --feature-maps DIR` kept of it, and a weights file. Maps are turned and warped as
v2vloc does before it calls a fusion; targets and loss are those of `ego-fuser train`.
"""
import json
import pathlib
import struct

import numpy as np
import torch
import v2vloc
from safetensors import safe_open
from torch import Tensor
from torch.nn import functional as F

# An anchor with more overlap is an object.
POSITIVE_IOU = 0.6


class KeptMaps:
    """Maps of a file of `--maps`: of each scenario, each agent, each tick, a length and a message of the wire format."""

    def __init__(self, file: pathlib.Path):
        self.data = np.memmap(file, mode="r")
        self.starts = []
        start = 0
        while start + 4 <= len(self.data):
            self.starts.append(start)
            start += 4 + self.length(start)

    def length(self, start: int) -> int:
        return struct.unpack("<I", self.data[start:start + 4].tobytes())[0]

    def __len__(self) -> int:
        return len(self.starts)

    def __getitem__(self, index: int) -> v2vloc.Bev:
        start = self.starts[index]
        return v2vloc.decode("bev", self.data[start + 4:start + 4 + self.length(start)].tobytes()).payload


class Samples:
    """Frames of a data set by number: features, mask, poses, confidence and age as a fusion gets them, and the labels.

    Neighbours that are absent, or beyond `range_m` of the ego, take no part.
    """

    def __init__(self, dataset: pathlib.Path, maps: pathlib.Path, weights: pathlib.Path, range_m: float = 70.0):
        scene = v2vloc.read(dataset, points=False)
        self.agents, self.frames = scene.agents, list(scene)
        self.maps, self.range_m = KeptMaps(maps), range_m
        # Number of the first map of each frame's scenario, tick within it, and ticks of it.
        self.place: list[tuple[int, int, int]] = []
        first = 0
        while len(self.place) < len(self.frames):
            source = self.frames[len(self.place)].source
            ticks = sum(other.source == source for other in self.frames)
            self.place += [(first, tick, ticks) for tick in range(ticks)]
            first += len(self.agents[source]) * ticks
        if first != len(self.maps):
            raise SystemExit(f"{maps}: {len(self.maps)} maps, but {dataset} has {first} sweeps: maps of other data?")
        self.head = Head(weights, self.maps[0])

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> tuple[tuple[Tensor, ...], "Labels"]:
        frame, (first, tick, ticks) = self.frames[index], self.place[index]
        agents = self.agents[frame.source]
        ego_from_world = np.linalg.inv(frame.agents[agents[0]].world_from_lidar)
        maps, planar = [], []
        # The file has a place for each agent of the scenario, empty where it is absent.
        for number, cav in enumerate(agents):
            index = first + number * ticks + tick
            if cav not in frame.agents or self.maps.length(self.maps.starts[index]) == 0:
                continue
            ego_from_cav = ego_from_world @ frame.agents[cav].world_from_lidar
            x, y, yaw = ego_from_cav[0, 3], ego_from_cav[1, 3], np.arctan2(ego_from_cav[1, 0], ego_from_cav[0, 0])
            if np.hypot(x, y) <= self.range_m:
                bev = torch.from_numpy(self.maps[index].features)
                maps.append(self.head.align(bev, x, y, yaw) if number else (bev, torch.ones_like(bev[:1])))
                planar.append([x, y, yaw])
        features, mask = (torch.stack(parts) for parts in zip(*maps))
        inputs = features, mask, torch.tensor(planar).float(), torch.ones(len(maps)), torch.zeros(len(maps))
        return inputs, Labels(self.head, frame.ground_truth(area_m=self.head.area_m).boxes)


class Head:
    """What a weights file has around the fusion: the turning of channels before it, the detection head after it."""

    def __init__(self, weights: pathlib.Path, bev: v2vloc.Bev):
        with safe_open(weights, "pt") as file:
            self.steering, self.cls_weight, self.reg_weight, self.cls_bias, self.reg_bias = (
                file.get_tensor(name).float()
                for name in ("steering.weight", "cls_head.weight", "reg_head.weight", "cls_head.bias", "reg_head.bias"))
            config = json.loads(file.metadata()["config"])
        self.area_m = config["lidar_range_m"]
        _, rows, columns = bev.features.shape
        self.half_m = np.array([columns, rows]) * bev.cell_m / 2
        self.middle_m = np.array([bev.x_min_m, bev.y_min_m]) + self.half_m
        # Anchors [H * W * A, 7]: x, y, z, dx, dy, dz, heading.
        x = bev.x_min_m + (np.arange(columns) + 0.5) * bev.cell_m
        y = bev.y_min_m + (np.arange(rows) + 0.5) * bev.cell_m
        yaws = np.radians(config["anchors"]["yaws_deg"])
        y, x, yaw = (grid.ravel() for grid in np.meshgrid(y, x, yaws, indexing="ij"))
        z = np.full_like(x, config["anchors"]["center_z_m"])
        size = np.tile(config["anchors"]["size_lwh_m"], (len(x), 1))
        self.anchors = np.column_stack([x, y, z, size, yaw])

    def align(self, features: Tensor, x: float, y: float, yaw: float) -> tuple[Tensor, Tensor]:
        """Map [C, H, W] of a neighbour on the ego's grid, and its mask [1, H, W]."""
        basis = torch.tensor([1, np.cos(yaw), np.sin(yaw), np.cos(2 * yaw), np.sin(2 * yaw)]).float()
        change = torch.einsum("k,kij->ij", basis, self.steering)
        turned = (features + torch.einsum("ij,jhw->ihw", change, features)).relu()
        # From the ego's grid, -1 to 1 over its extent, to that of the neighbour.
        cav_from_ego = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        offset = (cav_from_ego @ (self.middle_m - (x, y)) - self.middle_m) / self.half_m
        scale = cav_from_ego * self.half_m / self.half_m[:, None]
        theta = torch.tensor(np.column_stack([scale, offset])).float()[None]
        grid = F.affine_grid(theta, [1, *features.shape], align_corners=False)
        mask = F.grid_sample(torch.ones_like(features[None, :1]), grid, mode="nearest", align_corners=False)[0]
        return F.grid_sample(turned[None], grid, align_corners=False)[0] * mask, mask

    def loss(self, fused: Tensor, labels: "Labels") -> Tensor:
        """Focal loss of the scores and smooth L1 of the boxes that the head gives for a fused map [C, H, W]."""
        flat = lambda map, size: map[0].permute(1, 2, 0).reshape(-1, size)  # [H * W * A, size]
        scores = flat(F.conv2d(fused[None], self.cls_weight, self.cls_bias), 1)[:, 0]
        boxes = flat(F.conv2d(fused[None], self.reg_weight, self.reg_bias), 7)[labels.index]
        target = torch.zeros_like(scores)
        target[labels.index] = 1
        wrong = (target - scores.sigmoid()).abs()
        balance = torch.where(target == 1, 0.25, 0.75)
        score = balance * wrong**2 * F.binary_cross_entropy_with_logits(scores, target, reduction="none")
        off = boxes - labels.code
        off = torch.cat([off[:, :6], off[:, 6:].sin()], 1)
        box = F.smooth_l1_loss(off, torch.zeros_like(off), reduction="sum", beta=1 / 9)
        return (score.sum() + 2 * box) / max(len(labels.index), 1)


class Labels:
    """Positive anchors of a frame: `index` [P] and regression targets `code` [P, 7]."""

    def __init__(self, head: Head, boxes: np.ndarray):
        anchors = head.anchors
        iou = np.stack([overlap(anchors, box) for box in boxes] or [np.zeros(len(anchors))])
        owner = np.where(iou.max(0) > POSITIVE_IOU, iou.argmax(0), -1)
        for number, best in enumerate(iou.argmax(1)):
            if iou[number, best] > 0 and owner[best] < 0:
                owner[best] = number
        index = np.flatnonzero(owner >= 0)
        box, anchor = boxes[owner[index]], anchors[index]
        diagonal, height = np.hypot(anchor[:, 3], anchor[:, 4]), anchor[:, 5]
        code = [(box[:, 0] - anchor[:, 0]) / diagonal, (box[:, 1] - anchor[:, 1]) / diagonal,
                (box[:, 2] - anchor[:, 2]) / height,
                *(np.log(box[:, axis] / anchor[:, axis]) for axis in (5, 4, 3)), box[:, 6] - anchor[:, 6]]
        self.index = torch.from_numpy(index)
        self.code = torch.from_numpy(np.column_stack(code)).float()


def overlap(anchors: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Overlap of the upright rectangles around footprints, each a metre longer and wider, as OpenCOOD computes it."""
    low, high = zip(*(extent(boxes) for boxes in (anchors, box[None])))
    side = lambda low, high: np.maximum(high - low + 1, 0)
    common = side(np.maximum(*low), np.minimum(*high)).prod(1)
    areas = [side(*corners).prod(1) for corners in zip(low, high)]
    return common / (areas[0] + areas[1] - common)


def extent(boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner [N, 2] of the upright rectangles around footprints."""
    cos, sin = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    half = np.column_stack([cos * boxes[:, 3] + sin * boxes[:, 4], sin * boxes[:, 3] + cos * boxes[:, 4]]) / 2
    return boxes[:, :2] - half, boxes[:, :2] + half
