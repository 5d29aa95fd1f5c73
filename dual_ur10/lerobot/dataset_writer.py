"""Writer of datasets in LeRobot's format v3.0: a new folder, whole or not at all."""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dual_ur10.errors import DatasetError, MissingExtraError
from dual_ur10.lerobot.column_statistics import Statistics, combined, statistics_of
from dual_ur10.lerobot.episode_frames import Columns
from dual_ur10.lerobot.features import DEFAULTS, DatasetFeature

try:
    import pyarrow as pa
    import pyarrow.parquet as pq
except ImportError as error:
    raise MissingExtraError("pyarrow", "lerobot", "a LeRobot dataset") from error

OWN: Final = "meta/dual_ur10.json"
"""File of a dataset that holds the runs of its episodes."""

CHUNK: Final = 1000
DATA_MB, VIDEO_MB = 100, 200
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

_TYPES: Final = {"float32": pa.float32(), "float64": pa.float64(), "int64": pa.int64(), "bool": pa.bool_()}


class DatasetWriter:
    """Writer of a new dataset. A context: the folder appears at its end; if the block raises, there is none.

    Args:
        folder: Folder to create; it must not exist.
        fps: Frames per second.
        features: Features by name, without `DEFAULTS`.
        robot_type: Name of the robot.

    Attributes:
        version: Version of the format.
        part: Folder in which it is made.
        tasks: Descriptions of tasks.
        lengths, task_of, statistics: Frames, task and statistics of each episode so far.

    Raises:
        DatasetError: The folder exists, or cannot be written.
    """

    version = "v3.0"

    def __init__(self, folder: Path, fps: int, features: Mapping[str, DatasetFeature], robot_type: str) -> None:
        self.folder = folder = folder.absolute()  # Arrow and PyAV take the beginning of "a:b" for a protocol
        self.fps, self.robot_type = fps, robot_type
        self.features = {**{name: each for name, each in features.items() if name not in DEFAULTS}, **DEFAULTS}
        self.tasks: list[str] = []
        self.lengths: list[int] = []
        self.task_of: list[str] = []
        self.statistics: list[dict[str, Statistics]] = []
        self.part = folder.with_name(f".{folder.name[:100]}.{secrets.token_hex(8)}.part")

    def __enter__(self) -> DatasetWriter:
        if self.folder.exists() or self.folder.is_symlink():
            raise DatasetError(f"{self.folder} exists, and nothing is overwritten: name a new folder")
        try:
            (self.part / "meta").mkdir(parents=True)
        except OSError as error:
            raise DatasetError(f"cannot make {self.folder}: {error}") from error
        self.begin()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.end(whole=kind is None)
            if isinstance(error, OSError):  # of a table or a video
                raise error
            if kind is None:
                self.part.rename(self.folder)
        except OSError as reason:
            raise DatasetError(f"cannot write {self.folder}: {reason}") from reason
        finally:
            shutil.rmtree(self.part, ignore_errors=True)

    @property
    def image_keys(self) -> list[str]:
        """Names of the features that are videos."""
        return [name for name, each in self.features.items() if each.is_image]

    def video_of(self, key: str) -> Path:
        """Return the file for a video of the next episode, in a folder that exists."""
        path = self.part / self.video_name(key, len(self.lengths))
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def add(self, columns: Columns, task: str, images: Mapping[str, Statistics] | None = None) -> None:
        """Append an episode, whose videos exist.

        Args:
            columns: Values of each feature over its m frames, (m, size) or (m,), without those of `DEFAULTS`.
            task: Description of the task in words.
            images: Statistics of its images by feature.

        Raises:
            DatasetError: A column is missing, unknown, or of another shape or type, or the task is no text.
            OSError: The disk is full. The end of the context makes a DatasetError of it.
        """
        number, count = len(self.lengths), len(next(iter(columns.values())))
        if task not in self.tasks:
            try:
                task.encode()
            except UnicodeEncodeError as error:
                raise DatasetError(f"the task is {task!r:.200}, which is no Unicode text ({error.reason})") from error
            self.tasks.append(task)
        frames = np.arange(count)
        whole = {
            **columns,
            "timestamp": (frames / self.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(count, number),
            "index": frames + sum(self.lengths),
            "task_index": np.full(count, self.tasks.index(task)),
        }
        self._check(whole, count, images or {})
        found = {name: statistics_of(values) for name, values in whole.items()} | dict(images or {})
        self.write(number, self._table(whole))
        self.lengths.append(count)
        self.task_of.append(task)
        self.statistics.append({name: found[name] for name in self.features})

    def _check(self, columns: Columns, count: int, images: Mapping[str, Statistics]) -> None:
        wanted = {name for name, each in self.features.items() if not each.is_image}
        if {*columns} != wanted or {*images} != {*self.image_keys}:
            raise DatasetError(
                f"the columns are {', '.join(sorted({*columns, *images}))}, those of the dataset are "
                f"{', '.join(sorted(self.features))}: all of them are needed, and no others"
            )
        for name, values in columns.items():
            feature = self.features[name]
            shape = (count,) if feature.shape == (1,) else (count, *feature.shape)
            if not count or values.shape != shape or values.dtype != feature.dtype:
                raise DatasetError(
                    f"{name} is {values.dtype} of shape {values.shape}, expected is {feature.dtype} of shape {shape}, "
                    "of one frame or more"
                )
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                raise DatasetError(f"{name} of episode {len(self.lengths)} has values that are not finite")

    def _table(self, columns: Columns) -> pa.Table:
        return pa.table(
            [_array(columns[name], each) for name, each in self.features.items() if not each.is_image],
            schema=pa.schema([(name, _type(each)) for name, each in self.features.items() if not each.is_image]),
        )

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file of the dataset."""
        path = self.part / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(value, indent=2, allow_nan=False) + "\n")

    def write_lines(self, name: str, values: list[Any]) -> None:
        """Write a file of the dataset with a JSON value per line."""
        (self.part / name).write_text("".join(json.dumps(each, allow_nan=False) + "\n" for each in values))

    def info(self) -> dict[str, Any]:
        """Return the content of `meta/info.json`."""
        return {
            "codebase_version": self.version,
            "robot_type": self.robot_type,
            "total_episodes": len(self.lengths),
            "total_frames": sum(self.lengths),
            "total_tasks": len(self.tasks),
            "chunks_size": CHUNK,
            "fps": self.fps,
            "splits": {"train": f"0:{len(self.lengths)}"},
            "features": {name: each.to_json() for name, each in self.features.items()},
        }

    # What follows is of format v3.0 alone; `DatasetWriterV21` has its own.

    def video_name(self, key: str, episode: int) -> str:
        """Return the path of a video of an episode, of which each has a file of its own."""
        return VIDEO_PATH.format(video_key=key, chunk_index=episode // CHUNK, file_index=episode % CHUNK)

    def begin(self) -> None:
        """Begin to write the tables."""
        self._writer: pq.ParquetWriter | None = None
        self._file = -1
        self._bytes = 0
        self._files: list[int] = []

    def write(self, number: int, table: pa.Table) -> None:
        """Write the table of an episode, as one row group."""
        if self._writer is None or self._bytes + table.nbytes > DATA_MB * 2**20:
            self._close()
            self._file, self._bytes = self._file + 1, 0
            path = self.part / DATA_PATH.format(chunk_index=self._file // CHUNK, file_index=self._file % CHUNK)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema, compression="snappy", use_dictionary=False)
        self._writer.write_table(table, row_group_size=table.num_rows)
        self._bytes += table.nbytes
        self._files.append(self._file)

    def _close(self) -> None:
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    def end(self, *, whole: bool) -> None:
        """End the tables and, if all episodes are there, write what describes them."""
        self._close()
        if not whole:
            return
        self.write_json(
            "meta/info.json",
            {
                **self.info(),
                "data_files_size_in_mb": DATA_MB,
                "video_files_size_in_mb": VIDEO_MB,
                "data_path": DATA_PATH,
                "video_path": VIDEO_PATH if self.image_keys else None,
            },
        )
        self.write_json("meta/stats.json", self.all_statistics())
        pq.write_table(_tasks(self.tasks), self.part / "meta/tasks.parquet")
        path = self.part / "meta/episodes/chunk-000/file-000.parquet"
        path.parent.mkdir(parents=True)
        pq.write_table(self._episodes(), path)

    def all_statistics(self) -> dict[str, Any]:
        """Return the statistics of the whole dataset, as JSON has them."""
        if not self.statistics:
            return {}
        found = {name: combined(each[name] for each in self.statistics) for name in self.features}
        return {name: {kind: value.tolist() for kind, value in each.items()} for name, each in found.items()}

    def _episodes(self) -> pa.Table:
        ends = np.cumsum(self.lengths)
        begins = ends - self.lengths
        count = len(self.lengths)
        integers: dict[str, Any] = {
            "episode_index": np.arange(count),
            "length": np.array(self.lengths),
            "data/chunk_index": np.array(self._files) // CHUNK,
            "data/file_index": np.array(self._files) % CHUNK,
            "dataset_from_index": begins,
            "dataset_to_index": ends,
            "meta/episodes/chunk_index": np.zeros(count),
            "meta/episodes/file_index": np.zeros(count),
        }
        found: dict[str, Any] = {name: pa.array(each, pa.int64()) for name, each in integers.items()}
        found["tasks"] = pa.array([[each] for each in self.task_of], pa.list_(pa.string()))
        for key in self.image_keys:
            found[f"videos/{key}/chunk_index"] = pa.array(np.arange(count) // CHUNK, pa.int64())
            found[f"videos/{key}/file_index"] = pa.array(np.arange(count) % CHUNK, pa.int64())
            found[f"videos/{key}/from_timestamp"] = pa.array(np.zeros(count), pa.float64())
            found[f"videos/{key}/to_timestamp"] = pa.array(np.array(self.lengths) / self.fps, pa.float64())
        for name in self.features:
            for kind in self.statistics[0][name]:
                values = [each[name][kind].tolist() for each in self.statistics]
                found[f"stats/{name}/{kind}"] = pa.array(values)
        return pa.table(found)


def _type(feature: DatasetFeature) -> pa.DataType:
    kind = _TYPES[feature.dtype]
    return kind if feature.shape == (1,) else pa.list_(kind, feature.size)


def _array(values: NDArray[Any], feature: DatasetFeature) -> pa.Array:
    flat = pa.array(values.reshape(-1), _TYPES[feature.dtype])
    return flat if feature.shape == (1,) else pa.FixedSizeListArray.from_arrays(flat, feature.size)


def _tasks(tasks: list[str]) -> pa.Table:
    """Return the table of tasks. LeRobot finds a task by the index that pandas' metadata name."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    about = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.3.3"}
    return table.replace_schema_metadata({b"pandas": json.dumps(about).encode()})
