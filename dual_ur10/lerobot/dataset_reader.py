"""Reader of LeRobot's datasets, ours and those of others. Nothing in a dataset is executed or imported."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dual_ur10.errors import DatasetError, MissingExtraError
from dual_ur10.lerobot.dataset_writer import OWN
from dual_ur10.lerobot.features import ACTION, DEFAULTS, DatasetFeature
from dual_ur10.lerobot.image_video import check_video
from dual_ur10.lerobot.parquet_pages import check_sizes
from ur_core.files import read_named

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise MissingExtraError("pyarrow", "lerobot", "a LeRobot dataset") from error

VERSIONS: Final = ("v3.", "v2.1")
"""Beginnings of the versions of the format that are read."""

MOST_BYTES: Final = 8 * 2**30
"""Largest size of the tables of a dataset, unpacked."""

_VALUE_BYTES: Final = 8  # of the largest kind
_MOST_JSON: Final = 64 * 2**20
_MOST_FEATURES: Final = 1000
_TIME_S: Final = 1e-3  # largest distance of a frame from the grid
_PLACE: Final = DatasetFeature("int64", (1,))
_KINDS: Final = {"float32", "float64", "int64", "int32", "bool"}


class _FeatureInfo(BaseModel):
    """A feature in `meta/info.json`, whose further entries do not count."""

    model_config = ConfigDict(extra="ignore")
    dtype: Annotated[str, Field(max_length=40)]
    shape: Annotated[list[Annotated[int, Field(ge=1, le=100_000)]], Field(max_length=4)]
    names: Any = None


class _DatasetInfo(BaseModel):
    """Content of `meta/info.json` that the reader needs."""

    model_config = ConfigDict(extra="ignore", allow_inf_nan=False)
    codebase_version: Annotated[str, Field(max_length=40)]
    fps: Annotated[float, Field(ge=0.1, le=10_000.0)]  # a motion is resampled between its frames
    features: Annotated[dict[str, _FeatureInfo], Field(max_length=_MOST_FEATURES)]
    total_episodes: Annotated[int, Field(ge=0)]
    total_frames: Annotated[int, Field(ge=0)]
    robot_type: str | None = None


@dataclass(frozen=True)
class Dataset:
    """A dataset, without its images.

    Attributes:
        folder: Its folder.
        version: Version of its format, such as "v3.0".
        fps: Frames per second.
        robot_type: Name of the robot; "": none is stated.
        features: Features by name.
        lengths: Number of frames of each episode.
        columns: Values of each feature over all frames, (frames, size), or (frames,) of single values. Features that
            are images or texts have none.
        own: Content of `meta/dual_ur10.json`; None: it was not exported by this package.
    """

    folder: Path
    version: str
    fps: float
    robot_type: str
    features: dict[str, DatasetFeature]
    lengths: list[int]
    columns: dict[str, NDArray[Any]]
    own: dict[str, Any] | None

    def __repr__(self) -> str:
        about = f"{self.version}, {len(self.lengths)} episodes, {sum(self.lengths)} frames, {self.fps:g} fps"
        return f"{type(self).__name__}({self.folder}, {about})"

    def episode(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the columns of an episode.

        Raises:
            DatasetError: There is none of this number.
        """
        if not 0 <= number < len(self.lengths):
            raise DatasetError(f"{self.folder} has episodes 0 to {len(self.lengths) - 1}: there is no episode {number}")
        begin = sum(self.lengths[:number])
        return {name: each[begin : begin + self.lengths[number]] for name, each in self.columns.items()}


def read_dataset(folder: str | Path) -> Dataset:
    """Read a dataset of format v3 or v2.1. Paths that it states are not followed, those of the format are.

    Raises:
        DatasetError: A file is missing, cut off or no such file; the version is not supported; or the tables hold other
            features, lengths, rates or values than it states. The message names the file and the remedy.
    """
    folder = Path(folder).absolute()  # Arrow and PyAV take the beginning of "a:b" for a protocol
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}: name that of a dataset, which holds meta/info.json")
    info = _info(folder)
    features = {name: DatasetFeature(each.dtype, tuple(each.shape), each.names) for name, each in info.features.items()}
    for name in DEFAULTS:
        if name not in features:
            raise DatasetError(f"{folder}/meta/info.json has no feature {name!r}, which every dataset has")
    features |= DEFAULTS  # whatever it states of them
    columns = _columns(folder, features)
    lengths = _lengths(folder, info, columns)
    _check_grid(folder, info.fps, lengths, columns)
    _check_videos(folder, info, features, lengths)
    own = folder / OWN
    return Dataset(
        folder,
        info.codebase_version,
        info.fps,
        info.robot_type or "",
        features,
        lengths,
        columns,
        _json(own) if own.exists() else None,
    )


