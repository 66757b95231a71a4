#!/usr/bin/env python3
"""Turns a checkpoint of OpenCOOD, CoAlign or Where2comm into a weights file of v2vloc.

    deploy/tools/convert_opencood.py net_epoch60.pth --config config.yaml --out v2vnet.safetensors

The checkpoint is a state dictionary as those code bases save it (read with torch), or the same as a safetensors file
(read without). The configuration is the `config.yaml` that lies beside it, or JSON. What comes out is complete alone:
weights under the names that v2vloc uses, the sizes of detector and fusion in its header.

Models that are understood, by `model.core_method`:

    point_pillar                          method none
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

What to know before trusting the numbers:

* Those code bases measure in frames whose y axis points right, unlike v2vloc: the file says so (`y_axis`), and clouds and
  boxes are mirrored around the network. Real-world data sets (DAIR-V2X, V2V4Real) have y to the left: `--y-axis left`.
* Models with `proj_first: true` were trained on clouds brought to the ego's frame before they were encoded. An agent on
  the road cannot do that; its maps are turned instead, which such a network has not learnt to read.
* Converted weights move neighbours' maps with v2vloc's own warp, not that of the code base (multi-scale: CoAlign's).
* The direction head of CoAlign's models is left out: boxes may face backwards, which no overlap notices.
* Where2comm's threshold and window are settings of the sender, not weights: they are printed for `agent run`.
"""

import argparse
import json
import math
import struct
import sys
from pathlib import Path

FLOATS = {"F16": 2, "BF16": 2, "F32": 4, "F64": 8}
MULTI_SCALE_KIND = "multi_scale_detector"
# Points on the carrier itself are cut out by these code bases too: x and y of the lower, then of the upper corner.
OWN_BODY_M = [-1.95, -1.1, 2.95, 1.1]


class Refused(Exception):
    """The checkpoint or its configuration cannot be converted."""


def main():
    arguments = parse_arguments()
    try:
        state, metadata = read_state(arguments.checkpoint)
        hypes = read_config(arguments.config, metadata)
        name, model, preprocess = model_section(hypes, arguments.model)
        detector = detector_config(name, model, preprocess, state, arguments)
        header, renamed = fusion_part(name, model, state, detector)
        if "kind" in header and detector["compress_ratio"] is not None:
            if name != "point_pillar_where2comm":
                raise Refused(f"compression {detector['compress_ratio']} before the fusion of levels is not understood")
            # It computes the squeezed map and then goes on with others.
            detector["compress_ratio"] = None
        weights = select(state, renamed)
        header["config"] = detector
        header["source"] = f"{name}, {arguments.checkpoint.name}"
        write_safetensors(arguments.out, weights, header)
    except (Refused, OSError, KeyError, ValueError) as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else error
        print(f"{arguments.checkpoint}: {reason}", file=sys.stderr)
        return 2
    print(f"{arguments.out}: {len(weights)} tensors, {header.get('method', MULTI_SCALE_KIND)}")
    return 0


def parse_arguments():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", type=Path, help="state dictionary: .pth, or .safetensors")
    parser.add_argument("--config", type=Path, help="config.yaml or JSON; left out: the header of a safetensors file")
    parser.add_argument("--model", help="core_method, where the configuration holds the model's arguments alone")
    parser.add_argument("--out", type=Path, required=True, help="weights file to write")
    parser.add_argument("--y-axis", choices=["right", "left"], default="right", help="of the data it was trained on")
    parser.add_argument("--max-points", type=int, help="points of a pillar at most; left out: as preprocess says")
    return parser.parse_args()


def read_state(path):
    """Name -> (dtype, shape, little-endian bytes), and the header's texts."""
    if path.suffix == ".safetensors":
        return read_safetensors(path)
    try:
        import torch
    except ImportError as error:
        raise Refused("reading a .pth file needs torch; a .safetensors file does not") from error
    state = torch.load(path, map_location="cpu", weights_only=True)
    state = state.get("state_dict", state) if isinstance(state, dict) else state
    tensors = {}
    for name, tensor in state.items():
        if not tensor.is_floating_point():
            continue
        tensor = tensor.detach().to(torch.float32).contiguous()
        tensors[name.removeprefix("module.")] = ("F32", list(tensor.shape), tensor.numpy().tobytes())
    return tensors, {}


