"""How JAX compiles: XLA's flags, and the cache of compiled programs."""

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jax._src import lru_cache

from countersteer.cache import cache_folder
from countersteer.writing import write_whole


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
    _write_whole_entries()


def _write_whole_entries() -> None:
    """Have JAX write each entry of its cache whole, and in the place of one that it cannot read.

    JAX (0.10) writes an entry where it is read, and never again. One that a kill has cut off would
    be compiled anew in every later process. JAX has no public switch for it: where its cache has
    another form, it stays as it is.
    """
    cache = getattr(lru_cache, "LRUCache", None)
    suffix = getattr(lru_cache, "_CACHE_SUFFIX", None)
    if cache is None or suffix is None or not hasattr(cache, "put"):
        return

    def put(self: Any, key: str, value: bytes) -> None:
        """Called where the entry is missing or damaged. JAX takes an exception as a warning."""
        write_whole(Path(str(self.path)) / f"{key}{suffix}", value)

    cache.put = put


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
