"""Mutations of files: of bytes, of cells, of keys, of archives, and of what a file is."""

import io
import json
import os
import re
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import tomli_w

Mutation = Callable[[Random, bytes], bytes]

DEEP = 3000  # levels, beyond Python's stack
NASTY = (
    "nan", "-nan", "inf", "-inf", "1e999", "1e308", "-1e308", "1e-320", "-0.0", "0", "-1", "1",
    "1e12", "1700000000.0", "9" * 30, "9" * 400, "9" * 5000, "-" + "9" * 5000, "0x" + "f" * 3000,
    "-9223372036854775808", "18446744073709551616", "1_000", "1:2:3", "", " ", "true", "null", "~",
    '""', '"x"', '"a\\u0000b"', "'\\'", '"' + "x" * 3000 + '"', "[]", "{}", "[[1, 2], [3]]",
    "2001-02-30", "2001-02-03", "07:32:00", "!!python/object/apply:os.getcwd []", "*a", "&a [1]",
    "[" * DEEP, "{a=" * DEEP, "a." * DEEP + "b", "\0", "\x1b[2J", "é", "١٢", ",", ",,,,", "\n",
)  # fmt: skip
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join(['*' + chr(97 + i)] * 9)}]\n" for i in range(9)
)
VALUES: tuple[Any, ...] = (
    0, -1, 10**30, 10**400, -(2**63), 1e308, float("nan"), float("inf"), True, "", "x", "a\0b",
    "x" * 3000, "/dev/zero", "../" * 50, "</script><script>", "a\nb", [], [[]], [1, "a"], {},
    {"a": 1}, [{}], [float("nan")] * 3, 7, 0.5, 1e-320, "1.0",
)  # fmt: skip


def mutated(random: Random, name: str, content: bytes) -> bytes:
    """The content with one to three mutations that suit the file's name."""
    known = [flipped, cut, removed, repeated, inserted, encoded]
    if not name.endswith((".png", ".npz")):
        known += [line_changed] * 3 + [cell_changed] * 8 + [number_changed] * 12
    known += {
        ".toml": [key_changed] * 10,
        ".json": [json_changed] * 10,
        ".yaml": [bombed] * 3,
        ".npz": [archive_changed] * 14,
    }.get(Path(name).suffix, [])
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        content = random.choice(known)(random, content)
    return content


def flipped(random: Random, content: bytes) -> bytes:
    """A few bytes changed."""
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 3, 20))):
        if changed:
            changed[random.randrange(len(changed))] = random.choice((0, 255, random.randrange(256)))
    return bytes(changed)


def cut(random: Random, content: bytes) -> bytes:
    """The end missing."""
    return content[: random.randrange(len(content) + 1)]


def removed(random: Random, content: bytes) -> bytes:
    """A stretch missing."""
    begin, end = sorted(random.randrange(len(content) + 1) for _ in range(2))
    return content[:begin] + content[min(end, begin + random.choice((1, 10, 1000))) :]


def repeated(random: Random, content: bytes) -> bytes:
    """A stretch several times."""
    begin, end = sorted(random.randrange(len(content) + 1) for _ in range(2))
    return content[:end] + content[begin:end] * random.choice((1, 1, 3)) + content[end:]


def inserted(random: Random, content: bytes) -> bytes:
    """Something in between."""
    at = random.randrange(len(content) + 1)
    return content[:at] + random.choice(NASTY).encode() + content[at:]


def encoded(random: Random, content: bytes) -> bytes:
    """Another encoding, another end of lines, or blank lines at the end."""
    ends = (b"\n", b"\r\n\r\n", b" \n\n", b"\x1a", b"\0" * 40, b",\n")
    choice = random.randrange(6)
    if choice == 0:
        return content.decode("latin-1").encode("utf-16")
    if choice == 1:
        return b"\xef\xbb\xbf" + content
    if choice == 2:
        return content.replace(b"\n", random.choice((b"\r\n", b"\r", b"\n\n", b"")))
    if choice == 3:
        return random.choice((b"", b"\n", b"\xff\xfe", b"PK\x03\x04", b"[" * DEEP, b"#"))
    return content + random.choice(ends)


