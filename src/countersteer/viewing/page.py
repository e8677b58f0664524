"""Self-contained HTML pages: templates with fields, and their common style."""

import importlib.resources
import re
from collections.abc import Mapping

from countersteer.viewing.style import palette_css

FOLDER = importlib.resources.files("countersteer.viewing")


def filled(template: str, fields: Mapping[str, str]) -> str:
    """The template with each `{{field}}` replaced, and the common style for `{{style}}`.

    All fields are replaced in one pass. So a value that looks like a field stays text.
    """
    shared = (FOLDER / "page.css").read_text(encoding="utf-8").rstrip()
    known = {"style": f"{palette_css()}\n{shared}", **fields}
    text = (FOLDER / template).read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda field: known[field[1]], text)
