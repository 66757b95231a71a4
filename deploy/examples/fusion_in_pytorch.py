#!/usr/bin/env python3
"""Writes a fusion method in PyTorch as a TorchScript file that v2vloc runs, live, offline and in sweeps.

    pip install torch
    fusion_in_pytorch.py attention.pt
    v2vloc eval --dataset SCENES --method script:attention.pt attention

The module of this example is AttFuse (OPV2V): the ego attends to all agents at each BEV cell. It gives the AP of the
built-in method `attention`.
"""
import argparse

import torch
from torch import Tensor, nn


class AttentionFusion(nn.Module):
    """Scaled dot-product attention of the ego over the agents, at each cell, without projections."""

    def forward(self, features: Tensor, mask: Tensor, ego_from_cav: Tensor, confidence: Tensor, age_s: Tensor) -> Tensor:
        """Fuses the maps of N agents on the ego's grid, the ego's first.

        features      [N, C, H, W]  BEV feature maps, float32
        mask          [N, 1, H, W]  1 where an agent has sent a cell; 1 everywhere for the ego
        ego_from_cav  [N, 3]        x and y of the sender in the frame of the ego, metres; heading, radians
        confidence    [N]           confidence of the sender's pose, 0..1
        age_s         [N]           age of the map, seconds
        returns       [C, H, W]     the fused map
        """
        scores = (features * features[:1]).sum(1) / features.shape[1] ** 0.5
        scores = scores.masked_fill(mask[:, 0] == 0, float("-inf"))
        return (features * scores.softmax(0)[:, None]).sum(0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="file to write, .pt")
    torch.jit.script(AttentionFusion().eval()).save(parser.parse_args().file)
