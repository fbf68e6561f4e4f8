"""Tables that say themselves what they hold, and what is wrong with those that do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowgraph import Array, DataError, Flight, Series, Signal, load_flight, real, write_table
from flowgraph.errors import UnknownNameError


def table(tmp_path: Path, text: str) -> str:
    file = tmp_path / "log.csv"
    file.write_text(text)
    return f"table:{file}"


class Reading(Signal):
    rate: Array = real(3, unit="rad/s")
    spread: Array = real(2, 2)


def test_what_is_written_is_read_to_the_bit(tmp_path):
    rng = np.random.default_rng(1)
    often, seldom = np.arange(20) * 10**7 + 3, np.arange(5) * 4 * 10**7 + 3
    given = Flight(
        "log",
        {
            "gyro": Series(often, Reading(rate=rng.normal(size=(20, 3)), spread=rng.normal(size=(20, 2, 2)))),
            "depth": Series(seldom, rng.normal(size=5)),
        },
        truth=Series(often, Reading(rate=rng.normal(size=(20, 3)), spread=rng.normal(size=(20, 2, 2)))),
    )
    write_table(given, tmp_path / "log.csv")
    found = load_flight(f"table:{tmp_path / 'log.csv'}")
    assert found.truth is not None
    assert given.truth is not None
    for name, series in {**given.streams, "truth": given.truth}.items():
        other = found.truth if name == "truth" else found.streams[name]
        np.testing.assert_array_equal(other.time, series.time)
        for field, array in series.leaves.items():
            np.testing.assert_array_equal(other.leaves[field], array, err_msg=f"{name}.{field}")


def test_units_in_the_head_are_brought_to_si_and_settings_name_other_columns(tmp_path):
    spec = table(tmp_path, "ms,w [deg/s],x [cm],y [cm],s.t\n0,90,100,200,1\n10,180,,,2\n20,0,300,400,3\n")
    flight = load_flight(
        spec, settings={"time": "ms", "time.unit": "ms", "spin.rate": "w", "fix.position": "x,y"}
    )
    assert flight.streams["spin"].time.tolist() == [0, 10_000_000, 20_000_000]
    np.testing.assert_allclose(flight.streams["spin"]["rate"], [np.pi / 2, np.pi, 0.0])
    np.testing.assert_allclose(flight.streams["fix"]["position"], [[1.0, 2.0], [3.0, 4.0]])
    assert flight.streams["fix"].time.tolist() == [0, 20_000_000]
    assert flight.streams["s"]["t"].tolist() == [1.0, 2.0, 3.0]
    shifted = load_flight(spec, settings={"time": "ms", "time.unit": "ms", "s.time_offset": "0.005"})
    assert shifted.streams["s"].time[0] == 5_000_000


@pytest.mark.parametrize(
    ("text", "settings", "error", "said"),
    [
        ("time,7\n0,1\n1,2\n", {}, DataError, "names no stream"),
        ("a.b,c.d\n0,1\n1,2\n", {}, DataError, "no column is the time"),
        ("time,stamp,a.b\n0,1,2\n1,2,3\n", {}, DataError, "several columns may be the time"),
        ("time,a.b\n0,1\n1,2\n", {"c.d": "nope"}, UnknownNameError, "nope"),
        ("time,m.c.0.0,m.c.0.1,m.c.1.0\n0,1,2,3\n1,2,3,4\n", {}, DataError, "a matrix lacks an entry"),
        ("time,p.q.x [m],p.q.y [cm]\n0,1,2\n1,2,3\n", {}, DataError, "several units"),
        ("time,a.b\n0,1\n1,two\n", {}, DataError, "line 3"),
        ("time,a.b\n1,1\n0,2\n", {}, DataError, "line 3"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, text, settings, error, said):
    with pytest.raises(error) as caught:
        load_flight(table(tmp_path, text), settings=settings)
    assert said in str(caught.value)
    assert caught.value.fix
