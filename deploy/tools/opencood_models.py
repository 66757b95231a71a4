"""The models of the public code bases: their sizes, their fusion, the names of their tensors."""

from opencood_refused import Refused

MULTI_SCALE_KIND = "multi_scale_detector"
UNDERSTOOD = (
    "point_pillar", "point_pillar_v2vnet", "point_pillar_transformer", "point_pillar_cobevt", "point_pillar_disconet",
    "point_pillar_baseline", "point_pillar_where2comm", "point_pillar_coalign", "point_pillar_baseline_multiscale",
    "point_pillar_intermediate",
)  # fmt: skip
# Method that a network for one vehicle was trained for, by the beginning of `fusion.core_method`.
DATASET_METHODS = {"early": "early", "late": "late", "intermediate": "none"}
# Points on the carrier itself are cut out by these code bases too: x and y of the lower, then of the upper corner.
OWN_BODY_M = [-1.95, -1.1, 2.95, 1.1]


def check_understood(name, hypes):
    if name in UNDERSTOOD:
        return
    kind = " (a network of 3-D sparse convolutions)" if "second" in name or "voxel" in name else ""
    raise hypes.refuse("model.core_method", f"is {name!r}{kind}; understood are {', '.join(UNDERSTOOD)}")


def dataset_method(name, hypes):
    """The method of a network for one vehicle; all others fuse maps, independent of their training."""
    dataset = hypes.section("fusion", None)
    dataset = dataset and dataset.text("core_method", None)
    if dataset is None:
        return "none"
    for begin, method in DATASET_METHODS.items():
        if dataset.lower().startswith(begin):
            if name != "point_pillar" and begin != "intermediate":
                raise hypes.refuse("fusion.core_method", f"is {dataset!r}, but the model {name!r} fuses maps")
            return method
    raise hypes.refuse("fusion.core_method", f"is {dataset!r}, expected is a name that begins with Early, Late or Intermediate")


def detector_config(name, model, hypes, state, arguments):
    backbone = model.section("base_bev_backbone", None) or model.section("res_bev_backbone", None)
    if backbone is None:
        raise model.refuse("base_bev_backbone", "is missing, and res_bev_backbone too: no backbone of PointPillars")
    (pillar_channels, *more) = model.section("pillar_vfe").integers("num_filters")
    if more:
        raise model.refuse("pillar_vfe.num_filters", f"has {1 + len(more)} layers, understood is one")
    levels = {
        key: backbone.integers(key)
        for key in ("layer_nums", "layer_strides", "num_filters", "upsample_strides", "num_upsample_filter")
    }
    count = len(levels["layer_nums"])
    for key, values in levels.items():
        if len(values) != count:
            problem = f"has {len(values)} entries and layer_nums has {count}; one for each level is understood"
            raise backbone.refuse(key, problem)
    if backbone.get("compression", "a number", is_count, 0):
        raise backbone.refuse("compression", "is set; understood is compression after the backbone")
    preprocess = hypes.section("preprocess", None)
    pillars = preprocess and preprocess.section("args", None)
    max_points = arguments.max_points or (pillars.integer("max_points_per_voxel", 32) if pillars else 32)
    return {
        "name": name,
        "lidar_range_m": model.numbers("lidar_range", 6),
        "voxel_size_m": model.numbers("voxel_size", 3),
        "max_points_per_pillar": max_points,
        "max_pillars": pillars.integer("max_voxel_test", 70000) if pillars else 70000,
        "pillar_channels": pillar_channels,
        "blocks": "residual" if any(key.startswith("backbone.resnet.") for key in state) else "plain",
        "y_axis": arguments.y_axis,
        "layer_nums": levels["layer_nums"],
        "layer_strides": levels["layer_strides"],
        "num_filters": levels["num_filters"],
        "upsample_strides": levels["upsample_strides"],
        "num_upsample_filters": levels["num_upsample_filter"],
        "shrink": shrink_config(model.section("shrink_header", None)),
        "compress_ratio": int(model.get("compression", "a number of channels in one", is_count, 0)) or None,
        "anchors": anchors(hypes.section("postprocess", None)),
        "own_body_m": OWN_BODY_M,
    }


def is_count(value):
    return isinstance(value, int) and 0 <= value <= 4096


def anchors(postprocess):
    settings = postprocess and postprocess.section("anchor_args", None)
    usual = {"l": 3.9, "w": 1.6, "h": 1.56}
    return {
        "size_lwh_m": [settings.number(edge, size) if settings else size for edge, size in usual.items()],
        "center_z_m": -1.0,
        "yaws_deg": settings.numbers("r", default=[0, 90]) if settings else [0.0, 90.0],
    }


def shrink_config(header):
    if header is None:
        return None
    channels, kernels, strides = (header.integers(key) for key in ("dim", "kernal_size", "stride"))
    if len(channels) != 1 or kernels != [3]:
        raise header.refuse("dim", f"is {channels} with kernal_size {kernels}; understood is one pair of 3x3 convolutions")
    return {"kind": "double_conv", "channels": channels[0], "stride": strides[0]}


def feature_channels(detector):
    return (detector["shrink"] or {}).get("channels", sum(detector["num_upsample_filters"]))


