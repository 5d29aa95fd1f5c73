"""Datasets of others: followed in simulation, or refused by name."""

from __future__ import annotations

import contextlib
import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dual_ur10.errors import DatasetError, DualUR10Error, RecordingError
from dual_ur10.lerobot import dataset_reader, parquet_pages
from dual_ur10.lerobot.dataset_reader import read_dataset
from dual_ur10.lerobot.dataset_writer import DatasetWriter
from dual_ur10.lerobot.resimulation import JointColumns, follow_motions, joints_in, simulate_again
from tests.cli.command import run as command
from tests.lerobot.conftest import foreign

UR = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
LEFT, RIGHT = tuple(range(6)), tuple(range(6, 12))


@pytest.mark.parametrize(
    ("names", "size", "places"),
    [
        (
            [f"{arm}_{each}.pos" for arm in ("left", "right") for each in (*UR, "gripper")],
            14,
            (LEFT, tuple(range(7, 13))),
        ),
        ([f"{each}_joint" for each in UR], 6, (LEFT, None)),
        ([f"joint_{k}" for k in range(1, 7)] + ["gripper"], 7, (LEFT, None)),
        ([f"joint{k}.pos" for k in range(6)], 6, (LEFT, None)),
        (["right_base", "right_shoulder", *(f"right_{each}" for each in UR[2:])], 6, (None, LEFT)),
        ([*(f"right_j{k}" for k in range(1, 7)), *(f"left_j{k}" for k in range(1, 7))], 12, (RIGHT, LEFT)),
        ([], 14, (LEFT, tuple(range(7, 13)))),
    ],
)
def test_joints_are_found_by_their_names(names, size, places):
    assert joints_in(names, size, "it") == places


@pytest.mark.parametrize(
    ("names", "size"), [(["x", "y", "z"], 3), (UR[:5], 5), ([], 8), ([f"joint_{k}" for k in range(1, 8)], 7)]
)
def test_other_names_are_refused(names, size):
    with pytest.raises(DatasetError, match=r"no six joints .* --left 0:6"):
        joints_in(names, size, "it")


def test_motions_of_other_arms_are_followed(tmp_path):
    """One arm in degrees at 30 frames per second: the left arm follows, and the right one stays at its start."""
    start = np.array([0.0, -1.6, 1.9, -1.9, -1.57, 0.0])
    times = np.arange(31)[:, None] / 30
    motion = start + 0.1 * np.sin(2 * times) * np.array([1, 0.5, -0.5, 0, 1, 1])
    foreign(DatasetWriter, tmp_path / "dataset", [motion[:4], motion], degrees=True)
    dataset = read_dataset(tmp_path / "dataset")
    with pytest.raises(DatasetError, match=r"beyond 2π: its unit is another one \(--degrees\)"):
        follow_motions(dataset, JointColumns("action", (LEFT, None)))
    (found,) = follow_motions(dataset, JointColumns("action", (LEFT, None), degrees=True), [1])
    assert (found.steps, found.ended_by, found.difference) == (26, "", "")
    assert found.largest_rad < 1e-3
    code, text = command("import", "lerobot", str(dataset.folder), "--degrees", "-e", "0", "--no-record")
    assert (code, "episode 0: 3 of 3 steps" in text) == (0, True), text
    for option in (("--left", "0:7"), ("--left", "x"), ("--left", "2:8"), ("--feature", "state")):
        assert command("import", "lerobot", str(dataset.folder), "--degrees", "--no-record", *option)[0] == 2


def table_of(folder):
    return folder / "data/chunk-000/file-000.parquet"


def changed(name, change):
    def apply(folder):
        table = pq.read_table(table_of(folder))
        values = change(np.array(table[name].to_pylist()))
        column = pa.array(values.tolist(), table.schema.field(name).type)
        pq.write_table(table.set_column(table.column_names.index(name), name, column), table_of(folder))

    return apply


def stated(**entries):
    def apply(folder):
        path = folder / "meta/info.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | entries))

    return apply


def features_stated(name, **entries):
    def apply(folder):
        features = json.loads((folder / "meta/info.json").read_text())["features"]
        stated(features=features | {name: features.get(name, {}) | entries})(folder)

    return apply


def without_column(folder):
    pq.write_table(pq.read_table(table_of(folder)).drop_columns(["action"]), table_of(folder))


def as_text(folder):
    table = pq.read_table(table_of(folder))
    place = table.column_names.index("next.reward")
    pq.write_table(table.set_column(place, "next.reward", pa.array(["1"] * len(table))), table_of(folder))


