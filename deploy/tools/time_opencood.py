#!/usr/bin/env python3
"""Times OpenCOOD's own fusions at their published sizes, for comparison with `cargo bench -p fusion --bench transformers`.

    deploy/tools/time_opencood.py OPENCOOD [--threads 2] [--times 5] [v2xvit/5 cobevt/2 ...]

OPENCOOD is a clone of the public repository; it needs torch, einops, numpy, matplotlib and PyYAML and must be fetched by the
user, as its licence asks for. Maps are those of the bench: 256 channels on 48 x 176 cells, without the encoder and the heads.
The number behind the name are the slots. There are as many agents as slots; with fewer agents the reference computes as
long, because it fills its five slots always. Prints the fastest and the median of some calls.
"""

import argparse
import pathlib
import statistics
import sys
import time

CHANNELS, ROWS, COLUMNS = 256, 48, 176


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("opencood", type=pathlib.Path)
    parser.add_argument("cases", nargs="*", default=["v2xvit/2", "v2xvit/5", "cobevt/2", "cobevt/5", "attention/5"])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--times", type=int, default=5)
    return parser.parse_intermixed_args()


def model_settings(opencood, name):
    """Model part of a published configuration; numbers like 1e-10 are read as texts and do not matter here."""
    import yaml

    path = opencood / "opencood" / "hypes_yaml" / f"{name}.yaml"
    if not path.exists():
        sys.exit(f"{path}: not there; is {opencood} a clone of OpenCOOD?")
    return yaml.safe_load(path.read_text())["model"]["args"]


def v2xvit(opencood, slots):
    import torch
    from opencood.models.fuse_modules.v2xvit_basic import V2XTransformer

    fusion = V2XTransformer(model_settings(opencood, "point_pillar_v2xvit")["transformer"]).eval()
    maps = torch.rand(1, slots, ROWS, COLUMNS, CHANNELS + 3)
    maps[..., CHANNELS:] = 0.0  # speed, delay, infrastructure: vehicles without delay
    moved = torch.eye(4).repeat(1, slots, 1, 1)
    return lambda: fusion(maps, torch.ones(1, slots), moved)


def cobevt(opencood, slots):
    import torch
    from opencood.models.fuse_modules.swap_fusion_modules import SwapFusionEncoder

    settings = {**model_settings(opencood, "point_pillar_cobevt")["fax_fusion"], "agent_size": slots}
    fusion = SwapFusionEncoder(settings).eval()
    maps, mask = torch.rand(1, slots, CHANNELS, ROWS, COLUMNS), torch.ones(1, ROWS, COLUMNS, 1, slots)
    return lambda: fusion(maps, mask)


def attention(_opencood, slots):
    import torch
    from opencood.models.fuse_modules.self_attn import AttFusion

    fusion = AttFusion(CHANNELS).eval()
    maps = torch.rand(slots, CHANNELS, ROWS, COLUMNS)
    return lambda: fusion(maps, torch.tensor([slots]))


def main():
    asked = arguments()
    sys.path.insert(0, str(asked.opencood))
    import torch

    torch.set_num_threads(asked.threads)
    torch.manual_seed(0)
    makers = {"v2xvit": v2xvit, "cobevt": cobevt, "attention": attention}
    for case in asked.cases:
        name, _, slots = case.partition("/")
        if name not in makers or not slots.isdigit():
            sys.exit(f"{case}: not one of {', '.join(makers)} with a number of slots behind it, as in v2xvit/5")
        fuse = makers[name](asked.opencood, int(slots))
        taken = []
        with torch.no_grad():
            fuse()
            for _ in range(asked.times):
                began = time.perf_counter()
                fuse()
                taken.append(time.perf_counter() - began)
        print(f"{case}: {min(taken):.3f} s at best, {statistics.median(taken):.3f} s median of {len(taken)}", flush=True)


if __name__ == "__main__":
    main()
