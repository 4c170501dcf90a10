"""Tables in Mitsuba 3: a stock medium (`medium`), and teleportation path tracing: plugins ``granular`` and ``tpt``.

Importing this module registers the plugins with every variant that is set, before or after. A shape with BSDF ``null``
and interior medium ``granular`` holds grains; the integrator ``tpt`` follows Algorithm 1 and the boundary rules of Meng
et al. 2015 (supplemental), as `tsdf.walk.transport` does, which is the arbiter. Deep inside a medium, farther from
every surface than the next step reaches by a grid of distances, it needs no ray. Constant light is never drawn, so a
furnace reads exactly 1. Lengths are in scene units. What light does in a grain is `tsdf.data.sampler`.
"""

import subprocess
import sys

from tsdf.errors import UsageError
from tsdf.loaders.mitsuba.arrays import Arrays
from tsdf.loaders.mitsuba.bulk import Bulk, Grain, Grains, granular, medium
from tsdf.loaders.mitsuba.distances import Distances
from tsdf.loaders.mitsuba.integrator import plugins, trace
from tsdf.loaders.mitsuba.scene import Prepared
from tsdf.loaders.mitsuba.variant import dr, mi

__all__ = [
    "Arrays",
    "Bulk",
    "Distances",
    "Grain",
    "Grains",
    "Prepared",
    "dr",
    "granular",
    "medium",
    "mi",
    "register",
    "set_variant",
    "trace",
]

_registered: set[str] = set()


def register() -> None:
    """Register ``granular`` and ``tpt`` with the variant that is set; importing this module sees to that.

    Raises
    ------
    UsageError
        If no variant is set, or one that is not RGB.
    """
    variant = mi.variant()
    if variant is None:
        raise UsageError('no variant of Mitsuba is set: call tsdf.loaders.mitsuba.set_variant("llvm_ad_rgb") first')
    if variant in _registered:
        return
    if not variant.endswith("_rgb"):
        raise UsageError(f"granular and tpt are for RGB variants, not {variant}: set scalar_rgb or llvm_ad_rgb")
    medium_class, integrator_class = plugins()
    mi.register_medium("granular", medium_class)
    mi.register_integrator("tpt", integrator_class)
    _registered.add(variant)


def _changed(old: str | None, new: str | None) -> None:
    if new is not None and new.endswith("_rgb"):
        register()


mi.detail.add_variant_callback(_changed)
if mi.variant() is not None:
    _changed(None, mi.variant())

PROBE = (
    "import drjit as dr, mitsuba as mi\n"
    "mi.set_variant({variant!r})\n"
    "x = dr.arange(mi.Float, 32)\n"
    "dr.eval(x)\n"
    "print(float(dr.max(dr.maximum(x, 3.0))[0]))\n"
)


def set_variant(variant: str = "llvm_ad_rgb") -> None:
    """Set a variant of Mitsuba, after a look at whether its compiler works: some versions of LLVM end the process.

    Parameters
    ----------
    variant : str
        ``scalar_rgb``, ``llvm_ad_rgb`` or ``cuda_ad_rgb``.

    Raises
    ------
    UsageError
        If Mitsuba has no such variant, or it cannot run here.
    """
    if variant not in mi.variants():
        known = ", ".join(v for v in mi.variants() if v.endswith("_rgb"))
        raise UsageError(f"Mitsuba {mi.__version__} has no variant {variant!r}; for tpt it has {known}")
    if not variant.startswith("scalar"):
        code = PROBE.format(variant=variant)
        done = subprocess.run([sys.executable, "-I", "-c", code], capture_output=True, text=True, check=False)
        if done.returncode or done.stdout.strip() != "31.0":
            said = [line for line in done.stderr.splitlines() if line.strip()]
            reason = next(
                (s for s in said if "LLVM ERROR" in s), said[-1] if said else f"exit status {done.returncode}"
            )
            raise UsageError(f"{variant} does not work here ({' '.join(reason.split())[:160]}): {_way_out(variant)}")
    mi.set_variant(variant)


def _way_out(variant: str) -> str:
    if variant.startswith("cuda"):
        return "it needs an NVIDIA GPU and driver; set llvm_ad_rgb or scalar_rgb"
    return (
        "install LLVM 17 or newer (Debian: apt install libllvm19) and name its library in DRJIT_LIBLLVM_PATH, or set "
        "scalar_rgb"
    )
