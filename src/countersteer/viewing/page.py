"""Self-contained HTML pages: templates with fields, and their common style."""

import importlib.resources
import re
from collections.abc import Mapping

from countersteer.viewing.style import palette_css

FOLDER = importlib.resources.files("countersteer.viewing")


HEAD = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title} · Countersteer</title>
<style>
{style}"""


def filled(template: str, fields: Mapping[str, str]) -> str:
    """The template with each `{{field}}` replaced.

    `{{head}}` is the beginning of all pages, with their common style and the field `title`. After
    it come the template's own styles. All fields are replaced in one pass. So a value that looks
    like a field stays text.
    """
    shared = (FOLDER / "page.css").read_text(encoding="utf-8").rstrip()
    head = HEAD.format(title=fields["title"], style=f"{palette_css()}\n{shared}")
    known = {"head": head, **fields}
    text = (FOLDER / template).read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda field: known[field[1]], text)
