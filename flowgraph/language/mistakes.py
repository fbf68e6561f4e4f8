"""Telling a step that is wrong from one that is only for the host.

Both raise while they are recorded. A call of something that takes numbers, not symbolic arrays (OpenCV, a
function of `math`), works in Python and may stay there. A field that does not exist, a value that is
unpacked wrongly or a check of the user's own that fails would fail in every run: that is refused when wired.
"""

from __future__ import annotations

import dis
import re
from types import TracebackType

from flowgraph.language.capturing import is_own
from flowgraph.recorder.refusals import is_machinery

_ARGUMENTS = re.compile(r"^([\w.<>]+)\(\) (missing \d+ |got (an unexpected|multiple values)|takes )")
_OF_XP = re.compile(r"^_[a-z]\w*(\.<locals>\.call)?$")


def is_mistake(error: Exception) -> bool:
    """Whether a step that raised this while it was recorded would raise in every engine."""
    where = error.__traceback__
    while where is not None and where.tb_next is not None:
        where = where.tb_next
    if where is not None and "'Dual'" in str(error):
        return True  # numbers would not be there in a run either: a function is being differentiated
    if where is None or "Symbolic" in str(error) or isinstance(error, ImportError):
        return False
    module = str(where.tb_frame.f_globals.get("__name__", "?"))
    if is_machinery(module) or not (is_own(module) or module.startswith("flowgraph.")):
        return False
    if isinstance(error, NameError):
        return True
    if not _in_a_call(where):
        return True
    arguments = _ARGUMENTS.match(str(error)) if isinstance(error, TypeError) else None
    return arguments is not None and not _OF_XP.match(arguments[1])


def _in_a_call(where: TracebackType) -> bool:
    """Whether what raised is a call, of a function without lines of its own."""
    for instruction in dis.get_instructions(where.tb_frame.f_code):
        if instruction.offset == where.tb_lasti:
            return instruction.opname.startswith(("CALL", "PRECALL", "RERAISE", "DICT_MERGE"))
    return True
