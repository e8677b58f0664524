"""The viewer: the modules of JavaScript in `viewer/`, of the report.

They are plain ES modules, so a server can hand them out one by one (`module`). A page that stands
alone has them as one script. Each top-level name is unique among them, so their texts can simply
follow each other.
"""

import importlib.resources
import re

from countersteer.viewing.look import look_module

FOLDER = importlib.resources.files("countersteer.viewing") / "viewer"
_IMPORT = re.compile(r'^import \{[^}]*\} from "\./([\w-]+\.js)";\n', re.MULTILINE)
# Whole lines of comment, and what stands before and between lines of code. No text of a module goes
# over a line's end.
_ASIDE = re.compile(r"^\s*/\*\*(?s:.*?)\*/\n|^\s*//.*\n|^\s+", re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(async )?(function|const|let|class) )", re.MULTILINE)


def module(name: str) -> str:
    """The text of a module. `look.js` is made here, and the others are files."""
    return look_module() if name == "look.js" else (FOLDER / name).read_text(encoding="utf-8")


def modules(entry: str) -> list[str]:
    """The modules that `entry` needs, each after those that it imports; `entry` is the last."""
    ordered: list[str] = []

    def visit(name: str) -> None:
        for needed in _IMPORT.findall(module(name)):
            if needed not in ordered:
                visit(needed)
        ordered.append(name)

    visit(entry)
    return ordered


def bundle(entry: str) -> str:
    """The module `entry` with all that it imports, as one script without comments and indents."""
    text = "\n".join(_EXPORT.sub("", _IMPORT.sub("", module(name))) for name in modules(entry))
    return _ASIDE.sub("", text)
