#!/usr/bin/env python3
"""Tests of convert_opencood.py on checkpoints made here, byte by byte as torch writes them; torch is not needed.

    deploy/tools/test_convert_opencood.py
"""

import array
import contextlib
import importlib.util
import io
import json
import pickle
import random
import struct
import sys
import tempfile
import types
import unittest
import zipfile
from collections import OrderedDict
from pathlib import Path

import convert_opencood
import opencood_names
from opencood_checkpoint import read_checkpoint
from torch_file import LEGACY_MAGIC

HAS_YAML = importlib.util.find_spec("yaml") is not None


def stand_in(module, name, made=None):
    """An object that a pickle names `module.name`."""
    made = made or type(name, (), {})
    made.__module__, made.__qualname__, made.__name__ = module, name, name
    package = ""
    for part in module.split("."):
        package = f"{package}.{part}".lstrip(".")
        sys.modules.setdefault(package, types.ModuleType(package))
    setattr(sys.modules[module], name, made)
    return made


STORAGES = {"f": stand_in("torch", "FloatStorage"), "q": stand_in("torch", "LongStorage")}
REBUILD = stand_in("torch._utils", "_rebuild_tensor_v2", lambda *_arguments: None)
PARAMETER = stand_in("torch._utils", "_rebuild_parameter", lambda *_arguments: None)
LINEAR = stand_in("torch.nn.modules.linear", "Linear")
MODEL = stand_in("opencood.models.point_pillar", "PointPillar")


class Tensor:
    """A tensor of one code of `array`, or a view of a longer one."""

    def __init__(self, values, size, code="f", stride=None, offset=0):
        self.values, self.size, self.offset = array.array(code, values), tuple(size), offset
        usual = [1] * len(size)
        for axis in range(len(size) - 2, -1, -1):
            usual[axis] = usual[axis + 1] * size[axis + 1]
        self.stride = tuple(stride or usual)

    def __reduce__(self):
        return REBUILD, (Storage(self.values), self.offset, self.size, self.stride, False, OrderedDict())


class Storage:
    def __init__(self, values):
        self.values = values


class Pickler(pickle.Pickler):
    def __init__(self, file, view):
        super().__init__(file, protocol=2)
        self.view, self.storages = view, []

    def persistent_id(self, item):
        if not isinstance(item, Storage):
            return None
        self.storages.append(item.values)
        return "storage", STORAGES[item.values.typecode], str(len(self.storages) - 1), "cpu", len(item.values), *self.view


def pickled(item, view=()):
    file = io.BytesIO()
    pickler = Pickler(file, view)
    pickler.dump(item)
    return file.getvalue(), pickler.storages


def archive(item):
    """The bytes that torch.save writes."""
    text, storages = pickled(item)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as out:
        out.writestr("net/data.pkl", text)
        out.writestr("net/byteorder", "little")
        for key, values in enumerate(storages):
            out.writestr(f"net/data/{key}", values.tobytes())
        out.writestr("net/version", "3\n")
    return file.getvalue()


def legacy(item):
    """The bytes that torch.save wrote before version 1.6."""
    text, storages = pickled(item, view=(None,))
    heads = [LEGACY_MAGIC, 1001, {"little_endian": True}]
    keys = pickle.dumps([str(key) for key in range(len(storages))], protocol=2)
    return b"".join(
        [*(pickle.dumps(head, protocol=2) for head in heads), text, keys]
        + [struct.pack("<q", len(values)) + values.tobytes() for values in storages]
    )


def hypes(model="point_pillar", dataset=None, **more):
    args = {
        "voxel_size": [0.4, 0.4, 4], "lidar_range": [-12.8, -6.4, -3, 12.8, 6.4, 1],
        "pillar_vfe": {"num_filters": [8]},
        "base_bev_backbone": {
            "layer_nums": [1, 1], "layer_strides": [2, 2], "num_filters": [8, 8], "upsample_strides": [1, 2],
            "num_upsample_filter": [8, 8],
        },
        "shrink_header": {"kernal_size": [3], "stride": [2], "padding": [1], "dim": [16], "input_dim": 16},
    }  # fmt: skip
    config = {"model": {"core_method": model, "args": args | more}, "preprocess": {}, "postprocess": {}}
    return config | ({"fusion": {"core_method": dataset, "args": []}} if dataset else {})


DETECTOR = {
    "pillar_channels": 8, "layer_nums": [1, 1], "layer_strides": [2, 2], "num_filters": [8, 8], "blocks": "plain",
    "shrink": {"channels": 16}, "compress_ratio": None,
}  # fmt: skip


