"""What stands at the top of every generated file: what it cannot be compiled with, and its own few macros."""

from __future__ import annotations

REFUSED = """/* NaN and infinity mean something here, and sums are made in this order */
#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(_M_FP_FAST) \\
    || (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__)
#error "a filter needs IEEE arithmetic: compile without -ffast-math, -Ofast and what they stand for"
#endif
"""

MACROS = """#ifdef __cplusplus
#define restrict __restrict
#define FG_ZERO {}
#else
#define FG_ZERO {0}
#endif
#if defined(__GNUC__)
#define FG_INLINE inline __attribute__((always_inline))
#define FG_APART __attribute__((noinline))
#else
#define FG_INLINE inline
#define FG_APART
#endif
/* with FLOWGRAPH_SIMD (and -fopenmp-simd) loops say that their turns may be done together */
#ifdef FLOWGRAPH_SIMD
#define FG_SIMD(text) _Pragma(#text)
#else
#define FG_SIMD(text)
#endif
"""

PACK = """/* numbers that are added together: a vector with FLOWGRAPH_SIMD, else one */
#ifdef FLOWGRAPH_SIMD
typedef REAL fg_pack __attribute__((vector_size(32)));
#else
typedef REAL fg_pack;
#endif
#define FG_PACK ((int32_t)(sizeof(fg_pack) / sizeof(REAL)))
#define FG_PACKS(n) (((n) + FG_PACK - 1) / FG_PACK)
"""