def with_pipe(folder):
    os.mkfifo(folder / "data/chunk-000/file-001.parquet")


def nan(values):
    values[3, 2] = np.nan
    return values


@pytest.mark.parametrize("entry", [{"dtype": "string"}, {"dtype": "float64"}, {"shape": [1, 1]}])
@pytest.mark.parametrize("name", ["timestamp", "episode_index"])
def test_the_index_of_frames_is_what_every_dataset_has_whatever_it_states(made, tmp_path, name, entry):
    folder = shutil.copytree(made[1], tmp_path / "dataset")
    features_stated(name, **entry)(folder)
    found, expected = read_dataset(folder).columns[name], read_dataset(made[1]).columns[name]
    assert (found.dtype, found.tolist()) == (expected.dtype, expected.tolist())


def test_words_of_a_dataset_are_no_markup(made, tmp_path):
    folder = shutil.copytree(made[1], tmp_path / "dataset")
    features_stated("[/a]", dtype="[/b]", shape=[1], names=["[/c]"])(folder)
    code, text = command("import", "lerobot", str(folder), "--inspect")
    assert (code, [f"[/{each}]" in text for each in "abc"]) == (0, [True] * 3), text


BAD = {
    "no info": (lambda folder: (folder / "meta/info.json").unlink(), "info.json is missing"),
    "no JSON": (lambda folder: (folder / "meta/info.json").write_text("{"), "info.json is no JSON"),
    "nested": (lambda folder: (folder / "meta/info.json").write_text("[" * 10**5), "info.json is no JSON"),
    "NaN": (lambda folder: (folder / "meta/info.json").write_text('{"fps": NaN}'), "holds NaN"),
    "no data": (lambda folder: table_of(folder).unlink(), "has no data/chunk-000"),
    "cut off": (
        lambda folder: table_of(folder).write_bytes(table_of(folder).read_bytes()[:-9]),
        "cannot read .*parquet",
    ),
    "pipe": (with_pipe, r"cannot read .*file-001\.parquet: it is no regular file"),
    "version 2.0": (stated(codebase_version="v2.0"), "states the version 'v2.0': v3.0 and v2.1 are read"),
    "version 4": (stated(codebase_version="v4.0"), "states the version 'v4.0'"),
    "no version": (stated(codebase_version=3), "states the version 3"),
    "rate": (stated(fps=30), r"is at 0\.0400 s, and at 30 frames per second belongs to 0\.0333 s"),
    "no rate": (stated(fps=0), "is not legal: fps"),
    "no motion": (stated(fps=2.0**-30), "is not legal: fps"),
    "features": (stated(features={}), "no feature 'timestamp'"),
    "frames": (stated(total_frames=15), "has 14 frames, and meta/info.json states 15"),
    "episodes": (stated(total_episodes=3), "not those of episodes 0 to 2"),
    "column": (without_column, "no column 'action'"),
    "type": (as_text, "next.reward"),
    "not finite": (changed("action", nan), "action has values that are not finite"),
    "order": (changed("episode_index", lambda values: values[::-1]), "not those of episodes 0 to 1"),
    "negative": (changed("episode_index", lambda values: values - 1), "not those of episodes 0 to 1"),
    "times": (changed("timestamp", lambda values: values + 0.005), "another rate than it states"),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_a_dataset_that_is_not_as_it_states_is_refused(made, tmp_path, change, message):
    shutil.copytree(made[1], tmp_path / "dataset")
    change(tmp_path / "dataset")
    with pytest.raises(DatasetError, match=message):
        read_dataset(tmp_path / "dataset")


@pytest.mark.parametrize("column", ["chunk_index", "file_index"])
@pytest.mark.parametrize(
    ("places", "message"),
    [
        (["0", "x"], "is of type BYTE_ARRAY: expected are numbers"),
        ([0.0, np.nan], "is double, expected is int64"),
        ([0.0, np.inf], "is double, expected is int64"),
        ([0, None], "2 values in 2 rows"),
        ([[0], [None]], "2 values in 2 rows"),
        ([0, -1], "has a negative chunk or file of 'observation.images.front'"),
    ],
)
def test_places_of_videos_that_are_no_numbers_are_refused(made, tmp_path, column, places, message):
    folder, key = shutil.copytree(made[1], tmp_path / "dataset"), "observation.images.front"
    features = json.loads((folder / "meta/info.json").read_text())["features"]
    stated(features=features | {key: {"dtype": "video", "shape": [8, 8, 3]}})(folder)
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    for name in ("chunk_index", "file_index"):
        table = table.append_column(f"videos/{key}/{name}", pa.array(places if name == column else [0, 0]))
    pq.write_table(table, path)
    with pytest.raises(DatasetError, match=message):
        read_dataset(folder)


def varint(number, size=0):
    """A number without a sign in Thrift's compact protocol, of at least so many bytes."""
    found = bytearray()
    while number or len(found) < size or not found:
        found.append(number & 127 | 128)
        number >>= 7
    found[-1] &= 127
    return bytes(found)


@pytest.mark.parametrize("name", ["action", "observation.state"])
@pytest.mark.parametrize("lies", [False, True], ids=["honest", "lying"])
def test_a_small_file_of_many_values_is_refused_before_it_is_unpacked(made, tmp_path, lies, name):
    """Equal values take no space. The footer may state fewer of them than a page holds: Arrow unpacks the page."""
    shutil.copytree(made[1], tmp_path / "dataset")
    path = table_of(tmp_path / "dataset")
    table, count = pq.read_table(path), 3_000_000
    size = len(table[name][0])
    rows = [np.zeros(count), *np.zeros((len(table) - 1, size))]
    column = pa.array(rows, pa.list_(pa.float32()))
    bomb = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(bomb, path, compression="zstd", write_statistics=False)
    total = count + (len(table) - 1) * size
    if lies:
        data, stated = path.read_bytes(), varint(2 * total)
        at = data.index(stated, len(data) - 8 - int.from_bytes(data[-8:-4], "little"))  # in the footer
        lie = varint(2 * len(table) * size, len(stated))
        path.write_bytes(data[:at] + lie + data[at + len(stated) :])
        assert pq.read_table(path)[name].nbytes >= 4 * count
    assert path.stat().st_size < 2**16
    message = f"{name}: the file is damaged, or not as it states: {total} values in 14 rows"
    assert unpacked_until(message, tmp_path / "dataset") < count


def unpacked_until(message, folder):
    """Return the bytes that Arrow took until a dataset was refused."""
    pool = pa.proxy_memory_pool(before := pa.default_memory_pool())
    pa.set_memory_pool(pool)
    try:
        with pytest.raises(DatasetError, match=message):
            read_dataset(folder)
    finally:
        pa.set_memory_pool(before)
    return pool.max_memory()


def test_long_texts_in_place_of_numbers_are_refused_before_they_are_unpacked(made, tmp_path):
    path = table_of(shutil.copytree(made[1], tmp_path / "dataset"))
    table, size = pq.read_table(path), 1_000_000
    texts = pa.array(["x" * size] * len(table)).dictionary_encode()
    pq.write_table(
        table.set_column(table.column_names.index("next.reward"), "next.reward", texts), path, store_schema=False
    )
    assert path.stat().st_size < 2**17
    assert unpacked_until("next.reward is of type BYTE_ARRAY", tmp_path / "dataset") < size


def test_values_are_counted_before_they_are_unpacked(made, monkeypatch):
    monkeypatch.setattr(dataset_reader, "MOST_BYTES", 1000)
    with pytest.raises(DatasetError, match="the dataset has more than 1000 bytes of tables"):
        read_dataset(made[1])


def test_a_page_of_fewer_values_than_none_makes_up_for_no_other(made, tmp_path):
    path = table_of(shutil.copytree(made[1], tmp_path / "dataset"))
    chunk = next(
        each
        for each in map(pq.read_metadata(path).row_group(0).column, range(40))
        if each.path_in_schema.startswith("action")
    )
    data, stated = bytearray(path.read_bytes()), varint(2 * chunk.num_values)
    data[data.index(stated, chunk.data_page_offset)] |= 1  # the sign is the last bit
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=rf"a page of -{chunk.num_values + 1} values"):
        read_dataset(tmp_path / "dataset")