def read_safetensors(path):
    data = path.read_bytes()
    if len(data) < 8:
        raise Refused(f"{len(data)} bytes are no safetensors file")
    (length,) = struct.unpack("<Q", data[:8])
    if length > len(data) - 8:
        raise Refused(f"its header claims {length} of {len(data)} bytes")
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__", {})
    body = memoryview(data)[8 + length :]
    tensors = {}
    for name, entry in header.items():
        begin, end = entry["data_offsets"]
        if entry["dtype"] in FLOATS:
            tensors[name.removeprefix("module.")] = (entry["dtype"], entry["shape"], bytes(body[begin:end]))
    # Archives that hold more than weights have these under w.*.
    weights = {name[2:]: tensor for name, tensor in tensors.items() if name.startswith("w.")}
    return weights or tensors, metadata


def read_config(path, metadata):
    if path is None:
        if "config" not in metadata:
            raise Refused("a configuration is needed: --config")
        return json.loads(metadata["config"])
    if path.suffix == ".json":
        return json.loads(path.read_text())
    try:
        import yaml
    except ImportError as error:
        raise Refused("reading YAML needs PyYAML; JSON does not") from error

    class Loader(yaml.SafeLoader):
        pass

    # The files hold numpy scalars where their writer computed them; only their plain values matter here.
    Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)
    return yaml.load(path.read_text(), Loader=Loader)


def model_section(hypes, model):
    """Name of the model, its arguments, and how its clouds were made into pillars."""
    if "model" in hypes:
        section = hypes["model"]
        return model or section["core_method"], section["args"], hypes.get("preprocess", {}) | {
            "postprocess": hypes.get("postprocess", {})
        }
    if model is None:
        raise Refused("the configuration names no model: --model")
    return model, hypes, {}


def detector_config(name, model, preprocess, state, arguments):
    backbone = model.get("base_bev_backbone") or model.get("res_bev_backbone")
    if backbone is None:
        raise Refused(f"{name} has neither base_bev_backbone nor res_bev_backbone")
    of_pillars = preprocess.get("args", {})
    anchors = preprocess.get("postprocess", {}).get("anchor_args", {})
    pillar_channels = model["pillar_vfe"]["num_filters"]
    if len(pillar_channels) != 1:
        raise Refused(f"a pillar encoder of {len(pillar_channels)} layers; one is understood")
    if len(backbone["upsample_strides"]) != len(backbone["layer_nums"]):
        raise Refused("a backbone with a last up-sampling of all levels is not understood")
    if backbone.get("compression"):
        raise Refused("compression inside the backbone is not understood")
    max_pillars = of_pillars.get("max_voxel_test", 70000)
    residual = any(key.startswith("backbone.resnet.") for key in state)
    return {
        "name": name,
        "lidar_range_m": [float(edge) for edge in model["lidar_range"]],
        "voxel_size_m": [float(edge) for edge in model["voxel_size"]],
        "max_points_per_pillar": arguments.max_points or of_pillars.get("max_points_per_voxel", 32),
        "max_pillars": max_pillars,
        "pillar_channels": pillar_channels[0],
        "blocks": "residual" if residual else "plain",
        "y_axis": arguments.y_axis,
        "layer_nums": backbone["layer_nums"],
        "layer_strides": backbone["layer_strides"],
        "num_filters": backbone["num_filters"],
        "upsample_strides": backbone["upsample_strides"],
        "num_upsample_filters": backbone["num_upsample_filter"],
        "shrink": shrink_config(model.get("shrink_header")),
        "compress_ratio": model.get("compression") or None,
        "anchors": {
            "size_lwh_m": [float(anchors.get(edge, usual)) for edge, usual in [("l", 3.9), ("w", 1.6), ("h", 1.56)]],
            "center_z_m": -1.0,
            "yaws_deg": [float(yaw) for yaw in anchors.get("r", [0, 90])],
        },
        "own_body_m": OWN_BODY_M,
    }


