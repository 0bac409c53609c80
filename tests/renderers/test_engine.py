"""How Taichi starts: in silence, beside a user's own, and where nothing can be written."""

import os
import subprocess
import sys

ENGINE = """
import os, torch
from probscene.drawing import Drawing, Sprites, resolve
from probscene.errors import ProbsceneError
from probscene.renderers import engine
from probscene.renderers.sprites import SpriteRenderer
one = torch.ones(1, 1)
layer = resolve(Sprites.disc("a", 9 * one, 9 * one, 5 * one), one > 0)
drawing = Drawing(torch.zeros(1, 1, dtype=torch.int64), ("a",), (layer,))
renderer = SpriteRenderer((20, 20))
assert not engine.started()
def child(expected):
    pid = os.fork()
    if pid == 0:
        try:
            os._exit(0 if (renderer(drawing).pixels.item() > 0) is expected else 1)
        except ProbsceneError as error:
            os._exit(0 if not expected and "spawn" in str(error) else 1)
    assert os.waitpid(pid, 0)[1] == 0
"""


def _run(code, **environment):
    command = [sys.executable, "-W", "error", "-c", ENGINE + code]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_taichi_starts_in_silence_in_the_process_that_renders():
    assert _run("child(True)\nrenderer(drawing)\nassert engine.started()\nchild(False)") == ""


def test_a_users_own_taichi_is_left_alone():
    code = """
engine.ti.init(arch=engine.ti.cpu, default_ip=engine.ti.i64, default_fp=engine.ti.f64, offline_cache=False)
field = engine.ti.field(engine.ti.i32, shape=3)
field[1] = 7
assert renderer(drawing).pixels.item() > 0 and field[1] == 7
"""
    assert "Starting" in _run(code)


def test_taichi_works_where_no_cache_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    _run("renderer(drawing)", XDG_CACHE_HOME=str(tmp_path / "file"))
