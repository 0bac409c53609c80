"""Modules that lie beside a user's file and that it imports, as ``python FILE`` would find them.

They are modules of a package that stands for the folder: ``import helper`` in a file of that folder means
``PACKAGE.helper``. So files of two folders have each their own ``helper`` in one process, whenever the import runs,
which may be when a program is called.
"""

import ast
import builtins
import hashlib
import importlib
import sys
from functools import lru_cache, partial
from importlib import invalidate_caches
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from importlib.util import module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any

PREFIX = "probscene_model_"  # begins the names of all modules of the user's
_BESIDE = "_beside"  # ends the name of a folder's package
_INSTALLED = {"site-packages", "dist-packages"}  # folders


def prepare(module: ModuleType, file: Path) -> None:
    """Let a module that is not executed yet import what lies beside its file.

    Modules of the folder are forgotten where one of their files has changed since it was executed.
    """
    folder = file.resolve().parent
    name = PREFIX + hashlib.sha256(str(folder).encode()).hexdigest()[:12] + _BESIDE
    invalidate_caches()
    there = [known for known in sys.modules if known.startswith(f"{name}.")]
    if any(
        _digest(Path(file)) != digest for file, digest in (_EXECUTED[known] for known in there if known in _EXECUTED)
    ):
        for known in there:
            del sys.modules[known]
    if name not in sys.modules:
        spec = ModuleSpec(name, None, is_package=True)
        spec.submodule_search_locations = [str(folder)]
        sys.modules[name] = module_from_spec(spec)
    _is_beside.cache_clear()
    _own_imports(module, name, folder)


def neighbours(file: Path) -> dict[str, Path]:
    """The modules that a file imports from beside it, and those that they import, wherever in them: by their path from
    its folder. None of a file that is not there, or that does not compile."""
    folder = file.resolve().parent
    found: dict[Path, str] = {}
    todo = [(file.resolve(), "")]
    while todo:
        source, package = todo.pop()
        for name in _imported(source, package, folder):
            for each, within in _files(folder, name):
                if each not in found:
                    found[each] = within
                    todo.append((each, within))
    found.pop(file.resolve(), None)
    return {each.relative_to(folder).as_posix(): each for each in sorted(found)}


class _Finder(MetaPathFinder):
    """Finds modules of folders' packages."""

    def find_spec(self, fullname: str, path: Any, target: ModuleType | None = None) -> ModuleSpec | None:
        if not (fullname.startswith(PREFIX) and _BESIDE in fullname):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Loader(fullname, spec.loader.path)
        return spec


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        package = module.__name__.partition(".")[0]
        _EXECUTED[module.__name__] = self.path, _digest(Path(self.path))
        _own_imports(module, package, Path(sys.modules[package].__path__[0]))
        super().exec_module(module)


_EXECUTED: dict[str, tuple[str, str]] = {}  # file and its SHA-256, by module
sys.meta_path.insert(0, _Finder())


def _own_imports(module: ModuleType, package: str, folder: Path) -> None:
    imports = partial(_import, package, folder)
    vars(module)["__builtins__"] = {**vars(builtins), "__import__": imports}  # which its functions take with them


def _import(
    package: str, folder: Path, name: str, globals: Any = None, locals: Any = None, fromlist: Any = (), level: int = 0
) -> ModuleType:
    """``__import__`` of the modules of a folder."""
    top = name.partition(".")[0]
    if top == "importlib" and not level and (name == top or not fromlist):
        builtins.__import__(name, globals, locals, fromlist)
        return _importlib(package, folder)
    if level or not _is_beside(folder, top):
        return builtins.__import__(name, globals, locals, fromlist, level)
    found = builtins.__import__(f"{package}.{name}", globals, locals, fromlist, 0)
    return found if fromlist else sys.modules[f"{package}.{top}"]


def _importlib(package: str, folder: Path) -> ModuleType:
    """``importlib``, whose ``import_module`` finds the modules of a folder, too."""

    def import_module(name: str, of: str | None = None) -> ModuleType:
        beside = _is_beside(folder, name.partition(".")[0])
        return importlib.import_module(f"{package}.{name}" if beside else name, of)

    own = ModuleType("importlib")
    vars(own).update(import_module=import_module, __getattr__=partial(getattr, importlib))
    return own


@lru_cache(1024)
def _is_beside(folder: Path, name: str) -> bool:
    """Whether a module lies in the folder; what is installed goes before it, and any module before a mere folder."""
    if not name or name in sys.stdlib_module_names or name == "probscene":
        return False
    spec = PathFinder.find_spec(name, [str(folder)])
    if spec is None:
        return False
    other = PathFinder.find_spec(name)
    return other is None or (spec.origin is not None and not _INSTALLED & set(Path(other.origin or "").parts))


def _imported(source: Path, package: str, folder: Path) -> set[str]:
    """Names of modules beside that a file may import, with those of what it takes from them."""
    try:
        tree = ast.parse(source.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return set()
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names if _is_beside(folder, alias.name.partition(".")[0])}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                around = package.split(".")[: len(package.split(".")) - node.level + 1] if package else []
                base = ".".join(filter(None, [*around, base]))
            elif not _is_beside(folder, base.partition(".")[0]):
                continue
            names |= {".".join(filter(None, [base, alias.name])) for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            arguments = [arg.value for arg in node.args[:1] if isinstance(arg, ast.Constant)]
            names |= {name for name in map(str, arguments) if _is_beside(folder, name.partition(".")[0])}
    return names


def _files(folder: Path, name: str) -> list[tuple[Path, str]]:
    """The files that importing a name executes, each with the package that it is in."""
    found, parts = [], name.split(".")
    for i in range(1, len(parts) + 1):
        place = folder.joinpath(*parts[:i])
        if (file := place / "__init__.py").is_file():
            found.append((file, ".".join(parts[:i])))
        elif (file := place.with_name(f"{place.name}.py")).is_file():
            found.append((file, ".".join(parts[: i - 1])))
            break
        elif not place.is_dir():
            break
    return found


def _digest(file: Path) -> str:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError:
        return ""
