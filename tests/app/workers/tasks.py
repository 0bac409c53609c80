"""Work of a crew, which nodes find under this file's name; they do not import the tests for it, which takes seconds."""

import time

from probscene.errors import ModelError
from probscene.generator import Command
from probscene.renderers.generator.pool import pool_for


def doubling(pause=0.0, fault=None):
    """Tasks and their doubles."""

    def do(task):
        time.sleep(pause)
        if task == fault:
            raise ModelError("this one cannot be drawn")
        return task, 2 * task

    return do


def slow():
    """The work of a crew whose preparation takes its time."""
    time.sleep(1)
    return doubling()


def drawing(argv):
    """Work that starts a generator; it gives the folder of its pool."""
    pool = pool_for(Command(argv), 1)
    pool.draw([{"height": 4, "width": 4, "seed": 1, "values": {"light": 1}, "nodes": []}])
    return lambda task: str(pool.folder)
