"""A ghost: the chosen driver alone on the same course, in the same car."""

import numpy as np

from countersteer.cockpit import messages as m
from countersteer.cockpit.gyro import Hands
from countersteer.cockpit.recordings import ghost_of
from countersteer.cockpit.session import ENDED, Session
from countersteer.cockpit.setting import Prepared, Setting, simulator_of
from countersteer.runs.files import Table

LONGEST = 60.0  # s of the ghost's drive


def drive_alone(prepared: Prepared, setting: Setting) -> m.Ghost:
    """The drive of the setting's driver, as far as it comes in `LONGEST`.

    A driver that JAX cannot trace plans in its own time: that would take the drive's.
    """
    if prepared.own is not None:
        return m.Ghost(
            name=f"{setting.driver} is too slow for a ghost: record a run of it, and take that",
            time_s=[],
            x_m=[],
            y_m=[],
            heading_rad=[],
            sideslip_deg=[],
        )
    session = Session(
        prepared._replace(setting=setting, simulator=simulator_of(setting)), None, recording=False
    )
    session.hand_over(m.DRIVER)
    session.start()
    rows = []
    while session.phase != ENDED and session.time < LONGEST:
        session.step(Hands())
        now = session.state(**NO_CLOCK)
        rows.append((now.time_s, now.x_m, now.y_m, now.heading_rad, now.vx_mps, now.vy_mps))
    names = ("time_s", "x_m", "y_m", "heading_rad", "vx_mps", "vy_mps")
    return ghost_of(setting.driver, Table(dict(zip(names, np.array(rows).T, strict=True))))


NO_CLOCK = {
    "seq": -1, "page_time_ms": 0.0, "rate": 1.0, "lag_s": 0.0, "keeps": 1.0, "silent": False,
}  # fmt: skip
