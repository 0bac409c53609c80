"""The other side of a generator: this file needs Python 3.7 and its standard library alone.

A program that draws scenes, in an environment of its own, imports it under the name ``probscene_worker`` and hands over
a function of a scene::

    import os, sys
    sys.path.insert(0, os.environ["PROBSCENE_WORKER"])
    from probscene_worker import serve

    def render(scene):
        for node in scene.nodes:
            place(node.kind, node.values["x"], node.values["y"], id=node.id)
        return {"image": colours, "instance": ids}

    serve(render)

``probscene`` starts the program (``Command`` in probscene.generator) and sends it one scene after the other. What is
printed goes to a log, whose end is told where a scene fails.

On the wire, a Unix socket or, where the system has none, one of TCP on this machine, each message is two big-endian
32-bit lengths, then JSON, then the bytes of all arrays.
"""

import importlib
import json
import os
import select
import signal
import socket
import struct
import sys
import threading
import traceback

PROTOCOL = 1
SOCKET, TOKEN = "PROBSCENE_SOCKET", "PROBSCENE_TOKEN"  # variables of the environment
_TCP = "tcp:"  # before a port, in an address
_LENGTHS = struct.Struct(">II")
_KIBIBYTES = 1 if sys.platform != "darwin" else 1024  # what ru_maxrss counts in


class Node:
    """An object of a scene.

    Attributes:
        id: its number from 1, which is its id in ``instance``.
        kind: name of its kind.
        parent: the node that it is below, or None.
        values: by name; numbers, or lists of them.
    """

    def __init__(self, id, kind, parent, values):
        self.id, self.kind, self.parent, self.values = id, kind, parent, values


class Scene:
    """What is to be drawn.

    Attributes:
        height, width: of the image, pixels.
        seed: for whatever is random in drawing, 0 to 2**31 - 1; the same scene always has the same.
        values: of the scene, by name.
        nodes: its objects, parents before their children.
    """

    def __init__(self, height, width, seed, values, nodes):
        self.height, self.width, self.seed, self.values, self.nodes = height, width, seed, values, nodes


def scene_of(record):
    """A ``Scene`` from what is on the wire."""
    nodes = {}
    for each in record["nodes"]:
        nodes[each["id"]] = Node(each["id"], each["kind"], nodes.get(each["parent"]), each["values"])
    return Scene(record["height"], record["width"], record["seed"], record["values"], list(nodes.values()))


def serve(render, version=""):
    """Draw scenes until there are no more; then this returns.

    Args:
        render: ``render(scene)`` gives a dict with ``image``, ``(height, width, 3)`` uint8 RGB, and ``instance``,
            ``(height, width)`` of any integer type, the ``id`` of the node that is seen and 0 where there is none. It
            may have ``depth``, ``(height, width)`` float32, metres; and ``amodal_box``, a dict by node id of x0, y0,
            x1, y1 in pixels, the extent of the whole silhouette. Arrays are numpy's, or ``bytes`` of the same size.
        version: of the program; where its ``Command`` names another one, that is an error.
    """
    if SOCKET not in os.environ or TOKEN not in os.environ:
        raise SystemExit(
            f"expected to be started by probscene, got no {SOCKET} in the environment; name this program in the "
            "Command of a scene model's generator."
        )
    wire = connected(os.environ[SOCKET])
    threading.Thread(target=_leave_with, args=(wire,), daemon=True).start()
    send(wire, {"protocol": PROTOCOL, "token": os.environ[TOKEN], "version": str(version), "process": os.getpid()})
    while True:
        message = receive(wire)
        if message is None:
            return
        try:
            reply, arrays = packed(render(scene_of(message[0])))
        except Exception as error:
            text = "".join(traceback.format_exception(type(error), error, error.__traceback__))
            reply, arrays = {"error": text}, []
        send(wire, dict(reply, memory=memory()), arrays)


def listening(folder, number):
    """A socket to which one process may connect, and its address; a file in ``folder`` where the system has such."""
    if not hasattr(socket, "AF_UNIX"):
        wire = socket.create_server(("127.0.0.1", 0), backlog=1)
        return wire, f"{_TCP}{wire.getsockname()[1]}"
    address = os.path.join(folder, str(number))
    if os.path.exists(address):
        os.unlink(address)
    wire = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        wire.bind(address)
    except OSError:
        wire.close()
        raise
    wire.listen(1)
    return wire, address


def connected(address):
    """A connection to a ``listening`` process."""
    if not address.startswith(_TCP):
        wire = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        wire.connect(address)
        return wire
    return socket.create_connection(("127.0.0.1", int(address[len(_TCP) :])))


def packed(drawn):
    """What ``render`` gave, as JSON and arrays' bytes."""
    if not isinstance(drawn, dict) or "image" not in drawn or "instance" not in drawn:
        actual = sorted(drawn) if isinstance(drawn, dict) else type(drawn).__name__
        raise ValueError(f"expected render(scene) to return a dict with 'image' and 'instance', got {actual}.")
    reply, arrays = {"arrays": []}, []
    for name in ("image", "instance", "depth"):
        if drawn.get(name) is None:
            continue
        try:
            view = memoryview(drawn[name])
        except TypeError:
            actual = type(drawn[name]).__name__
            raise ValueError(f"expected {name!r} as an array of numpy's or as bytes, got {actual}.") from None
        reply["arrays"].append({"name": name, "format": view.format, "shape": list(view.shape or ())})
        arrays.append(view.tobytes())
    boxes = drawn.get("amodal_box")
    if boxes is not None:
        reply["amodal_box"] = [[int(id), [float(end) for end in box]] for id, box in boxes.items()]
    return reply, arrays


def memory():
    """The most that this process has had resident, megabytes; 0 where that is not known."""
    status = os.path.join(os.sep, "proc", "self", "status")  # of Linux; ru_maxrss is there at least what a parent had
    try:
        with open(status, encoding="ascii", errors="replace") as file:
            return next(float(line.split()[1]) / 1024 for line in file if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        pass
    try:
        resource = importlib.import_module("resource")
    except ImportError:
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 / _KIBIBYTES


def send(wire, message, arrays=()):
    """A message and the bytes of arrays."""
    text = json.dumps(message).encode()
    wire.sendall(_LENGTHS.pack(len(text), sum(map(len, arrays))) + text)
    for array in arrays:
        wire.sendall(array)


def receive(wire, most=1 << 32):
    """A message and the bytes of its arrays; None where the other side has gone.

    Args:
        most: bytes; a longer message is not one of this protocol.
    """
    lengths = _bytes(wire, _LENGTHS.size)
    if lengths is None:
        return None
    length, size = _LENGTHS.unpack(lengths)
    if length + size > most:
        raise ValueError(f"expected a message of at most {most} bytes, got {length + size}.")
    text, arrays = _bytes(wire, length), _bytes(wire, size)
    if text is None or arrays is None:
        return None
    message = json.loads(text.decode())
    if not isinstance(message, dict):
        raise ValueError(f"expected a JSON object, got {type(message).__name__}.")
    return message, arrays


def _bytes(wire, number):
    parts = bytearray()
    while len(parts) < number:
        some = wire.recv(min(number - len(parts), 1 << 20))
        if not some:
            return None
        parts += some
    return bytes(parts)


def _leave_with(wire):
    """End this process, and all of its group, when the other side has gone, also in the middle of a scene."""
    if not hasattr(select, "poll"):
        return
    poll = select.poll()
    poll.register(wire, select.POLLHUP)
    poll.poll()
    if hasattr(signal, "SIGKILL"):
        os.kill(0, signal.SIGKILL)
    os._exit(1)
