"""Number formats: fractions from sizes, words and reals, the file, and their place in a pipeline."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Pipeline, PipelineError, lower
from flowgraph.pipeline.format_files import FILE, load_formats, save_formats, structure_of, with_formats
from flowgraph.pipeline.formats import (
    FREE,
    NOT_A_NUMBER,
    Formats,
    fraction_for,
    fraction_of_constant,
    real_numbers,
    whole_numbers,
)
from flowgraph.pipeline.plain import plain
from tests.graphs.library import library_case


@pytest.mark.parametrize("width", [8, 17, 24, 32])
def test_the_finest_fraction_in_which_a_size_fits(width):
    sizes = np.array([1e-3, 0.49999999999, 0.5, 1.0, 3.0, 1e5])
    for size in sizes:
        f = fraction_for(np.array(size), width)
        most = 2 ** (width - 1) - 1
        assert math.floor(math.ldexp(size, int(f)) + 0.5) <= most  # it fits
        assert math.floor(math.ldexp(size, int(f) + 1) + 0.5) > most  # and would not with a bit more
        found = real_numbers(whole_numbers(size, f, width), f)
        np.testing.assert_allclose(found, size, rtol=2.0 ** (1 - width))


def test_zeros_and_rounding_take_the_format_of_the_largest_beside_them():
    f = fraction_for(np.array([4.0, 0.0, 1e-19, 1e-6]), 24)
    assert f[0] == f[1] == f[2] == 20
    assert f[3] > 40
    assert fraction_of_constant(np.array([0.0, 2.0]), 24).tolist() == [FREE, 21]


def test_words_round_half_up_saturate_and_know_nan():
    f = np.array(0)
    assert whole_numbers([0.5, -0.5, 1.49, -1.51], f, 8).tolist() == [1, 0, 1, -2]
    assert whole_numbers([1e9, -1e9, math.inf, -math.inf], f, 8).tolist() == [127, -127, 127, -127]
    assert whole_numbers([math.nan], f, 8).tolist() == [NOT_A_NUMBER]
    assert math.isnan(real_numbers([NOT_A_NUMBER], f)[0])


@pytest.mark.parametrize("width", [7, 33])
def test_a_width_that_no_word_has(width):
    with pytest.raises(DeclarationError, match=f"(?s)expected: 8 to 32 bits.*got: +{width}"):
        Formats(width, {})


def _some(pipeline):
    cells = {c.read: np.full(c.shape, 12) for r in pipeline.registers for c in r.cells if c.dtype == "real"}
    return Formats(20, cells, 2.0, frozenset(list(cells)[:1]), structure_of(pipeline))


def test_formats_are_part_of_the_description(tmp_path):
    pipeline = plain(lower(library_case("kalman").graph))
    made = with_formats(pipeline, _some(pipeline))
    made.save(tmp_path)
    read = Pipeline.load(tmp_path)
    assert read.formats is not None and made.formats is not None  # noqa: PT018  for the checker
    assert read.formats.to_json() == made.formats.to_json()
    assert read.formats.width == 20
    assert len(read.formats.fractions) == len(made.formats.fractions) > 0


def test_formats_of_one_wider_width_were_written_otherwise_and_still_read():
    now = Formats(20, {3: np.array(4), 5: np.array(1)}, wider={3: 40, 5: 30})
    assert now.to_json()["held"] == [{"width": 30, "values": [5]}, {"width": 40, "values": [3]}]
    assert now.widest == 40
    before = {**now.to_json(), "held": {"width": 40, "values": [3]}}
    assert Formats.from_json(before).wider == {3: 40}


def test_a_description_of_version_1_still_reads():
    data = lower(library_case("kalman").graph).to_json()
    assert data["version"] == 2
    assert "formats" not in data
    assert Pipeline.from_json({**data, "version": 1}).formats is None


def test_a_description_with_formats_that_fit_nothing_is_refused():
    pipeline = plain(lower(library_case("kalman").graph))
    data = json.loads(json.dumps(with_formats(pipeline, _some(pipeline)).to_json()))
    value = data["formats"]["fractions"][0]["value"]
    data["formats"]["fractions"][0]["fraction"] = [[1, 2, 3, 4, 5, 6, 7, 8, 9]]
    with pytest.raises(PipelineError, match=f"value {value}: a number format fits no value"):
        Pipeline.from_json(data)
    data["formats"]["fractions"][0]["fraction"] = "twelve"
    with pytest.raises(PipelineError, match="(?s)the number formats are malformed"):
        Pipeline.from_json(data)


def test_the_file_is_read_as_it_was_written(tmp_path):
    pipeline = plain(lower(library_case("kalman").graph))
    formats = _some(pipeline)
    file = save_formats(tmp_path / "new", "kalman", formats, {"bits": 20}, [{"value": 1}])
    assert file.name == FILE
    assert load_formats(tmp_path / "new").to_json() == formats.to_json()
    assert load_formats(file).margin == 2.0


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"format": "flowgraph-formats", "version": 9}'])
def test_a_file_that_holds_no_formats(tmp_path, text):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(DataError, match="(?s)no number formats can be read here.*flowgraph quantise"):
        load_formats(tmp_path)


def test_formats_of_another_graph_are_refused():
    formats = _some(plain(lower(library_case("kalman").graph)))
    with pytest.raises(DeclarationError, match="(?s)for another graph, or for other settings"):
        with_formats(lower(library_case("ekf").graph), formats)
