"""How Warp compiles the kernels: the options that each file with kernels or their functions sets."""

import warp as wp

_INLINE_ON_CPU = """
#undef WP_NOINLINE
#define WP_NOINLINE
"""

_BRANCH_ON_CUDA = """
namespace wp {
template <typename C, typename T> CUDA_CALLABLE inline T where_by_branch(const C& cond, const T& a, const T& b)
{
    if (!!cond) {
        asm volatile("");  // nothing: what must not be passed over cannot become a select
        return a;
    }
    return b;
}
}
#define where where_by_branch
"""

OPTIONS = {
    "enable_backward": False,
    "fuse_fp": False,
    "extra_build_options": wp.ModuleBuildOptions(
        extra_cpu_preamble=_INLINE_ON_CPU, extra_cuda_preamble=_BRANCH_ON_CUDA
    ),
}
"""`@wp.func(inline=False)` holds on CUDA alone: the functions that are called from many places (GJK, support, bounds) are
compiled there once a module, not once a call, which takes a quarter of the time and half the code. On a CPU calls cost 17 %
of a trial (measured), so the word that Warp writes for it means nothing there.

`where` is a branch on CUDA. After each `if` Warp writes `x = where(condition, x_within, x_before)`, and its variables belong
to the whole kernel: to a compiler that makes a select of it, `x_within` of the last turn of a loop is still wanted in this one,
and stays in registers all the way round although nobody reads it. As a branch on the condition of the `if` before it the two
become one: GJK of the waves has 168 registers in place of 239, planning's kernels a quarter to a half less that does not fit.
A CPU has no use for it.

`fuse_fp` off: every product is rounded before it is added, on a CPU as on CUDA, and angles go through geometry/angles.py; so
what decides verdicts has the same float32 bits on both (docs/gpu.md says what was shown of that, and where not). It costs
nothing on a CPU. `methods/` and `receiver/` leave it on: what they find is judged like anybody's."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("" : "+r"(i));
#endif
    return i;
""")
def afresh(i: int) -> int:
    """The same number, of which a compiler for CUDA knows nothing: addresses are worked out from it where it is asked for.

    Addresses that do not change in a loop are otherwise kept in registers throughout it, where a long kernel has none to spare.
    """
    ...