@pytest.mark.parametrize(
    ("header", "found"),
    [
        (b"\x19\xf7" + varint(2**20), f"{2**20} bytes or values in"),  # doubles; of 2^60 nothing would return
        (b"\x19\xf8" + varint(2**20), f"{2**20} bytes or values in"),
        (b"\x18" + varint(2**60), f"{2**60} bytes or values in"),
        (b"\x19" * 2000, "recursion"),
        (b"\x1c" * 2000, "recursion"),
        (b"\x15\0\x15" + varint(2**31) + b"\x15\2\x2c\x15\2\0\0", f"a page of 1 values in 1 bytes, unpacked {2**30}"),
    ],
    ids=["doubles", "binaries", "binary", "lists", "structs", "zeros"],
)
def test_headers_of_pages_promise_no_more_than_their_bytes(header, found, made, tmp_path):
    metadata = pq.read_metadata(table_of(made[1]))
    first = metadata.row_group(0).column(0)
    path = tmp_path / "damaged.parquet"
    path.write_bytes(table_of(made[1]).read_bytes()[: first.data_page_offset] + header)
    sizes = {first.path_in_schema.removesuffix(".list.element"): first.num_values // metadata.row_group(0).num_rows}
    with pytest.raises(DatasetError, match=rf"the header of a page is damaged \(.*{found}"):
        parquet_pages.check_sizes(path, metadata, sizes)


@given(data=st.data())
def test_damaged_pages_are_refused_by_name(data, tmp_path_factory, made):
    path = tmp_path_factory.getbasetemp() / "damaged.parquet"
    whole = bytearray(table_of(made[1]).read_bytes())
    metadata = pq.read_metadata(table_of(made[1]))
    first = metadata.row_group(0).column(0)
    for _ in range(data.draw(st.integers(1, 4))):
        whole[first.data_page_offset + data.draw(st.integers(0, 40))] = data.draw(st.integers(0, 255))
    path.write_bytes(whole)
    size = first.num_values // metadata.row_group(0).num_rows
    with contextlib.suppress(DatasetError):
        sizes = {first.path_in_schema.removesuffix(".list.element"): size}
        assert parquet_pages.check_sizes(path, metadata, sizes) == metadata.num_rows * size


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=3,
)


