"""Programs kept between processes: the same result, and nothing that is read is trusted."""

import json
import os
import subprocess
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from countersteer import kept_programs
from countersteer.kept_programs import Kept
from countersteer.signals import Command


class Foreign(NamedTuple):
    value: float


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "countersteer" / "programs"


def turned(command, gain, power):
    return {"as": None}["as"], (Command(command.throttle**power, -gain * command.steering), [gain])


def never(*_):
    raise AssertionError("it was traced")


never.__module__, never.__qualname__ = turned.__module__, turned.__qualname__
ASKED = Command(0.5, np.float64(0.25))


def test_a_kept_program_gives_what_the_function_gives():
    found = Kept(turned, (2,))(ASKED, 3.0, 2)
    assert found[0] is None
    assert isinstance(found[1][0], Command)
    assert isinstance(found[1][1], list)
    expected = turned(ASKED, 3.0, 2)
    np.testing.assert_array_equal(jax.tree.leaves(found), jax.tree.leaves(expected))


def test_the_next_process_traces_nothing_whatever_the_values(cache):
    Kept(turned, (2,))(ASKED, 3.0, 2)
    assert len(list(cache.iterdir())) == 1
    again = Kept(never, (2,))
    for gain in (3.0, np.float64(-1.5), jnp.asarray(7.0)):
        command = Command(np.float64(0.1) * gain, 1.0)
        found = again(command, gain, 2)
        np.testing.assert_allclose(
            jax.tree.leaves(found), jax.tree.leaves(turned(command, gain, 2)), rtol=1e-15
        )
    with pytest.raises(AssertionError, match="traced"):
        again(ASKED, 3.0, 3)  # another static argument is another program
    with pytest.raises(AssertionError, match="traced"):
        again(Command(np.zeros(2), 1.0), 3.0, 2)  # and so is another shape


def test_what_was_cut_off_or_names_foreign_code_is_made_again(cache):
    made = Kept(turned, (2,))
    made(ASKED, 3.0, 2)
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    size = int.from_bytes(whole[:8], "little")
    head = json.loads(whole[8 : 8 + size])
    head["result"]["children"][1]["children"][0]["class"] = "os:system"
    evil = json.dumps(head).encode()
    swapped = len(evil).to_bytes(8, "little") + evil + whole[8 + size :]
    for data in (whole[:100], b"", b"\xff" * 64, swapped):
        file.write_bytes(data)
        with pytest.raises(AssertionError, match="traced"):
            Kept(never, (2,))(ASKED, 3.0, 2)
        found = Kept(turned, (2,))(ASKED, 3.0, 2)
        assert float(found[1][0].steering) == -0.75


def test_a_class_of_somebody_else_is_not_kept(cache):
    found = Kept(lambda one: one._replace(value=2 * one.value))(Foreign(1.5))
    assert float(found.value) == 3.0
    assert not cache.exists()


def test_under_a_trace_it_is_the_function(cache):
    made = Kept(turned, (2,))
    found = jax.vmap(lambda gain: made(ASKED, gain, 2)[1][0].steering)(jnp.arange(3.0))
    np.testing.assert_allclose(found, [0.0, -0.25, -0.5])
    assert not cache.exists()


def test_another_source_is_another_program(cache, monkeypatch):
    Kept(turned, (2,))(ASKED, 3.0, 2)
    monkeypatch.setattr(kept_programs, "source", lambda: "another")
    Kept(turned, (2,))(ASKED, 3.0, 2)
    assert len(list(cache.iterdir())) == 2


def test_a_program_can_be_loaded_ahead(monkeypatch):
    monkeypatch.setattr(kept_programs, "_used", [])
    monkeypatch.setattr(kept_programs, "_coming", {})
    Kept(turned, (2,))(ASKED, 3.0, 2)
    kept_programs.remember("test")
    monkeypatch.setattr(kept_programs, "_used", [])  # another process
    kept_programs.preload("test")
    (coming,) = kept_programs._coming.values()
    program = coming.result(timeout=60)
    assert program is not None
    again = Kept(never, (2,))
    assert float(again(ASKED, 3.0, 2)[1][0].steering) == -0.75
    assert again._last[2] is program


ENDS_EARLY = """
import json, time
import jax
from countersteer import kept_programs

def slow(key, device):
    time.sleep(0.5)
    print(f"{key} ", end="", flush=True)

kept_programs._read = slow
folder = kept_programs._folder()
folder.mkdir(parents=True)
programs = [{"key": key, "device": 0, "wide": False} for key in ("large", "small", "last")]
(folder / "drive.json").write_text(json.dumps({"programs": programs}))
kept_programs.preload("drive")
time.sleep(0.1)
"""


def test_the_end_waits_for_programs_that_are_being_loaded_and_begins_no_other(tmp_path):
    """Else Python stops a thread within XLA, which aborts the process.

    The largest is loaded beside the others, so two are under way.
    """
    done = subprocess.run(
        [sys.executable, "-c", ENDS_EARLY],
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert sorted(done.stdout.split()) == ["large", "small"]


WRONG = ["", "{}", '{"programs": [{"key": "x", "device": 99, "wide": 1}]}', "[]"]


@pytest.mark.parametrize("text", WRONG)
def test_a_wrong_list_of_programs_is_nothing(cache, text):
    cache.mkdir(parents=True)
    (cache / "drive.json").write_text(text)
    kept_programs.preload("drive")
