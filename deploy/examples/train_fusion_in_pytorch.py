#!/usr/bin/env python3
"""Trains a fusion in PyTorch on maps that v2vloc kept, and writes it as a TorchScript file that v2vloc runs.

    v2vloc eval --dataset SCENES --weights deploy/weights/lean-max.safetensors --method max --dtype f16 --feature-maps maps
    train_fusion_in_pytorch.py --dataset SCENES --feature-maps maps/*.maps --weights deploy/weights/lean-max.safetensors trained.pt
    v2vloc eval --dataset OTHER_SCENES --weights deploy/weights --method script:trained.pt max

Encoder and detection head stay as they are; only the fusion between them is trained. It needs torch, safetensors and the
wheel of v2vloc (protocol/python).
"""
import argparse
import math
import pathlib
import random
import time

import torch
from torch import Tensor, nn

from training_samples import Samples


class WeightedFusion(nn.Module):
    """The maximum over the agents, corrected by a mean in which each agent has a weight per cell.

    The weight comes from the ego's and the agent's features and the confidence of the agent's pose. The correction is
    zero before training: then the module is `max`.
    """

    def __init__(self, channels: int = 64):
        super().__init__()
        self.weight = nn.Sequential(nn.Conv2d(2 * channels, 32, 1), nn.ReLU(), nn.Conv2d(32, 1, 3, padding=1))
        self.correct = nn.Sequential(
            nn.Conv2d(2 * channels, channels, 1), nn.ReLU(), nn.Conv2d(channels, channels, 3, padding=1))
        nn.init.zeros_(self.correct[2].weight)
        nn.init.zeros_(self.correct[2].bias)

    def forward(self, features: Tensor, mask: Tensor, ego_from_cav: Tensor, confidence: Tensor, age_s: Tensor) -> Tensor:
        pairs = torch.cat([features[:1].expand_as(features), features], 1)
        weight = self.weight(pairs)[:, 0] + confidence.clamp(min=1e-3).log()[:, None, None]
        weight = weight.masked_fill(mask[:, 0] == 0, float("-inf")).softmax(0)
        mean = (features * weight[:, None]).sum(0)
        maximum = features.amax(0)
        return (maximum + self.correct(torch.cat([maximum, mean])[None])[0]).relu()


def without_some(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """The same frame with each neighbour missing in one of ten."""
    kept = [0] + [agent for agent in range(1, len(inputs[0])) if random.random() > 0.1]
    return tuple(tensor[kept] for tensor in inputs)


def mean_loss(fusion: nn.Module, samples: Samples, frames: list[int]) -> float:
    with torch.no_grad():
        losses = [float(samples.head.loss(fusion(*inputs), labels)) for inputs, labels in map(samples.__getitem__, frames)]
    return sum(losses) / len(losses)


def train(fusion: nn.Module, samples: Samples, frames: list[int], minutes: float) -> int:
    """Trains for some minutes of one CPU with a falling learning rate; the number of steps, two frames each."""
    optimizer = torch.optim.AdamW(fusion.parameters(), lr=1e-3, weight_decay=1e-2)
    start, steps, total = time.process_time(), 0, 0.0
    while (share := (time.process_time() - start) / (60 * minutes)) < 1:
        for group in optimizer.param_groups:
            group["lr"] = 1e-3 * min(1, (steps + 1) / 50) * (1 + math.cos(math.pi * share)) / 2
        optimizer.zero_grad()
        for inputs, labels in map(samples.__getitem__, random.sample(frames, 2)):
            loss = samples.head.loss(fusion(*without_some(inputs)), labels) / 2
            loss.backward()
            total += float(loss.detach())
        optimizer.step()
        steps += 1
        if steps % 100 == 0:
            print(f"step {steps}, {share:.0%} of the time: loss {total / 100:.3f}", flush=True)
            total = 0.0
    return steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", type=pathlib.Path, required=True, help="data set of the maps")
    parser.add_argument("--feature-maps", type=pathlib.Path, required=True, help="file of kept maps, .maps")
    parser.add_argument("--weights", type=pathlib.Path, required=True, help="weights that made the maps, .safetensors")
    parser.add_argument("--minutes", type=float, default=15, help="CPU time of the training [default: 15]")
    parser.add_argument("file", help="file to write, .pt")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    random.seed(0)
    samples = Samples(arguments.dataset, arguments.feature_maps, arguments.weights)
    # The last tenth, whole scenes, is held out.
    frames = list(range(len(samples)))
    training, held_out = frames[:len(frames) * 9 // 10], frames[len(frames) * 9 // 10:]
    fusion = WeightedFusion(samples.maps[0].features.shape[0])
    print(f"{len(training)} frames to train, {len(held_out)} held out: loss {mean_loss(fusion, samples, held_out):.3f} as max", flush=True)
    steps = train(fusion, samples, training, arguments.minutes)
    print(f"{steps} steps: loss {mean_loss(fusion, samples, held_out):.3f} of the frames held out")
    torch.jit.script(fusion.eval()).save(arguments.file)


if __name__ == "__main__":
    main()
