"""Untrusted files are used as they are, or a ``ValueError`` explains what is wrong with them."""

from __future__ import annotations

import io
import json
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from sb3_flowpolicy.algorithms.demonstrations import KEYS, load_demonstrations
from sb3_flowpolicy.common.files import read_json
from sb3_flowpolicy.experiments.store import BASIC_COLUMNS, ItemFiles
from tests.bundle.mutations import Evil, by_chance
from tests.fuzz.effort import fuzz
from tests.fuzz.test_configuration import ANYTHING, works_or_says_why


def npz(**changes: Any) -> bytes:
    file = io.BytesIO()
    arrays = {key: np.zeros((6, 2)) for key in KEYS[:2]} | {"next_observations": np.zeros((6, 2))}
    np.savez(file, **{key: arrays.get(key, np.zeros(6)) for key in KEYS} | changes)
    return file.getvalue()


def assert_plain(arrays: dict[str, np.ndarray] | None) -> None:
    if arrays is not None:
        assert list(arrays) == list(KEYS)
        assert all(np.isfinite(array).all() for array in arrays.values())
        assert len({len(array) for array in arrays.values()}) == 1


@fuzz(300)
@given(seed=st.integers(0, 2**32))
def test_spoiled_demonstrations(tmp_path: Path, seed: int) -> None:
    path = tmp_path / "demos.npz"
    rng = np.random.default_rng(seed)
    content = npz()
    for _ in range(int(rng.integers(1, 4))):
        content = by_chance(content, rng) or b"x"
        if len(content) < 9:
            break
    path.write_bytes(content)
    assert_plain(works_or_says_why(load_demonstrations, path))


@fuzz(150)
@given(
    key=st.sampled_from(KEYS),
    array=npst.arrays(
        st.one_of(npst.scalar_dtypes(), npst.unicode_string_dtypes(), npst.byte_string_dtypes()),
        npst.array_shapes(min_dims=0, max_dims=3, max_side=6),
    ),
)
def test_demonstrations_of_any_type_and_shape(tmp_path: Path, key: str, array: Any) -> None:
    (tmp_path / "demos.npz").write_bytes(npz(**{key: array}))
    assert_plain(works_or_says_why(load_demonstrations, tmp_path / "demos.npz"))
    assert_plain(works_or_says_why(load_demonstrations, {**load(tmp_path), key: array}))


def load(tmp_path: Path) -> dict[str, np.ndarray]:
    (tmp_path / "good.npz").write_bytes(npz())
    return load_demonstrations(tmp_path / "good.npz")


@fuzz(150)
@given(source=ANYTHING | st.dictionaries(st.sampled_from(KEYS), ANYTHING))
def test_demonstrations_that_are_no_file(source: Any) -> None:
    assert_plain(works_or_says_why(load_demonstrations, source))


def test_demonstrations_are_never_unpickled(tmp_path: Path) -> None:
    trace, path = tmp_path / "executed", tmp_path / "demos.npz"
    objects = np.array([Evil(trace)] * 6, dtype=object)
    path.write_bytes(npz(rewards=objects))
    with pytest.raises(ValueError, match=r"an \.npz file of arrays of numbers, got .*demos"):
        load_demonstrations(path)
    path.write_bytes(pickle.dumps(Evil(trace)))
    with pytest.raises(ValueError, match=r"must be arrays or an \.npz file of arrays of numbers"):
        load_demonstrations(path)
    assert not trace.exists()
    np.load(io.BytesIO(npz(rewards=objects)), allow_pickle=True)["rewards"]
    assert trace.exists()  # or the test would prove nothing


def test_arrays_that_promise_more_than_they_have_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "demos.npz"
    head = {"descr": "<f8", "fortran_order": False, "shape": (2**40,)}
    with zipfile.ZipFile(path, "w") as archive:
        for key in KEYS:
            member = io.BytesIO()
            np.lib.format.write_array_header_1_0(member, head)
            archive.writestr(f"{key}.npy", member.getvalue())
    with pytest.raises(ValueError, match=r"an \.npz file of arrays of numbers, got"):
        load_demonstrations(path)


@fuzz(300)
@given(
    table=st.binary(max_size=80)
    | st.text(alphabet="0123456789.,-+einfa\n\r\"' \u2028\x0b\x00", max_size=80).map(str.encode),
    head=st.booleans(),
)
def test_result_tables(tmp_path: Path, table: bytes, head: bool) -> None:
    files = ItemFiles(tmp_path, "item")
    files.table.write_bytes((",".join(BASIC_COLUMNS).encode() + b"\n") * head + table)
    files.details.write_bytes(table)
    rows = works_or_says_why(files.read_table)
    assert rows is None or np.isfinite(rows["step"].astype(float)).all()
    details = works_or_says_why(files.read_details)
    assert details is None or isinstance(details, list)


@fuzz(300)
@given(content=st.binary(max_size=80))
def test_json_files(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    works_or_says_why(read_json, tmp_path / "a.json")


@fuzz(100)
@given(value=ANYTHING.filter(lambda value: isinstance(value, dict | list | str | int | float)))
def test_json_of_any_kind(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value, default=str, skipkeys=True) + "\n")
    content = works_or_says_why(read_json, path)
    assert content is None or isinstance(content, dict)
    path.write_text("[" * 100_000 + "\n")
    with pytest.raises(ValueError, match="must be JSON"):
        read_json(path)
