"""The notebook: its cells run as they stand, and what it shows was made by running them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[1] / "examples" / "drift.ipynb"
LARGEST = 300_000  # bytes, outputs included

CHECKS = """
assert run.success and len(run.turns) == 4 and len(x) > 500
assert 25 < np.abs(sideslip).max() < 60
# Stepped by hand it is the same drive, of which the driver knows what it needs.
there = np.interp(times, run.columns["time_s"], np.degrees(np.arctan2(vy, np.maximum(vx, 0.3))))
assert np.abs(there - true).max() < 0.6 and rms < 2
# The less the rear tyres hold, the wilder the drift; with rubber there is none.
assert np.all(np.diff(slips[[0, 2, 7, 8, 9, 10]]) < 0) and slips[0] > 45 and np.all(slips[:8] > 25)
assert np.all(slips[10:] < 12)
assert len(plt.get_fignums()) == 3
"""


@pytest.fixture(scope="module")
def cells() -> list[dict]:
    return json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]


def test_the_notebook_runs_as_it_stands(cells, tmp_path):
    """In a process of its own, as in Jupyter: nothing is set but where pictures go."""
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n\n".join([*code, CHECKS])],
        cwd=tmp_path,
        env={**os.environ, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    shown = "".join("".join(output.get("text", "")) for output in outputs)
    assert done.stdout == shown, "the notebook shows what was: make notebook"


def test_the_outputs_are_of_one_run_from_top_to_bottom(cells):
    assert len(cells) == 12
    assert NOTEBOOK.stat().st_size < LARGEST
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} == {"stream", "display_data"}
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert not any(output.get("name") == "stderr" for output in outputs)
