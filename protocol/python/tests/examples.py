"""The examples, and the type stubs against the module."""
import ast
import importlib.util
import inspect
import json
import os
import pathlib
import shutil
import subprocess
import sys
import types
from unittest import mock

import numpy as np
import v2vloc

from fleet import FRAMES, ROOT, call

HERE = pathlib.Path(__file__).resolve().parents[1]


def test_the_notebook_runs(run):
    notebook = json.loads((HERE / "examples/first_frames.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    os.environ["SCENE"] = str(run.scene)
    variables: dict[str, object] = {}
    for cell in cells:
        exec(compile(cell, "first_frames.ipynb", "exec"), variables)


def test_the_script_prints_a_recording(run):
    assert run.live
    command = [sys.executable, HERE / "examples/poses_and_boxes.py", run.work / "runs/fleet"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "confidence" in done.stdout and "boxes" in done.stdout, done.stdout


def test_a_vehicle_that_is_absent_has_no_training_map(run):
    scene, maps = run.work / "absent", run.work / "maps"
    shutil.copytree(run.scene, scene)
    neighbour = list(v2vloc.read(scene, points=False)[0].agents)[1]
    first = min(scene.glob(f"*/{neighbour}/*.yaml"))
    for file in first.parent.glob(f"{first.stem}*"):
        file.unlink()
    call("v2vloc", "eval", "--dataset", scene, "--weights", ROOT / "deploy/weights", "--method", "max", "--feature-maps", maps)
    samples = training_samples().Samples(scene, next(maps.glob("*.maps")), None, range_m=1e9)
    assert [len(samples[index][0][0]) for index in range(FRAMES)] == [1] + [2] * (FRAMES - 1)


def training_samples():
    """The module of the example, with NumPy in place of PyTorch, and a head that aligns nothing."""
    array = lambda values: types.SimpleNamespace(float=lambda: np.array(values))
    torch = types.SimpleNamespace(from_numpy=np.asarray, ones_like=np.ones_like, stack=np.stack, tensor=array, ones=np.ones,
                                  zeros=np.zeros, Tensor=np.ndarray)
    stubs = {"torch": torch, "torch.nn": types.SimpleNamespace(functional=None), "safetensors": types.SimpleNamespace(safe_open=None)}
    spec = importlib.util.spec_from_file_location("training_samples", ROOT / "deploy/examples/training_samples.py")
    module = importlib.util.module_from_spec(spec)
    with mock.patch.dict(sys.modules, stubs):
        spec.loader.exec_module(module)
    module.Head = lambda *_: types.SimpleNamespace(area_m=None, align=lambda bev, *_: (bev, np.ones_like(bev[:1])))
    module.Labels = lambda *_: None
    return module


def test_the_stubs_have_what_the_module_has(run):
    """Names of the module and of its classes, both ways."""
    folder = pathlib.Path(v2vloc.__file__).parent
    assert (folder / "py.typed").exists()
    stubs = ast.parse((folder / "__init__.pyi").read_text())
    for one in stubs.body:
        if isinstance(one, ast.ClassDef):
            cls = getattr(v2vloc, one.name)
            stated = {part.name for part in one.body if isinstance(part, ast.FunctionDef)}
            found = {name for name in vars(cls) if not name.startswith("_")}
            assert {name for name in stated if not name.startswith("_")} == found, (one.name, stated ^ found)
            assert stated <= set(dir(cls)), (one.name, stated - set(dir(cls)))
        elif isinstance(one, ast.FunctionDef):
            parameters = [*one.args.args, *one.args.kwonlyargs]
            found = list(inspect.signature(getattr(v2vloc, one.name)).parameters)
            assert [parameter.arg for parameter in parameters] == found, (one.name, found)
