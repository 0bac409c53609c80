"""What pages and pictures have in common: colours, and the style sheet that begins every page."""

from importlib import resources
from string import Template

LIGHT = {
    "paper": "#ffffff",
    "card": "#f5f6f8",
    "ink": "#1c2026",
    "soft": "#5b6472",
    "faint": "#d5d9df",
    "line": "#8a93a0",
    "accent": "#2566c8",
    "good": "#2e7d4f",
    "bad": "#c2402f",
    "prior": "#a9b1bd",
    "start": "#8e7cc3",
    "learnt": "#2566c8",
    "truth": "#d9822b",
    "estimate": "#7fb08a",
    "read": "#6fb7d6",
}
"""Of pages in light, and of pictures, which are always so."""
DARK = {
    "paper": "#14171b",
    "card": "#1d2126",
    "ink": "#e6e9ed",
    "soft": "#9aa4b2",
    "faint": "#39404a",
    "line": "#77818f",
    "accent": "#6aa2f5",
    "good": "#6fbf8d",
    "bad": "#ef8273",
    "prior": "#6b7482",
    "start": "#a08fd6",
    "learnt": "#6aa2f5",
    "truth": "#eb9d4f",
    "estimate": "#6f9e7b",
    "read": "#4f93b0",
}


def style_sheet() -> str:
    """CSS: each colour as a variable of its name, and what all pages share."""
    sheet = Template(resources.files("probscene.app").joinpath("style.css").read_text(encoding="utf-8"))
    light, dark = (" ".join(f"--{name}: {colour};" for name, colour in each.items()) for each in (LIGHT, DARK))
    return sheet.substitute(light=light, dark=dark)