def _json(path: Path) -> Any:
    """Return the value of a JSON file of the dataset."""

    def refuse(constant: str) -> Any:
        raise DatasetError(f"{path} holds {constant}: numbers must be finite")

    text = read_named(path, _MOST_JSON, DatasetError, absent=f"{path} is missing: copy the whole dataset again")
    if len(text) > _MOST_JSON:
        raise DatasetError(f"{path} has more than {_MOST_JSON} bytes: it is not of a dataset")
    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:  # the latter: brackets within brackets
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{path} is no JSON: {error!s:.200}. Copy it again") from error


def _info(folder: Path) -> _DatasetInfo:
    path = folder / "meta/info.json"
    stated = _json(path)
    version = stated.get("codebase_version") if isinstance(stated, dict) else None
    if not isinstance(version, str) or not version.startswith(VERSIONS):
        raise DatasetError(
            f"{path} states the version {version!r:.80}: v3.0 and v2.1 are read. Convert the dataset with the LeRobot "
            "that made it"
        )
    try:
        return _DatasetInfo.model_validate(stated)
    except ValidationError as error:
        found = "; ".join(f"{'.'.join(map(str, each['loc']))}: {each['msg']}" for each in error.errors()[:5])
        raise DatasetError(f"{path} is not legal: {found}") from None


def _columns(folder: Path, features: dict[str, DatasetFeature]) -> dict[str, NDArray[Any]]:
    """Return the values of all features that are numbers."""
    files = sorted(folder.glob("data/chunk-*/*.parquet"), key=_number_of)
    if not files:
        raise DatasetError(f"{folder} has no data/chunk-000/*.parquet: copy the whole dataset again")
    wanted = {name: each for name, each in features.items() if each.dtype in _KINDS}
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in wanted}
    size = 0
    for path in files:
        table, more = _table(path, {name: each.size for name, each in wanted.items()}, MOST_BYTES - size)
        size += more
        for name, feature in wanted.items():
            parts[name].append(_values(table.column(name), feature, f"{path}, {name}"))
    return {name: np.concatenate(each) for name, each in parts.items()}


def _table(path: Path, sizes: dict[str, int], most_bytes: int) -> tuple[Any, int]:
    """Return the columns of a Parquet file with so many values in each row, and their bytes.

    Raises:
        DatasetError: The file cannot be read, lacks a column, has other sizes, or more bytes than it may have.
    """
    if not path.is_file():  # a pipe would keep the reader waiting
        raise DatasetError(f"cannot read {path}: it is no regular file. Copy the whole dataset again")
    try:
        with pq.ParquetFile(path) as file:
            missing = [name for name in sizes if name not in file.schema_arrow.names]
            if missing:
                raise DatasetError(f"{path} has no column {missing[0]!r}, which meta/info.json states")
            size = _VALUE_BYTES * check_sizes(path, file.metadata, sizes)
            if size > most_bytes:
                raise DatasetError(
                    f"{path}: the dataset has more than {MOST_BYTES} bytes of tables: take some of its episodes"
                )
            return file.read(columns=[*sizes]), size
    except (OSError, ValueError, KeyError, pa.ArrowException) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"cannot read {path}: {error!s:.200}. Copy it again") from error


def _number_of(path: Path) -> list[int]:
    return [int(each) for each in re.findall(r"\d+", f"{path.parent.name} {path.name}")]


def _values(column: Any, feature: DatasetFeature, what: str) -> NDArray[Any]:
    """Return the values of a column, (rows, *shape), or (rows,) of single values."""
    rows = len(column)
    combined: Any = column.combine_chunks()
    if isinstance(combined, pa.ChunkedArray):  # of no rows
        combined = pa.concat_arrays(combined.chunks) if combined.num_chunks else pa.array([], column.type)
    while pa.types.is_list(combined.type) or pa.types.is_fixed_size_list(combined.type):
        if combined.null_count:
            raise DatasetError(f"{what}: a value is missing")
        combined = combined.flatten()
    shape = () if feature.shape == (1,) else feature.shape
    if len(combined) != rows * feature.size or combined.null_count:
        raise DatasetError(f"{what}: {len(combined)} values in {rows} rows, expected are {feature.size} in each")
    try:
        values = np.asarray(combined.to_numpy(zero_copy_only=False)).astype(feature.dtype, casting="same_kind")
    except (TypeError, pa.ArrowException) as error:
        raise DatasetError(f"{what} is {combined.type}, expected is {feature.dtype}: {error}") from None
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise DatasetError(f"{what} has values that are not finite")
    return values.reshape(rows, *shape)


