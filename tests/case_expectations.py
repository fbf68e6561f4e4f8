"""What is right for each field case that is known by name, as a check of what it printed.

An expectation is a sentence and a check. Where more than one behaviour is right (the input is read, or is
refused by its name), the check takes each of them. A run that ends in an error which is not the package's own
is never right.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tests.cases import Outcome

__all__ = ["EXPECTATIONS", "Expectation"]

Check = Callable[["Outcome"], bool]


@dataclass(frozen=True)
class Expectation:
    """What is right, its check, and code that runs after a `run.py`, with its globals as `came`."""

    right: str
    check: Check
    probe: str = ""


def says(*patterns: str) -> Check:
    """Each pattern is in what was printed or said."""
    return lambda o: all(re.search(p, o.text, re.I | re.M) for p in patterns)


def silent(*patterns: str) -> Check:
    return lambda o: not any(re.search(p, o.text, re.I | re.M) for p in patterns)


def noted(*patterns: str) -> Check:
    """A note says all of the patterns, on the terminal or under "notes"."""
    said = r"^note: .*|^(?:info|assumed|bridged|skipped|refused|counted|warning|diverged): .*"

    def check(o: Outcome) -> bool:
        notes = re.findall(said, o.text, re.M) + [str(n) for run in o.runs for n in run.get("notes", ())]
        return any(all(re.search(p, note, re.I) for p in patterns) for note in notes)

    return check


def refused(*patterns: str, times: int = 1) -> Check:
    """Errors of the package that say all of the patterns."""
    return lambda o: sum(all(re.search(p, e, re.I) for p in patterns) for e in o.errors) >= times


def figure(name: str, most: float = math.inf, *, least: float = 0.0, run: int | None = None) -> Check:
    """A figure lies within bounds: of run number `run`, or of every run, of which there is one at least."""

    def check(o: Outcome) -> bool:
        runs = o.runs if run is None else o.runs[run : run + 1]
        return bool(runs) and all(least <= r.get(name, math.nan) <= most for r in runs)

    return check


def ran(*graphs: str) -> Check:
    """There are figures of these graphs."""
    return lambda o: {*graphs} <= {r.get("graph") for r in o.runs}


def lines(pattern: str, check: Callable[[re.Match[str]], bool], count: int) -> Check:
    """Of `count` lines at least, and of all that fit the pattern, the check holds."""

    def checked(o: Outcome) -> bool:
        found = list(re.finditer(pattern, o.stdout, re.M))
        return len(found) >= count and all(check(m) for m in found)

    return checked


def alike(pattern: str, count: int) -> Check:
    """`count` lines fit the pattern, and what its group finds is the same in all."""

    def check(o: Outcome) -> bool:
        found = re.findall(pattern, o.stdout, re.M)
        return len(found) == count and len({*found}) == 1

    return check


def either(*checks: Check) -> Check:
    return lambda o: any(check(o) for check in checks)


def both(*checks: Check) -> Check:
    return lambda o: o.crash is None and all(check(o) for check in checks)


def _twice_said(o: Outcome) -> bool:
    """The error of equal stamps does not advise dropping, and what dropping loses is said."""
    first = refused(r"\bequal\b|same time|same stamp")(o) and silent("bad_time=drop leaves such rows out")(o)
    return first and (len(o.errors) > 1 or noted("300 of 301|99.7")(o))


def _vector_of_noise(o: Outcome) -> bool:
    rows = re.findall(r"^\[.*?\] (\[[^\[\]]*\] \[[^\[\]]*\])$", o.stdout, re.M)
    return (len(rows) == 2 and rows[0] == rows[1]) or (len(rows) == 1 and refused(r"\(2, 2\)|2 x 2")(o))


def _pure_steps(o: Outcome) -> bool:
    if refused(r"line \d+|run\.py:\d+")(o) and o.crash is None:
        return True
    values: dict[str, set[str]] = {}
    for graph, came in re.findall(r"^(g\d) \w+ (\[.*\])$", o.stdout, re.M):
        values.setdefault(graph, set()).add(came)
    errors = re.findall(r"^\w+ \w+Error .*", o.stdout, re.M)
    return all(len(v) == 1 for v in values.values()) and len(values) + len(errors) // 5 == 2


def _heading_covered(o: Outcome) -> bool:
    found = re.search(r"'attitude_rmse_deg': ([\d.]+).*claimed deviation, deg: ([\d.]+)", o.stdout)
    if not found:
        return False
    said = re.search(r"assumed|unknown", o.probed) and "heading" in o.probed
    return bool(said) or float(found[1]) <= 3 * float(found[2])


def _two_streams(o: Outcome) -> bool:
    found = re.match(r"(\{.*?\}) \{", o.stdout)
    return found is not None and len(ast.literal_eval(found[1])) == 2


def _one_study(o: Outcome) -> bool:
    codes = sorted(re.findall(r"rc (-?\d+)$", o.stdout, re.M))
    found = re.search(r"study\.json says (\[.*?\]) \| the table holds (\[.*?\])", o.stdout)
    return len(codes) == 2 and codes.count("0") == 1 and found is not None and found[1] == found[2]


def _good_start(o: Outcome) -> bool:
    scored = [r for r in o.runs if all(math.isfinite(v) for v in r.values() if isinstance(v, float))]
    return len(scored) + len([e for e in o.errors if re.search(r"line 2\b", e)]) == 3


def _names(o: Outcome) -> bool:
    return lines(
        r"^(?:graph|source|outputs?) .*?: (.*)$",
        lambda m: bool(re.fullmatch(r"refused at build: .*|c equal(?: \| make: ok)?", m[1])),
        30,
    )(o)


_LOW_COLUMNS = """
figure = came["r"].plot("probe.png")
figure.canvas.draw()
lowest = {}
for axes in figure.axes:
    left, bottom = axes.get_position().x0, axes.get_position().y0
    lowest[round(left, 2)] = min(lowest.get(round(left, 2), (9.0, None)), (bottom, axes), key=lambda p: p[0])
