"""How JAX compiles: XLA's flags, and the cache of compiled programs."""

import os
import warnings
from collections.abc import Sequence

import jax

from countersteer.cache import cache_folder


def configure_jax(batches: bool = True, blocks: bool = False, cores: int = 1) -> None:
    """Set XLA's flags for this process, and keep compiled programs in the user's cache.

    Call it before JAX computes anything. The command line calls it. Importing the library does
    not. Without it everything works, but starts and runs at half the speed or less.

    For one car at a time, set `batches` to False: it then runs twice as fast. For many cars in
    blocks of some hundred, set `blocks`: their numbers stay in the core's caches. `cores` is the
    number of JAX devices that share the CPU.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {compiler_flags(batches, blocks, cores=cores)}".strip()
    # Without a cache that can be read and written, everything works: no warning is needed.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation")
    jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def compiler_flags(
    batches: bool = True, blocks: bool = False, backend: Sequence[str] = (), cores: int = 1
) -> str:
    """XLA's flags for `configure_jax`. `backend` holds further options of its backend."""
    # Without this, a scalar that several results need is computed again for each of them.
    options = ["xla_cpu_use_multi_output_fusion"]
    flags = []
    if batches:
        # With it, XLA's newer emitters abort the process on some batched programs (0.10.2).
        flags.append("--xla_cpu_use_fusion_emitters=false")
    if blocks or not batches:
        # A loop with fewer bytes of numbers is compiled into one function. It loads faster too.
        options.append("xla_cpu_small_while_loop_byte_threshold=100000000")
    if blocks:
        flags.append("--xla_cpu_prefer_vector_width=512")
    if cores > 1:
        flags.append(f"--xla_force_host_platform_device_count={cores}")
    return " ".join([f"--xla_backend_extra_options={','.join([*options, *backend])}", *flags])
