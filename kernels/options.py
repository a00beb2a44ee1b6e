"""How Warp compiles the kernels: the options that each file with kernels or their functions sets."""

import warp as wp

_INLINE_ON_CPU = """
#undef WP_NOINLINE
#define WP_NOINLINE
"""

OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
    "extra_build_options": wp.ModuleBuildOptions(extra_cpu_preamble=_INLINE_ON_CPU),
}
"""`@wp.func(inline=False)` holds on CUDA alone: the functions that are called from many places (GJK, support, bounds) are
compiled there once a module, not once a call, which takes a quarter of the time and half the code. On a CPU calls cost 17 %
of a trial (measured), so the word that Warp writes for it means nothing there.

`fuse_fp` off: every product is rounded before it is added, on a CPU as on CUDA, and angles go through geometry/angles.py; so
what decides verdicts has the same float32 bits on both (docs/gpu.md says what was shown of that, and where not). It costs
nothing on a CPU. `methods/` and `receiver/` leave it on: what they find is judged like anybody's."""
