#!/usr/bin/env python3
"""Converts a checkpoint of OpenCOOD, CoAlign or Where2comm into a weights file of v2vloc.

    deploy/tools/convert_opencood.py net_epoch60.pth --config config.yaml --out v2vnet.safetensors

The checkpoint is a state dictionary as those code bases save it, alone or in a training checkpoint
(`model_state_dict`, `state_dict`, `model`, `net`), a whole pickled model, or a safetensors file. It is read without torch,
and nothing in it is run. The configuration is the `config.yaml` that lies beside it (PyYAML reads it), or JSON. What comes
out is complete alone: weights under the names that v2vloc uses, the sizes of detector and fusion in its header.

Models that are understood, by `model.core_method`:

    point_pillar                          method none; early or late, according to `fusion.core_method`
    point_pillar_v2vnet                   method v2vnet
    point_pillar_transformer              method v2xvit
    point_pillar_cobevt                   method cobevt
    point_pillar_disconet                 method disconet
    point_pillar_baseline                 methods max, attention, v2vnet and disconet, by `fusion_method`
    point_pillar_where2comm               method where2comm; with multi_scale: a multi-scale network
    point_pillar_coalign,
    point_pillar_baseline_multiscale,
    point_pillar_intermediate             a multi-scale network

A multi-scale network fuses at every level of its backbone. An agent on the road sends one map, so such a file runs
offline only (`ego_fuser::multi_scale`); all others run in `v2vloc up` too.

Every tensor is used or named: one that the network does not have, or that it has and the checkpoint lacks, is an error.
`--leave-out PREFIX` leaves out what is known to be of no use.

What to know before trusting the numbers:

* Those code bases measure in frames whose y axis points right, unlike v2vloc: the file states it (`y_axis`), and clouds and
  boxes are mirrored around the network. Real-world data sets (DAIR-V2X, V2V4Real) have y to the left: `--y-axis left`.
* Models with `proj_first: true` were trained on clouds brought to the ego's frame before they were encoded. An agent on
  the road cannot do that; its maps are turned instead, which such a network has not learnt to read.
* Converted weights move neighbours' maps with v2vloc's own warp, not that of the code base (multi-scale: CoAlign's).
* With `compression`, the compressed map is transmitted: one channel in so many.
* The direction head of CoAlign's models is left out: boxes may face backwards, which no overlap notices.
* Where2comm's threshold and window are settings of the sender, not weights: they are printed for `agent run`.
"""

import argparse
import array
import math
import sys
from pathlib import Path

import opencood_names
from opencood_checkpoint import read_checkpoint
from opencood_config import read_config
from opencood_models import (
    MULTI_SCALE_KIND, check_understood, dataset_method, detector_config, feature_channels, fusion_part,
)  # fmt: skip
from opencood_refused import FLOATS, Refused
from safetensors_file import write_safetensors

# Tensors that a network of v2vloc does not use, by the end or the beginning of their names.
UNUSED_ENDS = ("num_batches_tracked", "relative_position_index", "relative_indices")
UNUSED_BEGINNINGS = ("dir_head.", "teacher.", "fusion_net.naive_communication.", "fusion_net.encoder.prior_feed.")
# Largest number of names in a message.
SHOWN = 8
EXPECTED = "expected is the state dictionary of the configured model, as torch.save(model.state_dict(), path) writes it"
# Bits of the exponent, which are all set where a value is no finite number.
EXPONENTS = {"F16": 0x7C00, "BF16": 0x7F80}


def main():
    arguments = parse_arguments()
    try:
        report = convert(arguments)
    except Refused as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    except OSError as error:
        print(f"{error.filename or arguments.checkpoint}: {error.strerror or error}", file=sys.stderr)
        return 2
    print(report)
    return 0


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="state dictionary: .pth, or .safetensors")
    parser.add_argument("--config", type=Path, help="config.yaml or JSON; left out: the header of a safetensors file")
    parser.add_argument("--model", help="core_method, where the configuration holds the model's arguments alone")
    parser.add_argument("--out", type=Path, required=True, help="weights file to write")
    parser.add_argument("--y-axis", choices=["right", "left"], default="right", help="of the data it was trained on")
    parser.add_argument("--max-points", type=int, help="largest number of points of a pillar; left out: that of preprocess")
    parser.add_argument(
        "--leave-out", nargs="+", default=[], metavar="PREFIX", help="tensors that the network does not use"
    )
    return parser.parse_args()


