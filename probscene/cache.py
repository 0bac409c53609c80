"""Where probscene keeps what it can make again: the user's cache folder."""

import os
import sys
from pathlib import Path


def cache_folder() -> Path:
    """The folder named in ``PROBSCENE_CACHE``, else ``probscene`` in the platform's own place for caches: that of
    ``LOCALAPPDATA`` on Windows, ``~/Library/Caches`` on macOS, that of ``XDG_CACHE_HOME`` or ``~/.cache`` elsewhere.

    It need not exist, and need not be writable.
    """
    named = os.environ.get("PROBSCENE_CACHE")
    return Path(named) if named else _caches() / "probscene"


def _caches() -> Path:
    home = Path(os.path.expanduser("~"))  # unlike Path.home, no error where nobody's home is known
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