def _lengths(folder: Path, info: _DatasetInfo, columns: dict[str, NDArray[Any]]) -> list[int]:
    """Return the lengths of the episodes, whose frames follow each other."""
    episodes = columns["episode_index"]
    if len(episodes) != info.total_frames:
        raise DatasetError(
            f"{folder} has {len(episodes)} frames, and meta/info.json states {info.total_frames}: a file is missing, "
            "or is of another dataset"
        )
    known = (episodes >= 0) & (episodes < min(info.total_episodes, len(episodes)))  # no number takes memory
    lengths = np.bincount(episodes[known], minlength=min(info.total_episodes, len(episodes)))
    whole = np.repeat(np.arange(len(lengths)), lengths)
    if len(lengths) != info.total_episodes or not lengths.all() or not np.array_equal(whole, episodes):
        raise DatasetError(
            f"{folder}: the frames are not those of episodes 0 to {info.total_episodes - 1}, one after the other: a "
            "file is missing, or is of another dataset"
        )
    found: list[int] = lengths.tolist()
    return found


def _check_grid(folder: Path, fps: float, lengths: list[int], columns: dict[str, NDArray[Any]]) -> None:
    """Make sure that the frames lie on the grid of the stated rate."""
    frames = np.concatenate([np.arange(each) for each in lengths]) if lengths else np.zeros(0)
    away = np.abs(columns["timestamp"].astype(np.float64) - frames / fps)
    if (away > _TIME_S).any():
        row = int((away > _TIME_S).argmax())
        raise DatasetError(
            f"{folder}: frame {int(frames[row])} of episode {int(columns['episode_index'][row])} is at "
            f"{columns['timestamp'][row]:.4f} s, and at {fps:g} frames per second belongs to {frames[row] / fps:.4f} "
            "s: the dataset is of another rate than it states"
        )


def _check_videos(folder: Path, info: _DatasetInfo, features: dict[str, DatasetFeature], lengths: list[int]) -> None:
    """Make sure that the videos exist and are long enough."""
    for key in (name for name, each in features.items() if each.dtype == "video"):
        for path, frames in _videos(folder, info, key, lengths):
            if not path.is_file():
                raise DatasetError(f"{path} is missing: copy the whole dataset again")
            check_video(path, frames)


def _videos(folder: Path, info: _DatasetInfo, key: str, lengths: list[int]) -> Iterator[tuple[Path, int]]:
    """Yield the videos of a feature, and the frames that each must have."""
    if "/" in key or ".." in key:
        raise DatasetError(f"{folder}/meta/info.json names the feature {key!r:.80}: a name has no '/' and no '..'")
    if info.codebase_version.startswith("v2"):
        for number, length in enumerate(lengths):
            yield folder / f"videos/chunk-{number // 1000:03d}/{key}/episode_{number:06d}.mp4", length
        return
    names = [f"videos/{key}/chunk_index", f"videos/{key}/file_index"]
    frames: dict[Path, int] = {}
    row = 0
    for path in sorted(folder.glob("meta/episodes/chunk-*/*.parquet"), key=_number_of):
        table, _ = _table(path, dict.fromkeys(names, 1), MOST_BYTES)
        places = [_values(table.column(name), _PLACE, f"{path}, {name}") for name in names]
        if min(each.min(initial=0) for each in places) < 0:
            raise DatasetError(f"{path} has a negative chunk or file of {key!r:.80}: copy it again")
        for chunk, file in itertools.islice(zip(*places, strict=True), len(lengths) - row):
            video = folder / f"videos/{key}/chunk-{chunk:03d}/file-{file:03d}.mp4"
            frames[video] = frames.get(video, 0) + lengths[row]
            row += 1
    if row != len(lengths):
        raise DatasetError(f"{folder}/meta/episodes describes {row} episodes of {len(lengths)}: copy it again")
    yield from frames.items()


def vector_of(dataset: Dataset, name: str = ACTION) -> tuple[NDArray[Any], tuple[str, ...]]:
    """Return the values of a feature over all frames, (frames, size), and their names as far as it has any.

    Raises:
        DatasetError: There is no such feature of numbers.
    """
    if name not in dataset.columns:
        raise DatasetError(
            f"{dataset.folder} has no feature {name!r} of numbers: it has {', '.join(sorted(dataset.columns))}"
        )
    values = dataset.columns[name].reshape(len(dataset.columns[name]), -1)
    stated = dataset.features[name].names
    if isinstance(stated, dict):  # of older versions: {"motors": [...]}
        stated = next(iter(stated.values()), None)
    fits = isinstance(stated, list | tuple) and len(stated) == values.shape[1]
    return values, tuple(map(str, stated)) if fits else ()