def fusion_part(name, model, state, detector, own_method):
    """Header entries of method and fusion."""
    channels = feature_channels(detector)
    fusion_method = model.text("fusion_method", None)
    if name == "point_pillar":
        return {"method": own_method, "fusion": {"kind": "own"}}
    if name == "point_pillar_v2vnet":
        return single_scale("v2vnet", v2vnet(model.section("v2vfusion"), channels))
    if name == "point_pillar_transformer":
        return single_scale("v2xvit", v2xvit(model.section("transformer").section("encoder"), channels))
    if name == "point_pillar_cobevt":
        return single_scale("cobevt", cobevt(model.section("fax_fusion"), channels))
    if name == "point_pillar_disconet" or (name == "point_pillar_baseline" and fusion_method == "disconet"):
        return single_scale("disconet", disconet(model, state, channels))
    if name == "point_pillar_baseline":
        if fusion_method == "v2vnet":
            return single_scale("v2vnet", v2vnet(model.section("v2vnet"), channels))
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
    raise model.refuse("fusion_method", f"is {fusion_method!r}, which is not understood with the model {name!r}; see --help")


def single_scale(method, fusion):
    return {"method": method, "fusion": fusion}


def multi_scale(aggregation, communication, senders, one_frame):
    fusion = {
        "aggregation": aggregation,
        "communication": communication,
        "senders": senders,
        "one_frame": one_frame,
    }
    return {"kind": MULTI_SCALE_KIND, "fusion": fusion}


def v2vnet(settings, channels):
    gru = settings.section("conv_gru")
    is_square = lambda edges: isinstance(edges, list) and len(edges) == 2 and edges[0] == edges[1]  # noqa: E731
    is_one = lambda value: isinstance(value, list) and value and all(map(is_square, value)) and len({str(e) for e in value}) == 1  # noqa: E731, E501
    kernels = gru.get("kernel_size", "one square kernel", is_one)
    return {
        "kind": "v2vnet",
        "channels": channels,
        "rounds": settings.integer("num_iteration"),
        "aggregation": settings.choice("agg_operator", {"avg": "mean", "max": "max"}),
        "gru_layers": gru.integer("num_layers") if settings.flag("gru_flag") else 0,
        "kernel": kernels[0][0],
    }


def v2xvit(encoder, channels):
    agents, windows = encoder.section("cav_att_config"), encoder.section("pwindow_att_config")
    for section, key in [(agents, "use_hetero"), (windows, "relative_pos_embedding")]:
        if not section.flag(key):
            raise section.refuse(key, "is false, understood is true")
    sizes = zip(windows.integers("window_size"), windows.integers("heads"), windows.integers("dim_head"))
    return {
        "kind": "v2xvit",
        "channels": channels,
        "depth": encoder.integer("depth"),
        "blocks": encoder.integer("num_blocks"),
        "agent_heads": agents.integer("heads"),
        "agent_head_channels": agents.integer("dim_head"),
        "windows": [{"edge": edge, "heads": heads, "head_channels": width} for edge, heads, width in sizes],
        "merge": windows.choice("fusion_method", {"naive": "naive", "split_attn": "split_attention"}),
        "hidden": encoder.section("feed_forward").integer("mlp_dim"),
        "temporal_encoding": agents.flag("use_RTE"),
        "dropout": agents.number("dropout"),
    }


def cobevt(settings, channels):
    if not settings.flag("mask"):
        raise settings.refuse("mask", "is false, understood is CoBEVT with a mask")
    return {
        "kind": "cobevt",
        "channels": channels,
        "depth": settings.integer("depth"),
        "slots": settings.integer("agent_size"),
        "window": settings.integer("window_size"),
        "head_channels": settings.integer("dim_head"),
        "hidden": settings.integer("mlp_dim"),
        # Its mean at the end counts empty slots too.
        "count_missing": True,
        "dropout": settings.number("drop_out"),
    }


def disconet(model, state, channels):
    names = [f"fusion_net.pixel_weight_layer.conv1_{layer}.bias" for layer in (1, 2, 3)]
    missing = [name for name in names if len(state.get(name, ("", [], b""))[1]) != 1]
    if missing:
        raise Refused(f"{model.label} the model is DiscoNet, but the checkpoint has no tensor {missing[0]!r}")
    return {"kind": "disconet", "channels": channels, "hidden": [state[name][1][0] for name in names]}


def where2comm(model):
    is_original = not model.has("where2comm_fusion")
    settings = model.section("fusion_args" if is_original else "where2comm_fusion")
    operator = settings.section("agg_operator", None)
    choices = {"ATTEN": "attention", "MAX": "max"}
    aggregation = operator.choice("mode", choices, "ATTEN") if operator else "attention"
    communication = None if settings.flag("fully", False) else settings.section("communication", None)
    if communication is not None:
        threshold = communication.number("threshold", 0) or communication.number("thre", 0)
        window = communication.section("gaussian_smooth", None)
        smoothing = window and {"kernel": window.integer("k_size"), "sigma": window.number("c_sigma")}
        window_text = f"{smoothing['kernel']},{smoothing['sigma']:g}" if smoothing else "none"
        # A threshold of zero lets everything pass.
        communication = {"threshold": float(threshold or -1), "smoothing": smoothing}
    if settings.flag("multi_scale"):
        senders = "every_second" if is_original else "neighbours"
        return multi_scale(aggregation, communication, senders, one_frame=not is_original)
    if communication is not None:
        print(f"senders: agent run --gate {communication['threshold']},{window_text}")
    return single_scale("where2comm", {"kind": "where2comm", "aggregation": aggregation, "missing": "zero"})
