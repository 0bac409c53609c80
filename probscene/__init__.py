"""probscene: learn which scene structures occur in unlabelled images, then generate labelled ones.

The hub. Import its leaf modules (``from probscene.grammar import Grammar``); this face exports nothing.
"""

from pathlib import Path as _Path

_checkout = _Path(__file__).resolve().parent.parent
if (_checkout / "pyproject.toml").is_file():  # a plain checkout: probscene.models is models/, and so on
    __path__.append(str(_checkout))

__version__ = "0.1.0"
