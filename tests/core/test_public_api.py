"""``import probscene as ps``: light, whole, and what it says."""

import ast
import inspect
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import probscene

FILE = Path(probscene.__file__)


def in_a_new_process(program):
    environment = {**os.environ, "PYTHONPATH": str(FILE.parents[1])}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_it_imports_neither_torch_nor_the_engine():
    program = "import json, sys, probscene; dir(probscene); print(json.dumps(sorted(sys.modules)))"
    modules = set(in_a_new_process(program))
    heavy = {"torch", "taichi", "quadrants", "pyro", "numpy", "rich", "typer"}
    assert not {name.split(".")[0] for name in modules} & heavy
    assert {name for name in modules if name.startswith("probscene")} == {"probscene"}


def test_errors_need_nothing_else():
    program = "import json, sys, probscene; probscene.DataError; print(json.dumps(sorted(sys.modules)))"
    assert "torch" not in in_a_new_process(program)


@pytest.mark.parametrize("name", probscene.__all__)
def test_a_name_is_that_of_its_own_module(name):
    found, module = getattr(probscene, name), import_module(probscene._MODULE_OF[name])
    assert found is getattr(module, name) and found is not module
    if inspect.isclass(found) or inspect.isfunction(found):
        assert found.__module__ == module.__name__ and found.__doc__


def test_it_lists_all_and_each_once():
    assert len(set(probscene.__all__)) == len(probscene.__all__)
    assert set(probscene.__all__) == set(probscene._MODULE_OF) <= set(dir(probscene))
    assert {name for name in dir(probscene) if not name.startswith("_")} == set(probscene.__all__)
    assert in_a_new_process("import json, probscene; print(json.dumps(dir(probscene)))") == dir(probscene)


def test_type_checkers_see_the_same():
    tree = ast.parse(FILE.read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    homes = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        module = f"probscene.{node.module}" if node.level else node.module
        homes |= {alias.name: module for alias in node.names if alias.asname is None}
    assert homes == probscene._MODULE_OF


@pytest.mark.parametrize("module", ["probscene", "probscene.photo", "probscene.world"])
def test_model_files_of_older_runs_still_import_photo(module):
    assert import_module(module).Photo is probscene.CameraEffects


@pytest.mark.parametrize("name", ["sprites.SpriteRenderer", "meshes.MeshRenderer"])
def test_renderers_are_imported_as_model_files_of_all_versions_do(name):
    module, _, attribute = f"probscene.renderers.{name}".rpartition(".")
    assert callable(getattr(import_module(module), attribute))


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'probscene' has no attribute 'grammer'"):
        _ = probscene.grammer
    assert not hasattr(probscene, "_nothing")


ORDERS = {
    "the module first": "import probscene.derive; import probscene as ps",
    "the function first": "import probscene as ps; ps.derive; import probscene.derive",
    "from": "from probscene import derive; import probscene.derive; import probscene as ps; assert ps.derive is derive",
    "by others": "import probscene.sampling; import probscene as ps",
    "all": "from probscene import *; import probscene as ps; assert ps.derive is derive",
}


EACH = """
import json, os, sys
import cv2, pyro, scipy.stats, taichi, torchvision  # what takes long, for all together

assert not any(name.startswith("probscene") for name in sys.modules)
for order in ORDERS.values():
    if os.fork() == 0:
        exec(order)
        assert type(ps.derive).__name__ == "function" and ps.derive.__module__ == "probscene.derive", order
        os._exit(0)
print(json.dumps([os.waitstatus_to_exitcode(os.wait()[1]) for _ in ORDERS]))
"""


def test_derive_is_the_function():
    """In whichever order a process that has imported nothing of it does so."""
    assert in_a_new_process(f"ORDERS = {ORDERS!r}{EACH}") == [0] * len(ORDERS)


def test_modules_of_other_names_are_there():
    """A public name that is also a module's is the object; any other module is one."""
    import probscene.grammar
    import probscene.scene

    assert inspect.ismodule(probscene.grammar) and inspect.ismodule(probscene.scene)
