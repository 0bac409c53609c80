"""How Sphinx builds this folder; ``make docs`` writes ``build/docs``."""

import probscene

project = "probscene"
author = "the probscene authors"
copyright = author
version = release = probscene.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"probscene {version}"
html_static_path: list[str] = []
exclude_patterns = ["_build"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
autodoc_class_signature = "mixed"
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # named tuples would have each field twice
napoleon_use_rtype = False


def literal_blocks(app, what, name, obj, options, lines):
    """An indented block after an empty line is shown as it stands: docstrings need no ``::`` for that."""
    found, inside = [], False
    for line in lines:
        indented = line.startswith("    ")
        if indented and not inside and found and not found[-1].strip() and not _listed(found):
            found += ["::", ""]
        inside = indented or (inside and not line.strip())
        found.append(line)
    lines[:] = found


def _listed(lines):
    """Whether the paragraph before is a field or marked already, so that indentation means something else."""
    before = next((line for line in reversed(lines) if line.strip()), "")
    return before.startswith((":", ".. ", "   ")) or before.endswith("::")


def setup(app):
    app.connect("autodoc-process-docstring", literal_blocks, priority=600)  # after napoleon