numbers = lambda axes: any(label.get_visible() and label.get_text() for label in axes.get_xticklabels())
print("columns:", len(lowest), "without numbers:", sum(not numbers(axes) for _, axes in lowest.values()))
"""

_READ = both(figure("position_rmse_m", 0.02), figure("attitude_rmse_deg", 1.0))
_FINITE_OR_OURS = re.compile(r"\[[-+\d.e ]+\]$|(?:Data|Declaration|Output|Pipeline)Error\b")

EXPECTATIONS: Mapping[str, Expectation] = {
    "attitude_only_truth": Expectation(
        "scored in attitude; ins_eskf, a filter of poses, may be refused with a reason",
        both(
            silent("no field is called"),
            ran("gyro_integration", "complementary"),
            lambda o: all(any(name.endswith("_deg") for name in run) for run in o.runs),
            either(ran("ins_eskf"), refused("truth", "attitude")),
        ),
    ),
    "c_fast_math": Expectation(
        "refused by #error, or no belief is NaN with -ffast-math",
        both(lines(r"beliefs with nan: (\d+) of (\d+)", lambda m: m[1] == "0" and int(m[2]) > 0, 2)),
    ),
    "c_two_variants": Expectation(
        "two filters of one name do not link into one program in silence",
        both(lines(r"as archives: exit (\d+)", lambda m: m[1] != "0", 1), silent("No such file")),
    ),
    "checkpoint_killed": Expectation(
        "no checkpoint is lost", both(says("saving over the last one: 0 of 10"))
    ),
    "compare_that_flatters": Expectation(
        "failed runs are counted, and settings that differ are named, or the comparison is refused",
        both(
            either(says("words of failure: [1-9]"), refused("fail")),
            either(says("words of duration: [1-9]"), refused("duration")),
        ),
    ),
    "csv_decimal_comma": Expectation(
        "read, or refused as a decimal comma", either(_READ, refused("decimal comma"))
    ),
    "csv_euler_columns": Expectation(
        "three columns of an attitude are read as angles, or the error names the setting for angles",
        either(refused(r"angles="), both(figure("attitude_nis_mean", 3.0), noted("deg"))),
    ),
    "csv_percent_comments": Expectation("read", _READ),
    "csv_time_offset": Expectation(
        "read, as if its clock were not late", both(figure("position_rmse_m", 0.015))
    ),
    "csv_units_row": Expectation("read", _READ),
    "draw_broken_dot": Expectation(
        "the figures are printed, and metrics and trajectory are kept",
        both(
            says("printed [1-9]", r"files: (?s:.*)\bestimate\.tum\b(?s:.*)\bmetrics\.json\b"),
            silent("Traceback"),
        ),
    ),
    "draw_notebook_backend": Expectation("run --out works", both(says(r"^exit 0, printed [1-9]"))),
    "engine_casts": Expectation(
        "the same in four engines", both(alike(r"^(?:python|reference|xla|c) (\{.*\})$", 4))
    ),
    "engine_empty_clock": Expectation(
        "empty streams in four engines",
        both(alike(r"^(?:python|reference|xla|c) (\{'p': \[\], 'q': \[\]\})$", 4)),
    ),
    "engine_overflow_time": Expectation(
        "the first overflow in time, 2 ms, everywhere; the written C's status is not 0",
        both(
            lines(
                r"^(?:many )?(?:python|reference|xla|c) (.*)",
                lambda m: "early" in m[1] and "2000000 ns" in m[1],
                6,
            ),
            says(r"written C, replay: \['rc [^0]"),
        ),
    ),
    "engine_settings_changed": Expectation(
        "the values at build in four engines",
        both(
            lines(
                r"^(?:python|reference|xla|c) (\{.*\})$",
                lambda m: list(ast.literal_eval(m[1]).values()) == [[3.0]] + [[1.0]] * 5,
                4,
            )
        ),
    ),
    "engine_step_writes": Expectation("refused by its line, or alike in all engines", _pure_steps),
    "euler_at_the_pole": Expectation(
        "the way back is off by less than 1e-6 degrees",
        both(lines(r"off by \[?([^\s\]]+)\]? degrees", lambda m: float(m[1]) < 1e-6, 4)),
    ),
    "euroc_acc_in_g": Expectation("refused by its unit", both(refused("not in the unit|m/s"))),
    "euroc_imu_mount_ignored": Expectation(
        "readings are turned into the body, or T_BS is refused by name",
        both(
            either(both(figure("position_rmse_m", 0.018), figure("attitude_rmse_deg", 1.0)), refused("T_BS"))
        ),
    ),
    "euroc_no_sensor_yaml": Expectation(
        "a typical unit is assumed and said, or the error names the setting",
        either(both(figure("position_rmse_m", 0.03), noted("assumed")), refused(r"gyro\.noise")),
    ),
    "euroc_truth_8_columns": Expectation("scored against the poses", both(figure("position_rmse_m", 0.05))),
    "first_stamp_zero": Expectation(
        "refused, or the row left out with a note: line 2 and the step are named",
        both(
            says(r"line 2\b", r"year|step|1\.4e\+?0?9|1400000000"),
            either(
                refused(r"line 2\b", times=2),
                both(ran("gyro_integration"), figure("position_rmse_m", 0.1, run=0)),
            ),
        ),
    ),
    "gate_count_is_zero": Expectation(
        "the refusals of the gate are counted",
        both(
            figure("position_nis_rejected"),
            lambda o: o.runs[0]["position_nis_rejected"] + o.runs[0]["attitude_nis_rejected"] > 0,
        ),
    ),
    "gate_lockout_after_imu_gap": Expectation(
        "fixes are taken again, to some dm, or a note says how many were refused in a row",
        both(
            ran("ins_eskf", "ekf", "ins_ukf_pose"),
            either(figure("position_rmse_m", 0.5), noted("refused", r"\d+", "in a row|row of")),
        ),
    ),
    "gps_degrees_as_radians": Expectation("refused as no latitude", both(refused("latitude", "rad|deg"))),
    "heading_without_truth": Expectation(
        "the start heading is said to be assumed or unknown, or its error is covered",
        both(_heading_covered),
        'print(*came["flight"].notes, *came["case"].notes, *getattr(came["result"], "notes", ()), sep="\\n")',
    ),
    "hint_that_loses_data": Expectation(
        "equal stamps are named, and no remedy is to drop them", both(_twice_said)
    ),
    "imu_and_gps_no_graph": Expectation("gnss_ins runs", both(ran("gnss_ins"), silent("^error"))),
    "imu_gap_unsaid": Expectation(
        "a note says the gap, and the covariance knows of it",
        both(noted("gap", "imu"), figure("position_nis_mean", 3.0)),
    ),
    "kalman_R_as_vector": Expectation(
        "refused by its shape, or taken as the diagonal", both(_vector_of_noise)
    ),
    "live_full_match": Expectation("the IMU goes on", both(says("count 200$"))),
    "live_lost_packet": Expectation(
        "the run goes on, and no error is Python's own",
        # its program ends at an error that it expects to have caught; tests/engines/test_run.py has the rest
        lambda o: o.crash is not None and "name 'last' is not defined" in o.crash,
    ),
    "lost_track_zeros": Expectation(
        "read with such rows absent and counted, or refused with the line and a setting",
        both(
            either(
                both(figure("position_rmse_m", 0.05), noted(r"\d+ .*rows", "absent|left out|skipped|lost")),
                refused(r"line \d+", r"fix:.*\w=\w"),
            )
        ),
    ),
    "masked_array": Expectation(
        "masked entries go as NaN does, or are refused",
        both(silent(r"\b999\.0"), either(refused("mask|not finite"), says(r"\[1\.0, 3\.0, 4\.0\]"))),
    ),
    "names_in_c": Expectation(
        "all work in C and with make, or are refused when the graph is built", both(_names)
    ),
    "pandas_index_as_time": Expectation(
        "refused, or said; or the column that is a time is taken",
        either(_READ, refused("column|stamp|index"), noted("column|index|stamp", "assumed|warning")),
    ),
    "particle_diverges": Expectation(
        "near the measured poses, or the cloud is said to be depleted",
        both(
            lambda o: len(o.runs) == 4,
            either(figure("position_rmse_m", 0.05), noted("deplet|lost track|far from")),
        ),
    ),
    "plot_many_panels": Expectation(
        "every column has the numbers of its time axis",
        lambda o: (
            o.crash is None and re.search(r"columns: [1-9]\d* without numbers: 0", o.probed) is not None
        ),
        _LOW_COLUMNS,
    ),
    "plot_negative_variance": Expectation("a gap or a mark", both(says(r"drawn as (?:nan|--|None)"))),
    "replay_csv": Expectation(
        "each is refused with the row",
        both(
            lines(
                r"-> rc (\d+) (.*)$", lambda m: m[1] != "0" and bool(re.search(r"(?:row|line) \d+", m[2])), 10
            )
        ),
    ),
    "ros_bare_mcap": Expectation("read", both(ran("ins_eskf"), figure("position_nis_mean"))),
    "ros_clocks_apart": Expectation("refused, with the remedy", both(refused("span|overlap", "stamp=bag"))),
    "ros_gyro_absent_flag": Expectation(
        "refused by name, or absent",
        both(either(refused("angular_velocity|gyro"), noted("gyro|angular", "absent"))),
    ),
    "ros_names_collide": Expectation(
        "two streams, or an error that names both topics",
        both(either(_two_streams, refused("/a/pose", "/a_pose"))),
    ),
    "ros_odometry": Expectation("read", both(ran("ins_eskf"), figure("position_nis_mean"))),
    "ros_two_bodies_one_topic": Expectation(
        "both bodies are named", both(says(r"\bbody\b.*\bwand\b|\bwand\b.*\bbody\b"))
    ),
    "show_in_a_plain_terminal": Expectation(
        "a diagram in each",
        both(lines(r"^\w+: exit (\d+) (\d+) bytes", lambda m: m[1] == "0" and int(m[2]) > 100, 3)),
    ),
    "truth_dropout_interpolated": Expectation(
        "scored as without the dropout, and 100 rows are counted",
        both(
            noted("truth", "100"),
            lambda o: len(o.runs) == 3,
            figure("position_rmse_m", 0.016),
            figure("attitude_rmse_deg", 0.75),
        ),
    ),
    "tum_ns_stamps": Expectation(
        "read, or said to be nanoseconds", both(says(r"nanosecond|Series\(|unit=ns"))
    ),
    "two_files": Expectation("read", both(ran("ins_eskf"), figure("position_nis_mean", 100.0))),
    "two_studies_one_folder": Expectation("the second is refused", both(_one_study)),
    "ukf_known_start": Expectation(
        "it goes on in four engines, or the package's error says so",
        both(lines(r"^(?:python|reference|xla|c) (.*)$", lambda m: bool(_FINITE_OR_OURS.match(m[1])), 4)),
    ),
    "ukf_unknown_heading": Expectation(
        "the deviation stays pi, or is refused",
        either(
            refused("deviation|half a turn|sigma"), both(says(r"3\.14159\d* -> (?:3\.1[34]|[4-9]|[1-9]\d)"))
        ),
    ),
    "zero_force_first": Expectation(
        "started from the first usable reading, or the row is named",
        both(silent("went astray"), _good_start),
    ),
}