def shrink_config(header):
    if header is None:
        return None
    if len(header["dim"]) != 1 or header["kernal_size"] != [3]:
        raise Refused(f"shrink_header {header} is not one pair of 3x3 convolutions")
    return {"kind": "double_conv", "channels": header["dim"][0], "stride": header["stride"][0]}


def fusion_part(name, model, state, detector):
    """Header entries of method and fusion, and the names that tensors change to."""
    channels = (detector["shrink"] or {}).get("channels", sum(detector["num_upsample_filters"]))
    fusion_method = model.get("fusion_method")
    if name == "point_pillar":
        return {"method": "none", "fusion": {"kind": "own"}}, {}
    if name == "point_pillar_v2vnet":
        return single_scale("v2vnet", v2vnet(model["v2vfusion"], channels))
    if name == "point_pillar_transformer":
        return single_scale("v2xvit", v2xvit(model["transformer"]["encoder"], channels))
    if name == "point_pillar_cobevt":
        return single_scale("cobevt", cobevt(model["fax_fusion"], channels))
    if name == "point_pillar_disconet" or (name == "point_pillar_baseline" and fusion_method == "disconet"):
        return single_scale("disconet", disconet(state, channels))
    if name == "point_pillar_baseline":
        if fusion_method == "v2vnet":
            return single_scale("v2vnet", v2vnet(model["v2vnet"], channels))
        plain = {"max": "max", "att": "attention"}
        if fusion_method in plain:
            return single_scale(plain[fusion_method], {"kind": plain[fusion_method]})
    if name == "point_pillar_where2comm":
        return where2comm(model)
    if name in ("point_pillar_coalign", "point_pillar_baseline_multiscale"):
        aggregation = {"max": "max", "att": "attention", None: "attention"}.get(fusion_method)
        if aggregation is not None:
            return multi_scale(aggregation, None, "neighbours", one_frame=False)
    if name == "point_pillar_intermediate":
        return multi_scale("attention", None, "neighbours", one_frame=True)
    raise Refused(f"model {name!r} with fusion {fusion_method!r} is not understood; see --help")


def single_scale(method, fusion):
    return {"method": method, "fusion": fusion}, {"fusion_net.": "fusion."}


def multi_scale(aggregation, communication, senders, one_frame):
    fusion = {
        "aggregation": aggregation,
        "communication": communication,
        "senders": senders,
        "one_frame": one_frame,
    }
    return {"kind": MULTI_SCALE_KIND, "fusion": fusion}, {}


def v2vnet(settings, channels):
    gru = settings["conv_gru"]
    (kernel, *others) = gru["kernel_size"]
    if any(edges != kernel for edges in others) or kernel[0] != kernel[1]:
        raise Refused(f"a GRU with kernels {gru['kernel_size']}; one square kernel is understood")
    return {
        "kind": "v2vnet",
        "channels": channels,
        "rounds": settings["num_iteration"],
        "aggregation": {"avg": "mean", "max": "max"}[settings["agg_operator"]],
        "gru_layers": gru["num_layers"] if settings["gru_flag"] else 0,
        "kernel": kernel[0],
    }


