"""Elimination without a choice of rows, as lines of C that one run and lanes of several share.

They work in place on a (n x n) and b (n x m). A pivot gives its place to its inverse, which substitution
takes from there.
"""

from __future__ import annotations


def eliminated(real: str, one: str) -> str:
    """Take row j off the rows below it, within a loop over j.

    Args:
        real: the type of an element.
        one: how its 1 is written.
    """
    return f"""\
        const {real} inverse = {one} / a[n * j + j];
        a[n * j + j] = inverse;
        for (int32_t i = j + 1; i < n; i++) {{
            const {real} f = a[n * i + j] * inverse;
            for (int32_t k = j + 1; k < n; k++) a[n * i + k] -= f * a[n * j + k];
            for (int32_t k = 0; k < m; k++) b[m * i + k] -= f * b[m * j + k];
        }}
"""


SUBSTITUTED = """\
    for (int32_t j = n - 1; j >= 0; j--) {
        for (int32_t i = j + 1; i < n; i++) {
            for (int32_t k = 0; k < m; k++) b[m * j + k] -= a[n * j + i] * b[m * i + k];
        }
        for (int32_t k = 0; k < m; k++) b[m * j + k] *= a[n * j + j];
    }
"""
"""What is left of b becomes x, from the last row up."""
