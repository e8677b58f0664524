"""What a car looks like from above, and how dark a skid mark is, in pages and pictures alike."""

import json

import numpy as np

# Outlines in halves of the car's length and width, from the centre of the outline.
_LEFT_OF_BODY = [
    *((-1.0, 0.3), (-0.98, 0.7), (-0.92, 0.92), (-0.8, 1.0), (-0.5, 0.96), (-0.2, 0.93)),
    *((0.2, 0.93), (0.62, 0.96), (0.82, 0.88), (0.94, 0.66), (1.0, 0.3)),
]
BODY = np.array(_LEFT_OF_BODY + [(u, -v) for u, v in reversed(_LEFT_OF_BODY)])
WINDSCREEN = np.array([(0.3, 0.6), (0.36, 0), (0.3, -0.6), (0.06, -0.5), (0.09, 0), (0.06, 0.5)])
REAR_WINDOW = np.array([(-0.6, 0.56), (-0.62, 0), (-0.6, -0.56), (-0.42, -0.46), (-0.42, 0.46)])
WING = np.array([(-1, 0.84), (-0.92, 0.84), (-0.92, -0.84), (-1, -0.84)])

# The mark of a tyre begins at a slip, and is darkest from another on.
SKID_FROM_MPS, SKID_FULL_MPS, SKID_DARKEST = 0.3, 2.0, 0.45


def look_module() -> str:
    """The same as a module of the viewer (`look.js`)."""
    outlines = {
        "body": BODY,
        "windscreen": WINDSCREEN,
        "rearWindow": REAR_WINDOW,
        "wing": WING,
    }
    look = {name: points.tolist() for name, points in outlines.items()} | {
        "skidFrom": SKID_FROM_MPS,
        "skidFull": SKID_FULL_MPS,
        "skidDarkest": SKID_DARKEST,
    }
    data = json.dumps(look, separators=(",", ":"))
    return f"// Made from viewing/look.py.\nexport const LOOK = {data};\n"