def convert(arguments):
    """Writes the weights file; returns a summary of a few lines."""
    state, metadata, taken_from = read_checkpoint(arguments.checkpoint)
    hypes = read_config(arguments.config, arguments.checkpoint, metadata)
    name, model = model_section(hypes, arguments.model)
    own_method = dataset_method(name, hypes)
    detector = detector_config(name, model, hypes, state, arguments)
    header = fusion_part(name, model, state, detector, own_method)
    unused = [*UNUSED_BEGINNINGS, *arguments.leave_out]
    if "kind" in header and detector["compress_ratio"] is not None:
        if name != "point_pillar_where2comm":
            raise model.refuse("compression", f"is {detector['compress_ratio']}, which is not understood before a fusion of levels")
        # It computes the compressed map and does not use it.
        detector["compress_ratio"] = None
        unused.append("naive_compressor.")
    label = f"{arguments.checkpoint}, {taken_from}" if taken_from else f"{arguments.checkpoint}"
    weights, left_out = select(label, state, opencood_names.of_network(detector, header), unused)
    header["config"] = detector
    header["source"] = f"{name}, {arguments.checkpoint.name}"
    write_safetensors(arguments.out, weights, header)
    return report(arguments.out, weights, header, left_out, taken_from)


def report(path, weights, header, left_out, taken_from):
    lines = [f"{path}: {len(weights)} tensors, {header.get('method', MULTI_SCALE_KIND)}"]
    if taken_from:
        lines.append(f"read out of {taken_from}")
    if left_out:
        lines.append(f"left out: {listed(left_out)}")
    detector = header["config"]
    if detector["compress_ratio"]:
        channels = feature_channels(detector)
        sent = max(channels // detector["compress_ratio"], 1)
        lines.append(f"compressed maps are transmitted: {sent} of {channels} channels")
    return "\n".join(lines)


def listed(names):
    """Names; all batch counters form one entry."""
    counters = [name for name in names if name.endswith("num_batches_tracked")]
    others = [name for name in names if name not in counters]
    shown = others[:SHOWN] + ([f"{len(others) - SHOWN} more"] if len(others) > SHOWN else [])
    return ", ".join(shown + ([f"{len(counters)} num_batches_tracked"] if counters else []))


def model_section(hypes, model):
    """Name of the model and its arguments."""
    if "model" in hypes.values:
        section = hypes.section("model")
        name, arguments = model or section.text("core_method"), section.section("args")
    elif model is None:
        raise hypes.refuse("model", "is missing, and no --model names the model of these arguments")
    else:
        name, arguments = model, hypes
    check_understood(name, hypes)
    return name, arguments


def select(label, state, wanted, unused):
    """The weights under their new names, and the names of unused ones."""
    if not any(name.startswith("pillar_vfe.") for name in state):
        names = listed(sorted(state)) or "none"
        raise Refused(f"{label}: no tensor of a pillar encoder (pillar_vfe.*) among {names}; {EXPECTED}")
    of_no_use = lambda name: name.startswith(tuple(unused)) or name.endswith(UNUSED_ENDS)  # noqa: E731
    left_out = [name for name in sorted(state) if name not in wanted and of_no_use(name)]
    unknown = sorted(set(state) - wanted - set(left_out))
    missing = sorted(wanted - set(state))
    if missing:
        also = f"; it has {listed(unknown)} instead" if unknown else ""
        raise Refused(f"{label}: {len(missing)} of {len(wanted)} tensors are missing: {listed(missing)}{also}; {EXPECTED}")
    if unknown:
        advice = "--leave-out PREFIX leaves out what is known to be of no use"
        raise Refused(f"{label}: {len(unknown)} tensors that the configured network does not have: {listed(unknown)}; {advice}")
    weights = {}
    for name in sorted(wanted):
        check_values(label, name, state[name])
        weights[name.replace("fusion_net.", "fusion.", 1) if is_single_scale(name) else name] = state[name]
    return weights, left_out


def is_single_scale(name):
    """True if a tensor is of the fusion of one map, which has another name in v2vloc."""
    return name.startswith("fusion_net.") and not name.startswith("fusion_net.naive_communication.")


def check_values(label, name, tensor):
    dtype, _, raw = tensor
    if dtype not in FLOATS:
        raise Refused(f"{label}: tensor {name!r} is of type {dtype}, expected is one of {', '.join(FLOATS)}")
    if dtype in EXPONENTS:
        finite = [value & EXPONENTS[dtype] != EXPONENTS[dtype] for value in array.array("H", raw)]
    else:
        finite = list(map(math.isfinite, array.array("f" if dtype == "F32" else "d", raw)))
    if not all(finite):
        raise Refused(f"{label}: tensor {name!r} holds no finite number at index {finite.index(False)}")


if __name__ == "__main__":
    sys.exit(main())
