"""Environments for learning: Gymnasium, single and vector, and the functional form in JAX.

    import countersteer.envs  # registers them, without JAX
    gymnasium.make("Countersteer-box-lap-v0")
    gymnasium.make_vec("Countersteer-box-lap-v0", num_envs=1024)

In one line: `gymnasium.make("countersteer.envs:Countersteer-box-lap-v0")`. Gymnasium up to 0.29
finds them by the entry-point group `gymnasium.envs`; 1.0 and later look at no entry points.
"""

import contextlib
import importlib.resources

TASKS = ("lap",)


def courses() -> list[str]:
    """The library's courses, by their files."""
    names = (
        p.name for p in (importlib.resources.files("countersteer.course") / "library").iterdir()
    )
    return sorted(name.removesuffix(".toml") for name in names if name.endswith(".toml"))


def register() -> None:
    """Register an environment for each of the library's courses and each task, once."""
    import gymnasium

    for course in courses():
        for task in TASKS:
            name = f"Countersteer-{course}-{task}-v0"
            if name not in gymnasium.registry:
                gymnasium.register(
                    id=name,
                    entry_point="countersteer.envs.single:DriftEnv",
                    vector_entry_point="countersteer.envs.vector:DriftVectorEnv",
                    kwargs={"course": course},
                )


# The functional form needs no Gymnasium.
with contextlib.suppress(ModuleNotFoundError):
    register()
