"""How JAX compiles: XLA's flags, and the cache of compiled programs."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import jax


def configure_jax(batches: bool = True, blocks: bool = False, cores: int = 1) -> None:
    """Settings for the process: compile well, and keep compiled programs in the user's cache.

    To be called before JAX computes anything; the command line does. A library does not do this
    behind its user's back. Without it all works, but starts and runs at half the speed or less.
    A process that drives one car at a time may say so, and drives it twice as fast. One that works
    through many cars in blocks of some hundred may say `blocks`: then a whole loop is one function
    whose numbers stay in the core's caches. `cores` is how many devices JAX makes of the CPU.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {compiler_flags(batches, blocks, cores=cores)}".strip()
    # A cache that cannot be read or written is no cache, and nothing to trouble anyone with.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(Path(home) / "countersteer" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def compiler_flags(
    batches: bool = True, blocks: bool = False, backend: Sequence[str] = (), cores: int = 1
) -> str:
    """What XLA is told (`configure_jax`); `backend` holds further options of its backend."""
    # Without this, scalars that several results need are computed anew for each of them.
    options = ["xla_cpu_use_multi_output_fusion"]
    flags = []
    if batches:
        # XLA's newer emitters abort the process on some batched programs with it (0.10.2).
        flags.append("--xla_cpu_use_fusion_emitters=false")
    if blocks:
        # A loop whose numbers take less bytes is compiled into one function.
        options.append("xla_cpu_small_while_loop_byte_threshold=100000000")
        flags.append("--xla_cpu_prefer_vector_width=512")
    if cores > 1:
        flags.append(f"--xla_force_host_platform_device_count={cores}")
    return " ".join([f"--xla_backend_extra_options={','.join([*options, *backend])}", *flags])