def line_changed(random: Random, content: bytes) -> bytes:
    """A line missing, twice, elsewhere, or twice as long."""
    lines = content.split(b"\n")
    at, to = random.randrange(len(lines)), random.randrange(len(lines))
    choice = random.randrange(5)
    if choice == 0:
        del lines[at]
    elif choice == 1:
        lines.insert(to, lines[at])
    elif choice == 2:
        lines[at], lines[to] = lines[to], lines[at]
    elif choice == 3:
        lines[at] = lines[at] + b"," + lines[at]
    else:
        lines = lines[:at] + lines[at : at + 1] * random.choice((2, 50)) + lines[at:]
    return b"\n".join(lines)


def cell_changed(random: Random, content: bytes) -> bytes:
    """A number, or a value after = or :, replaced by a nasty one; sometimes a whole column."""
    found = [*re.finditer(rb"-?\d[\d.]*(?:e[-+]?\d+)?|(?<=[=:] )[^\n]+|(?<=,)[^,\n]+", content)]
    if not found:
        return content
    nasty = random.choice(NASTY).encode()
    if random.random() < 0.1 and b"," in content:
        column = random.randrange(4)
        lines = [line.split(b",") for line in content.split(b"\n")]
        for cells in lines[1:]:
            if column < len(cells):
                cells[column] = nasty
        return b"\n".join(b",".join(cells) for cells in lines)
    one = random.choice(found)
    return content[: one.start()] + nasty + content[one.end() :]