def state(**detector):
    """One number for each tensor of the network."""
    names = sorted(opencood_names.of_detector(DETECTOR | detector))
    counter = {"backbone.blocks.0.2.num_batches_tracked": Tensor([7], [], "q")}
    return OrderedDict((name, Tensor([index + 0.5], [1])) for index, name in enumerate(names)) | counter


class Conversions(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def convert(self, checkpoint, config=None, *arguments, suffix=".json"):
        """Exit code, standard output, standard error."""
        path, out = self.folder / "net.pth", self.folder / "out.safetensors"
        path.write_bytes(checkpoint)
        config_path = self.folder / f"config{suffix}"
        config_path.write_text(json.dumps(hypes()) if config is None else config)
        sys.argv = ["convert", str(path), "--config", str(config_path), "--out", str(out), *arguments]
        stdout, stderr = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
            code = convert_opencood.main()
        return code, stdout.getvalue(), stderr.getvalue()

    def written(self):
        tensors, header, _ = read_checkpoint(self.folder / "out.safetensors")
        return tensors, header

    def assert_refused(self, result, *words):
        code, _, message = result
        self.assertEqual(code, 2, message)
        self.assertEqual(message.count("\n"), 1, message)
        for word in words:
            self.assertIn(word, message)

    def assert_converted(self, result, *words):
        code, text, message = result
        self.assertEqual((code, message), (0, ""))
        for word in words:
            self.assertIn(word, text)
        tensors, _ = self.written()
        for name, tensor in state().items():
            if not name.endswith("num_batches_tracked"):
                self.assertEqual(tensors.pop(name), ("F32", [1], tensor.values.tobytes()), name)
        self.assertEqual(tensors, {})


class Containers(Conversions):
    def test_a_state_dictionary_is_found_wherever_training_loops_put_it(self):
        self.assert_converted(self.convert(archive(state())), "left out: 1 num_batches_tracked")
        for key in ("model_state_dict", "state_dict", "model", "net", "my_detector"):
            item = {"epoch": 19, key: state(), "optimizer_state_dict": {"state": {0: {"step": Tensor([1], [])}}}}
            self.assert_converted(self.convert(archive(item)), f"its key '{key}'")
        self.assert_converted(self.convert(archive({"model": {"state_dict": state()}})))

    def test_names_are_freed_from_what_wraps_the_model(self):
        for prefix in ("module.", "_orig_mod.module.", "model."):
            wrapped = OrderedDict((prefix + name, tensor) for name, tensor in state().items())
            self.assert_converted(self.convert(archive(wrapped)))
        double = state() | {"module.cls_head.bias": Tensor([1], [1])}
        self.assert_refused(self.convert(archive(double)), "cls_head.bias", "module.cls_head.bias", "same name")

    def test_a_file_of_an_old_torch_is_read(self):
        self.assert_converted(self.convert(legacy({"state_dict": state()})))
        self.assert_refused(self.convert(legacy(state())[:-7]), "net.pth", "cut off")
        self.assert_refused(self.convert(pickle.dumps({"a": 1}, protocol=2)), "none that torch.save has written")

    def test_a_whole_model_is_read_for_its_tensors_and_nothing_of_it_is_run(self):
        def module(parameters, modules, kind=LINEAR):
            made = kind()
            made.__dict__.update(_parameters=parameters, _buffers={}, _modules=modules, training=True)
            return made

        whole = module({}, {}, MODEL)
        for name, tensor in state().items():
            *path, last = name.split(".")
            inside = whole
            for part in path:
                inside = inside.__dict__["_modules"].setdefault(part, module({}, {}))
            inside.__dict__["_parameters"][last] = tensor
        result = self.convert(archive(whole))
        self.assert_converted(result, "whole pickled model of class opencood.models.point_pillar.PointPillar")
        small = module({"weight": Tensor([1, 2, 3, 4], [2, 2])}, {})
        self.assert_refused(self.convert(archive(small)), "whole pickled model", "pillar_vfe", "state_dict()")

        class Trap:
            def __reduce__(self):
                return exec, ("open('/proc/self/environ'); raise SystemExit(7)",)

        self.assert_converted(self.convert(archive({"state_dict": state(), "trap": Trap()})))

    def test_values_are_in_row_major_order_whatever_their_strides(self):
        turned = Tensor([1, 2, 3, 4, 5, 6, 7], [2, 3], stride=[1, 2], offset=1)
        self.assert_converted(self.convert(archive(state())))
        tensors = state() | {"cls_head.weight": turned}
        self.assertEqual(self.convert(archive(tensors))[0], 0)
        expected = array.array("f", [2, 4, 6, 3, 5, 7]).tobytes()
        self.assertEqual(self.written()[0]["cls_head.weight"], ("F32", [2, 3], expected))
        beyond = state() | {"cls_head.weight": Tensor([1, 2], [2, 2])}
        self.assert_refused(self.convert(archive(beyond)), "cls_head.weight", "cut off or damaged")

    def test_what_is_no_checkpoint_is_refused_by_what_it_is(self):
        pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:aa\nsize 59\n"
        whole = archive(state())
        for bytes_, word in [
            (b"", "an empty file"),
            (pointer, "Git LFS pointer"),
            (whole[: len(whole) // 2], "cut off or damaged"),
            (b"<!DOCTYPE html><html>", "a web page"),
            (b"\x89HDF\r\n\x1a\nrest", "HDF"),
            (archive({"epoch": 3}), "without tensors (its keys: 'epoch')"),
            (archive([1, 2]), "type list"),
            (archive(LINEAR()), "type torch.nn.modules.linear.Linear"),
            (archive({"model": LINEAR()}), "without tensors (its keys: 'model')"),
            (archive(OrderedDict()), "no key at all"),
            (archive({"one": state(), "two": state()}), "2 state dictionaries"),
            (archive(state() | {"cls_head.bias": "text"}), "cls_head.bias"),
        ]:
            self.assert_refused(self.convert(bytes_), "net.pth", word, "expected")
        code, _, message = self.convert(b"")
        self.assertIn("torch.save(model.state_dict(), path)", message)
        sys.argv = ["convert", str(self.folder), "--out", str(self.folder / "out")]
        with contextlib.redirect_stderr(io.StringIO()) as stderr:
            self.assertEqual(convert_opencood.main(), 2)
        self.assertIn(str(self.folder), stderr.getvalue())

    def test_damage_anywhere_is_an_answer_and_no_traceback(self):
        chance = random.Random(1)
        for whole in (archive({"state_dict": state()}), legacy(state())):
            for _ in range(300):
                damaged = bytearray(whole)
                for _ in range(chance.randint(1, 4)):
                    damaged[chance.randrange(len(damaged))] = chance.randrange(256)
                code, _, message = self.convert(bytes(damaged[: chance.choice([len(damaged), chance.randrange(len(damaged))])]))
                self.assertTrue(code == 0 or (code == 2 and message.count("\n") == 1), message)


class Networks(Conversions):
    def method(self, config, tensors=None):
        code, _, message = self.convert(archive(tensors or state()), json.dumps(config))
        self.assertEqual((code, message), (0, ""))
        return self.written()[1]["method"]

    def test_the_data_set_says_what_a_network_for_one_vehicle_was_trained_for(self):
        self.assertEqual(self.method(hypes(dataset="EarlyFusionDataset")), "early")
        self.assertEqual(self.method(hypes(dataset="LateFusionDataset")), "late")
        self.assertEqual(self.method(hypes(dataset="IntermediateFusionDataset")), "none")
        self.assertEqual(self.method(hypes(dataset="early")), "early")
        self.assertEqual(self.method(hypes()), "none")
        odd = self.convert(archive(state()), json.dumps(hypes(dataset="FusionOfSomeKind")))
        self.assert_refused(odd, "config.json", "fusion.core_method", "FusionOfSomeKind")
        fused = hypes("point_pillar_baseline", "EarlyFusionDataset", fusion_method="max")
        self.assert_refused(self.convert(archive(state()), json.dumps(fused)), "EarlyFusionDataset", "fuses maps")
        self.assertEqual(self.method(hypes("point_pillar_baseline", "intermediate", fusion_method="max")), "max")

    def test_compression_takes_its_tensors_along_and_says_what_is_sent(self):
        compressed = json.dumps(hypes(compression=4))
        code, text, _ = self.convert(archive(state(compress_ratio=4)), compressed)
        self.assertEqual(code, 0)
        self.assertIn("4 of 16 channels", text)
        self.assertEqual(json.loads(self.written()[1]["config"])["compress_ratio"], 4)
        self.assert_refused(self.convert(archive(state()), compressed), "missing", "naive_compressor.decoder.0.bias")
        self.assert_refused(self.convert(archive(state(compress_ratio=4))), "does not have", "naive_compressor")

    def test_every_tensor_is_used_or_named(self):
        extra = state() | {"dir_head.weight": Tensor([1], [1]), "aux.scale": Tensor([1], [1]), "aux.steps": Tensor([1], [], "q")}
        self.assert_refused(self.convert(archive(extra)), "2 tensors", "aux.scale, aux.steps", "--leave-out")
        result = self.convert(archive(extra), None, "--leave-out", "aux.")
        self.assert_converted(result, "left out: aux.scale, aux.steps, dir_head.weight, 1 num_batches_tracked")
        deeper = state() | {"backbone.blocks.0.7.weight": Tensor([1], [1])}
        self.assert_refused(self.convert(archive(deeper)), "backbone.blocks.0.7.weight")
        fewer = state()
        del fewer["reg_head.bias"]
        self.assert_refused(self.convert(archive(fewer)), "1 of 43 tensors", "reg_head.bias")
        for value in (float("nan"), float("inf")):
            broken = state() | {"cls_head.bias": Tensor([1, value], [2])}
            self.assert_refused(self.convert(archive(broken)), "cls_head.bias", "index 1")
        counted = state() | {"cls_head.bias": Tensor([1], [1], "q")}
        self.assert_refused(self.convert(archive(counted)), "cls_head.bias", "I64")

    def test_a_network_that_is_no_point_pillars_is_named(self):
        second = {"model": {"core_method": "second", "args": {"mean_vfe": {}, "backbone_3d": []}}, "fusion": {"core_method": "LateFusionDataset"}}
        self.assert_refused(self.convert(archive(state()), json.dumps(second)), "config.json", "'second'", "point_pillar_v2vnet")
        other = {"pillar_vfe.x": Tensor([1], [1])}
        self.assert_refused(self.convert(archive(other)), "43 of 43 tensors are missing", "pillar_vfe.x instead")


class Configurations(Conversions):
    def refused(self, text, *words, suffix=".json"):
        self.assert_refused(self.convert(archive(state()), text, suffix=suffix), f"config{suffix}", *words)

    def test_what_is_missing_or_of_another_kind_is_named_with_its_place(self):
        def broken(change):
            config = hypes()
            change(config["model"]["args"], config)
            return json.dumps(config)

        self.refused(broken(lambda args, _: args.pop("pillar_vfe")), "model.args.pillar_vfe is missing")
        self.refused(broken(lambda args, _: args.update(pillar_vfe=None)), "model.args.pillar_vfe is empty")
        self.refused(broken(lambda args, _: args.update(lidar_range=[1, 2])), "lidar_range is [1, 2]", "6 numbers")
        self.refused(broken(lambda args, _: args.update(voxel_size="big")), "voxel_size is 'big'")
        self.refused(broken(lambda args, _: args.update(compression="much")), "compression is 'much'")
        self.refused(broken(lambda args, _: args.pop("base_bev_backbone")), "base_bev_backbone", "res_bev_backbone")
        self.refused(broken(lambda args, _: args["base_bev_backbone"].update(layer_strides=[2])), "layer_strides has 1")
        self.refused(broken(lambda _, config: config.update(model=3)), "model is 3")
        self.refused(broken(lambda _, config: config["model"].pop("args")), "model.args is missing")
        self.refused(broken(lambda _, config: config.update(preprocess=[])), "preprocess is []")
        for text, word in [("", "no JSON"), ("{", "no JSON"), ("[]", "empty"), ("3", "type int"), ("[" * 9999, "no JSON")]:
            self.refused(text, word, "config.yaml")
        self.assert_refused(self.convert_without_config(), "net.pth", "--config")

    def convert_without_config(self):
        result = self.convert(archive(state()))
        sys.argv = sys.argv[:2] + sys.argv[4:]
        with contextlib.redirect_stderr(io.StringIO()) as stderr:
            return convert_opencood.main(), *result[1:2], stderr.getvalue()

    @unittest.skipUnless(HAS_YAML, "PyYAML is not there")
    def test_yaml_is_read_with_what_numpy_and_python_left_in_it(self):
        text = json.dumps(hypes(dataset="LateFusionDataset"))[:-1]
        odd = ', "size": !!python/object/apply:numpy.dtype {args: [i8, false]}, "pair": !!python/tuple [1, 2]}'
        result = self.convert(archive(state()), text + odd, suffix=".yaml")
        self.assert_converted(result, "late")
        self.refused("", "empty", suffix=".yaml")
        self.refused("a: [1, {", "broken YAML at line", suffix=".yaml")
        self.refused("just words", "type str", suffix=".yaml")
        self.refused("&a [*a]", "type list", suffix=".yaml")
        self.refused("a: \x07", "broken YAML", suffix=".yaml")
        self.refused("model: {core_method: point_pillar, args: &x {pillar_vfe: *x, lidar_range: [*x]}}", suffix=".yaml")

    @unittest.skipIf(HAS_YAML, "PyYAML is there")
    def test_yaml_without_its_reader_is_refused(self):
        self.refused("a: 1", "PyYAML", suffix=".yaml")


if __name__ == "__main__":
    unittest.main()