@settings(max_examples=80)
@given(data=st.data())
def test_damage_of_any_kind_is_a_named_error(made, tmp_path_factory, data):
    """Another value in a place of the description, or some other bytes in a table or a description."""
    folder = tmp_path_factory.mktemp("damaged") / "dataset"
    shutil.copytree(made[1], folder)
    if data.draw(st.booleans()):
        path = folder / "meta/info.json"
        info = place = json.loads(path.read_text())
        key = data.draw(st.sampled_from([*info]))
        while isinstance(place[key], dict) and data.draw(st.booleans()):
            place = place[key]
            key = data.draw(st.sampled_from([*place]))
        place[key] = data.draw(VALUES)
        path.write_text(json.dumps(info))
    else:
        path = data.draw(st.sampled_from([table_of(folder), folder / "meta/info.json", folder / "meta/dual_ur10.json"]))
        content = bytearray(path.read_bytes())
        begin = data.draw(st.integers(0, len(content)))
        content[begin : begin + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=9))
        path.write_bytes(content)
    try:
        read_dataset(folder)
    except DatasetError:
        pass
    finally:
        shutil.rmtree(folder)


def test_a_shape_that_is_not_as_it_states_is_refused(made, tmp_path):
    shutil.copytree(made[1], tmp_path / "dataset")
    path = tmp_path / "dataset/meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["action"]["shape"] = [12]
    path.write_text(json.dumps(info))
    with pytest.raises(DatasetError, match="126 values in 9 rows, expected are 12 in each"):
        read_dataset(tmp_path / "dataset")


def test_nothing_that_a_dataset_names_is_imported(made, tmp_path):
    """Its runs name registered environments alone, and paths that it states are not followed."""
    shutil.copytree(made[1], tmp_path / "dataset")
    stated(data_path="/etc/{chunk_index.__class__}", video_path="../../{file_index}")(tmp_path / "dataset")
    read_dataset(tmp_path / "dataset")
    path = tmp_path / "dataset/meta/dual_ur10.json"
    own = json.loads(path.read_text())
    for change, error, message in (
        ({"runs": [own["runs"][0] | {"header": own["runs"][0]["header"].replace("Handover-v0", "os:system")}]},
         RecordingError, "checksum is wrong"),
        ({"episodes": own["episodes"][:1]}, DatasetError, "describes 1 episodes of 1 runs, and the dataset has 2"),
        ({"format": "2"}, DatasetError, "not of format 1"),
        ({"episodes": [own["episodes"][0] | {"run": 5}] * 2}, DatasetError, "describes 2 episodes of 1 runs"),
        ({"episodes": [own["episodes"][0] | {"generator": "{}"}] * 2}, RecordingError, "generator of episode 0"),
    ):  # fmt: skip
        path.write_text(json.dumps(own | change))
        with pytest.raises(error, match=message):
            simulate_again(read_dataset(tmp_path / "dataset"))
    assert issubclass(DatasetError, DualUR10Error)
