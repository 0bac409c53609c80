"""A second device without a GPU: tensors that say they are on it, with their numbers in the CPU's memory.

An operation of tensors on both devices fails as it would on a GPU, and everything else gives the CPU's own bytes, with
its gradients. Torch calls the device ``lazy``, a type that no build of torch computes on. Unlike on a GPU, numbers on
the CPU may meet any tensor, random numbers are the CPU's, and there is no pinned memory.
"""

from contextlib import contextmanager

import torch
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

SECOND = torch.device("lazy")
INDEXING = ("aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_")  # by the CPU's indices, too
COPY, COPY_INTO = "aten::_to_copy", "aten::copy_"


class OnSecond(torch.Tensor):
    """A tensor on the second device.

    Attributes:
        held: its numbers, on the CPU.
    """

    held: torch.Tensor

    @staticmethod
    def __new__(cls, held):
        return torch.Tensor._make_wrapper_subclass(
            cls, held.size(), strides=held.stride(), storage_offset=held.storage_offset(), dtype=held.dtype,
            device=SECOND,
        )  # fmt: skip

    def __init__(self, held):
        self.held = held

    def __repr__(self):
        return f"OnSecond({self.held})"

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        name, device = func._schema.name, kwargs.get("device")
        leaves = [x for x in pytree.arg_tree_leaves(*args, **kwargs) if isinstance(x, torch.Tensor)]
        on_second = any(isinstance(x, OnSecond) for x in leaves)
        if on_second and name not in (COPY, COPY_INTO):
            indices = pytree.tree_leaves(args[1]) if name in INDEXING and isinstance(args[0], OnSecond) else []
            for x in leaves:
                if not isinstance(x, OnSecond) and x.dim() and not any(x is index for index in indices):
                    raise RuntimeError(f"expected all tensors on the second device, got one on the CPU in {name}")
        if device == SECOND:
            kwargs["device"] = torch.device("cpu")
        found = func(*pytree.tree_map(_to_cpu, args), **pytree.tree_map(_to_cpu, kwargs))
        if name == COPY_INTO:
            return args[0]
        if device != SECOND if device is not None else not on_second:
            return found
        found = pytree.tree_map(lambda x: OnSecond(x) if isinstance(x, torch.Tensor) else x, found)
        return return_and_correct_aliasing(func, args, kwargs, found) if on_second else found


@contextmanager
def second_device():
    """Inside, tensors go to the second device and are made there, as to and on any other."""
    with _Moves(), _Numbers():
        yield SECOND


class _Moves(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if OnSecond not in types and kwargs.get("device") != SECOND:
            return func(*args, **kwargs)
        return OnSecond.__torch_dispatch__(func, types, args, kwargs)


class _Numbers(TorchFunctionMode):
    """Tensors of Python's numbers are made where no dispatch sees it."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") == SECOND:
            return func(*args, **{**kwargs, "device": "cpu"}).to(SECOND)
        if func.__name__ in ("__getitem__", "__setitem__") and isinstance(args[0], OnSecond):
            at = args[1] if isinstance(args[1], tuple) else (args[1],)
            at = tuple(torch.tensor(part) if isinstance(part, list) else part for part in at)
            values = (x if isinstance(x, torch.Tensor) else torch.tensor(x, dtype=args[0].dtype) for x in args[2:])
            return func(args[0], at, *(x.to(SECOND) for x in values))
        return func(*args, **kwargs)


def _to_cpu(x):
    return x.held if isinstance(x, OnSecond) else x
