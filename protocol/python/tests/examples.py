"""The examples, and the type stubs against the module."""
import ast
import inspect
import json
import os
import pathlib
import subprocess
import sys

import v2vloc

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
