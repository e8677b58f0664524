"""TOML, JSON and YAML: text to plain data of limited depth."""

import json
import re
import tomllib
from typing import Any

from countersteer.errors import InputError
from countersteer.reading.content import reading
from countersteer.reading.values import short

DEEPEST = 32  # tables and lists within each other
LARGEST_YAML = 0.1  # MB; PyYAML reads a megabyte in some ten seconds
MOST_DOTS = 200  # between two commas of a line: the parser's time for a key is quadratic in them

# YAML 1.2 reads 5e-2 as a number, and so do people; PyYAML follows YAML 1.1.
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+")


def toml(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text. Raises `InputError`, naming `where`."""
    for line in text.splitlines():
        dots = max(part.count(".") for part in line.split(","))
        if dots > MOST_DOTS and not line.lstrip().startswith("#"):
            raise InputError(f"{where}: not valid TOML: a key is nested too deeply")
    with reading(where):
        try:
            found = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{where}: not valid TOML: {short(str(error))}") from None
        except ValueError:
            raise InputError(f"{where}: not valid TOML: a number or a date is too large") from None
        check_depth(found, where)
    return found


def json_object(text: str, where: str) -> dict[str, Any]:
    """The object of a JSON text. NaN and infinity, which are no JSON, become None.

    Raises `InputError`, naming `where`.
    """
    with reading(where):
        try:
            found = json.loads(text, parse_constant=lambda _: None)
        except json.JSONDecodeError as error:
            raise InputError(f"{where}: not valid JSON: {short(str(error))}") from None
        except ValueError:
            raise InputError(f"{where}: not valid JSON: a number is too large") from None
        check_depth(found, where)
    if not isinstance(found, dict):
        raise InputError(f"{where}: must hold one JSON object")
    return found


def yaml_mapping(text: str, where: str) -> dict[Any, Any]:
    """The mapping of a YAML text: scalars, lists and mappings, without aliases and merge keys.

    Raises `InputError`, naming `where`.
    """
    import yaml  # it loads slowly

    with reading(where):
        try:
            found = _loader()(text).get_single_data()
        except yaml.YAMLError as error:
            words = " ".join(str(error).split())
            raise InputError(f"{where}: not valid YAML: {short(words)}") from None
        except (ValueError, OverflowError):
            raise InputError(f"{where}: not valid YAML: a number or a date is too large") from None
    if not isinstance(found, dict):
        raise InputError(f"{where}: not a map: it has no keys")
    return found


def _loader() -> Any:
    """PyYAML's safe loader without what makes a small file large: aliases, merge keys, depth."""
    import yaml

    class Loader(yaml.SafeLoader):
        depth = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            """A node of the document."""
            event = self.peek_event()
            if self.check_event(yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
                raise yaml.YAMLError("anchors and aliases are not read")
            if self.depth > DEEPEST:
                raise yaml.YAMLError("it is nested too deeply")
            self.depth += 1
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

        def flatten_mapping(self, node: Any) -> None:
            """Merge keys are keys like others."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))
    return Loader


def check_depth(found: Any, where: str) -> None:
    """Raise `InputError` if lists and tables are nested beyond `DEEPEST`."""
    layer = [found]
    for _ in range(DEEPEST + 1):
        layer = [
            inner
            for outer in layer
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
    if layer:
        raise InputError(f"{where}: cannot be read: it is nested too deeply")