def v2xvit(encoder, channels):
    agents, windows = encoder["cav_att_config"], encoder["pwindow_att_config"]
    if not agents["use_hetero"] or not windows["relative_pos_embedding"]:
        raise Refused("V2X-ViT without use_hetero or relative_pos_embedding is not understood")
    sizes = zip(windows["window_size"], windows["heads"], windows["dim_head"])
    return {
        "kind": "v2xvit",
        "channels": channels,
        "depth": encoder["depth"],
        "blocks": encoder["num_blocks"],
        "agent_heads": agents["heads"],
        "agent_head_channels": agents["dim_head"],
        "windows": [{"edge": edge, "heads": heads, "head_channels": width} for edge, heads, width in sizes],
        "merge": {"naive": "naive", "split_attn": "split_attention"}[windows["fusion_method"]],
        "hidden": encoder["feed_forward"]["mlp_dim"],
        "temporal_encoding": bool(agents["use_RTE"]),
        "dropout": float(agents["dropout"]),
    }


def cobevt(settings, channels):
    if not settings["mask"]:
        raise Refused("CoBEVT without a mask is not understood")
    return {
        "kind": "cobevt",
        "channels": channels,
        "depth": settings["depth"],
        "slots": settings["agent_size"],
        "window": settings["window_size"],
        "head_channels": settings["dim_head"],
        "hidden": settings["mlp_dim"],
        # Its mean at the end counts empty slots too.
        "count_missing": True,
        "dropout": float(settings["drop_out"]),
    }


def disconet(state, channels):
    hidden = [state[f"fusion_net.pixel_weight_layer.conv1_{layer}.bias"][1][0] for layer in (1, 2, 3)]
    return {"kind": "disconet", "channels": channels, "hidden": hidden}


def where2comm(model):
    settings = model.get("where2comm_fusion") or model["fusion_args"]
    is_original = "where2comm_fusion" not in model
    mode = settings.get("agg_operator", {}).get("mode", "ATTEN")
    aggregation = {"ATTEN": "attention", "MAX": "max"}.get(mode)
    if aggregation is None:
        raise Refused(f"Where2comm with the operator {mode!r}; ATTEN and MAX are understood")
    communication = None if settings.get("fully") else settings.get("communication")
    if communication is not None:
        threshold = communication.get("threshold", communication.get("thre", 0))
        window = communication.get("gaussian_smooth")
        smoothing = window and {"kernel": window["k_size"], "sigma": float(window["c_sigma"])}
        window_text = f"{smoothing['kernel']},{smoothing['sigma']:g}" if smoothing else "none"
        # A threshold of zero lets everything pass.
        communication = {"threshold": float(threshold or -1), "smoothing": smoothing}
    if settings["multi_scale"]:
        senders = "every_second" if is_original else "neighbours"
        return multi_scale(aggregation, communication, senders, one_frame=not is_original)
    if communication is not None:
        print(f"senders: agent run --gate {communication['threshold']} --gate-smoothing {window_text}")
    return single_scale("where2comm", {"kind": "where2comm", "aggregation": aggregation, "missing": "zero"})


def select(state, renamed):
    """The weights under their new names, without those that nothing reads."""
    unused = ("dir_head.", "fusion.naive_communication.", "teacher.")
    weights = {}
    for name, tensor in state.items():
        for old, new in renamed.items():
            if name.startswith(old):
                name = new + name[len(old) :]
        check_finite(name, tensor)
        if not name.startswith(unused):
            weights[name] = tensor
    if not any(name.startswith("pillar_vfe.") for name in weights):
        raise Refused("no tensor of a pillar encoder: not a state dictionary of a PointPillars model")
    return weights


def check_finite(name, tensor):
    dtype, _, raw = tensor
    if dtype == "F32":
        for index, (value,) in enumerate(struct.iter_unpack("<f", raw)):
            if not math.isfinite(value):
                raise Refused(f"tensor {name} holds {value} at index {index}")


def write_safetensors(path, tensors, header):
    """Writes a file of the safetensors format: length of the header, header, data."""
    entries, offset = {}, 0
    for name in sorted(tensors):
        dtype, shape, raw = tensors[name]
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [offset, offset + len(raw)]}
        offset += len(raw)
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in header.items()}
    text = json.dumps({"__metadata__": texts} | entries).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        for name in sorted(tensors):
            file.write(tensors[name][2])


if __name__ == "__main__":
    sys.exit(main())