def number_changed(random: Random, content: bytes) -> bytes:
    """A few numbers replaced by others that may be meant: scaled, moved, of the other sign, 0."""
    for _ in range(random.choice((1, 1, 2, 5))):
        found = [*re.finditer(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?", content)]
        if not found:
            return content
        one = random.choice(found)
        value = max(-1e300, min(1e300, float(one[0])))
        factor = random.choice((0.0, -1.0, 0.01, 0.5, 0.999999, 1.000001, 2.0, 10.0, 1000.0))
        other = value * factor + random.choice((0.0, 0.0, 1.0, random.gauss(0.0, 1.0)))
        text = random.choice((f"{other:.6g}", repr(round(other)), f"{other:.3f}"))
        content = content[: one.start()] + text.encode() + content[one.end() :]
    return content


def key_changed(random: Random, content: bytes) -> bytes:
    """A key of a TOML file missing, of another type, or deeper."""
    try:
        tables = tomllib.loads(content.decode())
        _change(random, tables)
        return tomli_w.dumps(tables).encode()
    except (ValueError, TypeError, RecursionError):
        return content


def json_changed(random: Random, content: bytes) -> bytes:
    """The same of a JSON file."""
    try:
        tables = json.loads(content)
        _change(random, tables)
        return json.dumps(tables).encode()
    except (ValueError, TypeError, RecursionError):
        return content


def _change(random: Random, tables: Any) -> None:
    """Change a place of nested tables and lists, near the root as likely as deep inside."""
    node = tables
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return
        key = random.choice(keys)
        inner = node[key]
        if isinstance(inner, dict | list) and inner and random.random() < 0.7:
            node = inner
            continue
        choice = random.randrange(8)
        if choice == 0:
            del node[key]
        elif choice == 1 and isinstance(node, dict):
            node[random.choice(("x", "", "a\nb", "x" * 3000, str(key) + "x"))] = inner
        elif choice == 2:
            node[key] = [inner] * random.choice((1, 2, 1000))
        elif choice == 3:
            node[key] = {str(key): inner}
        else:
            node[key] = random.choice(VALUES)
        return


def bombed(random: Random, content: bytes) -> bytes:
    """Aliases that grow without end, merge keys, tags, depth."""
    merges = "".join(f"m{i}: &m{i}\n  <<: [*m{i - 1}, *m{i - 1}]\n" for i in range(1, 30))
    return random.choice(
        (
            BOMB.encode() + content,
            content + BOMB.encode() + b"mode: *i\n",
            b"m0: &m0 {a: 1}\n" + merges.encode() + content,
            content + b"x: &x [*x]\n",
            content + b"<<: {image: map.png}\n",
            content + b"? [a]\n: b\n",
            content + b"x: " + b"[" * DEEP,
            content + b"- x\n",
            content + b"---\n" + content,
        )
    )


def archive_changed(random: Random, content: bytes) -> bytes:
    """Members of a zip file that are false, or that lie."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            members = {one.filename: packed.read(one) for one in packed.infolist()}
    except Exception:  # it is damaged already
        return content
    name = random.choice([*members, "obs.npy"])
    data = members.get(name, b"")
    choice = random.randrange(8)
    if choice == 0:
        return _field_changed(random, content)
    if choice == 1:
        members[random.choice(("other.npy", "../x.npy", "obs", "a/obs.npy"))] = data
    elif choice == 2:
        members[name] = content
    elif choice == 3:
        members[name] = random.choice((flipped, cut, removed))(random, data)
    elif choice == 4:
        members[name] = _saved(random)
    else:
        members[name] = _header_changed(random, data)
    out = io.BytesIO()
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA))
    with zipfile.ZipFile(out, "w", method) as packed:
        for member, value in members.items():
            packed.writestr(member, value)
    return out.getvalue()


def _field_changed(random: Random, content: bytes) -> bytes:
    """A field of a member's local or central header changed."""
    mark, fields = random.choice(((b"PK\x03\x04", 30), (b"PK\x01\x02", 46), (b"PK\x05\x06", 22)))
    places = [found.start() for found in re.finditer(re.escape(mark), content)]
    if not places:
        return content
    at = random.choice(places) + random.randrange(4, fields)
    value = bytes(random.choice((0, 1, 8, 99, 255)) for _ in range(random.choice((1, 2, 4))))
    return content[:at] + value + content[at + len(value) :]


def _saved(random: Random) -> bytes:
    """An array of another type, shape or content."""
    shapes = ((40, 12), (40, 2), (0, 12), (40,), (), (40, 2, 1), (2, 2), (1, 2))
    types = ("f8", "f4", "f2", "g", "i8", "u8", "?", "c16", "U3", "S2", "M8[s]", "f8,f8", ">f8")
    made: Any = np.zeros(random.choice(shapes), random.choice(types))
    if made.dtype.kind in "fiu" and made.size:
        worst = (np.nan, np.inf, 1e300, -(2.0**63), 2.0)
        with np.errstate(all="ignore"):
            made.flat[random.randrange(made.size)] = np.array(random.choice(worst)).astype(
                made.dtype
            )
        if made.dtype.kind == "i":
            made.flat[0] = np.iinfo(made.dtype).min
    if random.random() < 0.1:
        made = np.array([{"a": 1}], object)
    out = io.BytesIO()
    np.save(out, made, allow_pickle=True)
    return out.getvalue()


def _header_changed(random: Random, data: bytes) -> bytes:
    """The text of an array's header changed, with a length that agrees or not."""
    texts = (
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000, 12), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-40, -12), }",
        b"{'descr': '<f8', 'fortran_order': True, 'shape': (12, 40), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (" + b"9" * 5000 + b",), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (True, 480), }",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (480,), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (40L, 12L), }",
        b"{'descr': [('a', '<f8'), ('a', '<f8')], 'fortran_order': False, 'shape': (40, 6), }",
        b"{'descr': '<V96', 'fortran_order': False, 'shape': (40,), }",
        b"{'descr': '|S0', 'fortran_order': False, 'shape': (40, 12), }",
        b"(" * 500,
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (40, 12)",
        b"{**{}}",
    )
    text = random.choice(texts)
    length = random.choice((len(text), len(text), 0, 65535)).to_bytes(2, "little")
    version = random.choice((b"\x01\x00", b"\x01\x00", b"\x02\x00", b"\x03\x00", b"\x09\x09"))
    return b"\x93NUMPY" + version + length + text + data[128:]


# What a path can be other than a regular file.
NODES = ("folder", "pipe", "endless", "loop", "gone", "secret")


def place_node(random: Random, path: Path) -> str:
    """Replace a file by something else. Returns what it is now."""
    kind = random.choice(NODES)
    path.unlink()
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "endless":
        path.symlink_to("/dev/zero")
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "secret":
        path.symlink_to("/proc/self/mem")
    return kind
