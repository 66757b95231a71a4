"""The names of the tensors of each network, to detect unused and missing tensors of a checkpoint."""

NORM = ("weight", "bias", "running_mean", "running_var")
LINEAR = ("weight", "bias")
# V2X-ViT distinguishes vehicles from infrastructure.
AGENT_TYPES = 2


def of_network(detector, header):
    """All names that v2vloc reads, as the checkpoint has them."""
    names = set(of_detector(detector))
    fusion = header["fusion"]
    if "kind" in header:
        if fusion["communication"] and fusion["communication"]["smoothing"]:
            names |= set(below("fusion_net.naive_communication.gaussian_filter", LINEAR))
        return names
    of_fusion = FUSIONS.get(fusion["kind"])
    return names | set(below("fusion_net", of_fusion(fusion))) if of_fusion else names


def below(path, names):
    return [f"{path}.{name}" for name in names]


def of_detector(detector):
    pillar = "pillar_vfe.pfn_layers.0"
    names = [f"{pillar}.linear.weight", *below(f"{pillar}.norm", NORM)]
    channels = detector["pillar_channels"]
    for level, layers in enumerate(detector["layer_nums"]):
        filters, stride = detector["num_filters"][level], detector["layer_strides"][level]
        if detector["blocks"] == "residual":
            is_changed = stride != 1 or channels != filters
            names += below(f"backbone.resnet.layer{level}", residual(layers, is_changed))
        else:
            for layer in range(layers + 1):
                block = f"backbone.blocks.{level}"
                names += [f"{block}.{3 * layer + 1}.weight", *below(f"{block}.{3 * layer + 2}", NORM)]
        names += [f"backbone.deblocks.{level}.0.weight", *below(f"backbone.deblocks.{level}.1", NORM)]
        channels = filters
    if detector["shrink"]:
        names += [name for layer in (0, 2) for name in below(f"shrink_conv.layers.0.double_conv.{layer}", LINEAR)]
    if detector["compress_ratio"]:
        for conv, norm in [("encoder.0", "encoder.1"), ("decoder.0", "decoder.1"), ("decoder.3", "decoder.4")]:
            names += [*below(f"naive_compressor.{conv}", LINEAR), *below(f"naive_compressor.{norm}", NORM)]
    return names + below("cls_head", LINEAR) + below("reg_head", LINEAR)


def residual(layers, is_changed):
    for layer in range(layers):
        for half in (1, 2):
            yield f"{layer}.conv{half}.weight"
            yield from below(f"{layer}.bn{half}", NORM)
        if layer == 0 and is_changed:
            yield "0.downsample.0.weight"
            yield from below("0.downsample.1", NORM)


def v2vnet(fusion):
    names = below("msg_cnn", LINEAR) + below("mlp", LINEAR)
    for layer in range(fusion["gru_layers"]):
        names += [name for part in ("conv_gates", "conv_can") for name in below(f"conv_gru.cell_list.{layer}.{part}", LINEAR)]
    return names


def disconet(_fusion):
    layers = [name for layer in (1, 2, 3, 4) for name in below(f"pixel_weight_layer.conv1_{layer}", LINEAR)]
    return layers + [name for layer in (1, 2, 3) for name in below(f"pixel_weight_layer.bn1_{layer}", NORM)]


def v2xvit(fusion):
    names = []
    for depth in range(fusion["depth"]):
        layer = f"encoder.layers.{depth}"
        for block in range(fusion["blocks"]):
            part = f"{layer}.0.layers.{block}"
            names += below(f"{part}.0.norm", LINEAR) + below(f"{part}.1.norm", LINEAR)
            names += below(f"{part}.0.fn", ("relation_att", "relation_msg"))
            for kind in range(AGENT_TYPES):
                for linears in ("q_linears", "k_linears", "v_linears", "a_linears"):
                    names += below(f"{part}.0.fn.{linears}.{kind}", LINEAR)
            for window in range(len(fusion["windows"])):
                inner = ("to_qkv.weight", "pos_embedding", "to_out.0.weight", "to_out.0.bias")
                names += below(f"{part}.1.fn.pwmsa.{window}", inner)
            if fusion["merge"] == "split_attention":
                names += below(f"{part}.1.fn.split_attn", ("fc1.weight", "bn1.weight", "bn1.bias", "fc2.weight"))
        names += below(f"{layer}.1.norm", LINEAR) + below(f"{layer}.1.fn.net.0", LINEAR) + below(f"{layer}.1.fn.net.3", LINEAR)
    if fusion["temporal_encoding"]:
        names += below("encoder.rte.emb", ("emb.weight", "lin.weight", "lin.bias"))
    return names


def cobevt(fusion):
    names = below("mlp_head.2", LINEAR) + below("mlp_head.3", LINEAR)
    for layer in range(fusion["depth"]):
        for half in ("window", "grid"):
            attention, feed = f"layers.{layer}.{half}_attention", f"layers.{layer}.{half}_ffd"
            inner = ("relative_position_bias_table.weight", "to_qkv.weight", "to_out.0.weight")
            names += below(f"{attention}.norm", LINEAR) + below(f"{attention}.fn", inner)
            names += below(f"{feed}.norm", LINEAR) + below(f"{feed}.fn.net.0", LINEAR) + below(f"{feed}.fn.net.3", LINEAR)
    return names


FUSIONS = {"v2vnet": v2vnet, "disconet": disconet, "v2xvit": v2xvit, "cobevt": cobevt}
