"""The bench: its batch is the same physics, and its answer has what it promises."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest

from benchmarks import accuracy, speed
from countersteer import cli
from countersteer.bench import bench
from countersteer.bench.fleet import Fleet, advance
from countersteer.car.files import load_car

TICKS = 10
TINY = bench.Size(rounds=1, least=0.0, cars=8, ticks=TICKS, warms=0)
# The batch in blocks, with the flags that are a process's own; what the lanes end with.
IN_BLOCKS = f"""
import os, sys
import numpy as np
from functools import partial
from countersteer.batch import engine
from countersteer.bench import bench
os.environ["XLA_FLAGS"] = engine.flags(2)
import jax
from countersteer.compiling import configure_jax
configure_jax()
from countersteer.bench.fleet import Fleet, advance
for varied in (False, True):
    fleet = Fleet(128, 2, varied=varied, block=32)
    assert fleet.cars == 128
    program = fleet.compiled(
        engine.in_one_program(partial(advance, dt=bench.DT, ticks={TICKS}), lanes=32)
    )
    ends = np.stack([np.asarray(leaf) for leaf in jax.tree.leaves(program(*fleet.inputs()).motion)])
    np.save(sys.argv[1 + varied], ends)
"""


def test_a_batch_in_blocks_on_two_cores_is_what_vmap_gives(tmp_path):
    files = [tmp_path / "same.npy", tmp_path / "varied.npy"]
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    subprocess.run([sys.executable, "-c", IN_BLOCKS, *files], check=True, env=environment)
    with jax.enable_x64(False):
        one_by_one = jax.jit(partial(advance, dt=bench.DT, ticks=TICKS))
        for varied, file in enumerate(files):
            fleet = Fleet(128, 1, varied=bool(varied), block=64)
            plain = one_by_one(*fleet.inputs()).motion
            expected = np.stack([np.asarray(leaf) for leaf in jax.tree.leaves(plain)])
            found = np.load(file)
            assert found.shape == expected.shape
            assert np.ptp(expected, axis=1).max() > 1  # the lanes differ
            # The loads' accelerations are a change of speed over 1 ms: rounding a thousandfold.
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-3)


# In a process of its own: it loads code that was compiled a moment ago.
AS_C = f"""
from functools import partial
import sys
import numpy as np
from countersteer.compiling import configure_jax
configure_jax()
import jax
from countersteer.bench import bench
from countersteer.bench.fleet import Fleet, advance
from benchmarks.native import Native
fleet = Fleet(64, 1, block=64)
one_by_one = jax.jit(partial(advance, dt=bench.DT, ticks={TICKS}))
motion = one_by_one(*fleet.inputs()).motion
plain = np.stack([np.asarray(leaf) for leaf in jax.tree.leaves(motion)])
np.save(sys.argv[1], plain)
np.save(sys.argv[2], Native(fleet, 2).run({TICKS})[:, :len(plain)].T)
"""


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_c_that_is_printed_from_jax_is_the_same_physics(tmp_path):
    files = [tmp_path / "plain.npy", tmp_path / "c.npy"]
    subprocess.run([sys.executable, "-c", AS_C, *files], check=True)
    plain, ends = (np.load(file) for file in files)
    assert np.ptp(plain, axis=1).max() > 1
    np.testing.assert_allclose(ends, plain, rtol=1e-3, atol=1e-3)


def test_bench_gives_its_figures(monkeypatch, capsys):
    monkeypatch.setattr(bench, "QUICK", TINY)
    assert cli.main(["bench", "--quick", "--json"]) == cli.DONE
    found = json.loads(capsys.readouterr().out)
    for name in ("planar_batch_steps_per_s", "mujoco_steps_per_s", "drive_realtime_factor"):
        assert found[name] > 0
    assert {"drive_warm_s", "drive_cold_s"} <= found.keys()
    assert found["planar_over_mujoco"] > 0


def test_the_page_on_speed_is_made(monkeypatch, tmp_path):
    monkeypatch.setattr(speed, "GROWTH", (8,))
    facts = {
        "profile": {"flops": 1000, "kernels": 10, "bytes": 4000, "operations": {"add": 900}},
        "ends": [[0.0, 1.0]], "ends_large": [[0.0, 1.001]], "converged": [[0.0, 1.0]],
    }  # fmt: skip
    samples = {
        "planar_batch_steps_per_s": [2e6, 3e6], "planar_large_step_steps_per_s": [2e6],
        "mujoco_steps_per_s": [2e4], "drive_realtime_factor": [20.0],
        "drive_warm_s": [3.0], "drive_cold_s": [9.0], "native_steps_per_s": [8e6],
    }  # fmt: skip
    measured = bench.Measured(samples, facts, {"plain": "left out"}, (0.0, 0.0), 1.0)
    monkeypatch.setattr(bench, "measure", lambda *_: measured)
    page = tmp_path / "speed.md"
    speed.write_page(speed.measure(TINY, lambda *_: None), page)
    text = page.read_text()
    assert "MuJoCo, all cores" in text
    assert "0.000 mm at 1 ms, 1.000 mm at 5 ms" in text
    assert "**The planar batch is 125 times MuJoCo.**" in text
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")


def test_the_manoeuvres_of_the_page_end_where_the_converged_ones_do():
    with jax.enable_x64(False):
        fleet = Fleet(8, 1, block=8)
        program = jax.jit(partial(advance, dt=bench.DT, ticks=TICKS))
        ends = np.array(speed.manoeuvres(fleet, program, TICKS))
    converged = accuracy.positions(load_car("rx7"), 1e-3)[:, :2]
    assert speed.error_mm(ends, converged) < 1.0
