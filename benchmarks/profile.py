"""The operations of a compiled batch in a step, counted from XLA's own text of the program."""

import re
from collections import Counter
from typing import Any

FLOPS = ("multiply", "add", "subtract", "divide", "sqrt", "rsqrt")
OTHERS = ("maximum", "minimum", "select", "compare", "abs", "negate", "and", "or", "exponential")
BYTES = {"f32": 4, "s32": 4, "u32": 4, "pred": 1}


def profile(text: str, lanes: int) -> dict[str, Any]:
    """Count the loop over ticks, which is the computation with the most kernels.

    `lanes` is the size of a block. `kernels` are the loops over lanes in a tick. `operations` are
    those on each lane, by name, and `flops` is the sum of the arithmetic ones. `bytes` is the size
    of a lane's numbers between kernels, each read or written once in a kernel.
    """
    computations = dict(
        re.findall(r"(?ms)^(?:ENTRY )?(%?[\w.\-]+) \([^\n]*\{\n(.*?)^\}", text.replace("%", ""))
    )
    kernel = re.compile(r"^\s*(?:ROOT )?\S+ = .*? fusion\(.*calls=([\w.\-]+)", re.M)
    wide = re.compile(rf"\b(f32|s32|u32|pred)\[{lanes}\]")
    body = max(computations.values(), key=lambda lines: len(kernel.findall(lines)))
    operations: Counter[str] = Counter()
    moved, kernels = 0, 0
    of_lane = re.compile(rf"= \w+\[(?:\d+,)?{lanes}(?:,\d+)?\]\S* ([a-z\-]+)\(")
    for name in kernel.findall(body):
        lines = computations[name]
        operations.update(of_lane.findall(lines))
        kernels += 1
        for line in lines.splitlines():
            if " parameter(" in line:
                moved += sum(BYTES[kind] for kind in wide.findall(line.split(" parameter(")[0]))
            elif line.strip().startswith("ROOT"):
                result = line.split("=", 1)[1]
                moved += sum(
                    BYTES[kind] for kind in wide.findall(re.split(r" [a-z\-]+\(", result)[0])
                )
    operations.update(of_lane.findall(body))
    counted = {name: operations[name] for name in (*FLOPS, *OTHERS) if operations[name]}
    return {
        "kernels": kernels,
        "flops": sum(operations[name] for name in FLOPS),
        "operations": counted,
        "bytes": moved,
    }
