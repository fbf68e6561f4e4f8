"""How C writes comparisons: what every engine that writes C begins with."""

from __future__ import annotations

COMPARISONS = {
    "equal": "==",
    "not_equal": "!=",
    "less": "<",
    "less_equal": "<=",
    "greater": ">",
    "greater_equal": ">=",
}
