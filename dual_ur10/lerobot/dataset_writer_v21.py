"""Writer of datasets in LeRobot's format v2.1, which GR00T reads: a table per episode, and `meta/modality.json`."""

from __future__ import annotations

from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq

from dual_ur10.lerobot.column_statistics import QUANTILES
from dual_ur10.lerobot.dataset_writer import CHUNK, DatasetWriter
from dual_ur10.lerobot.features import ACTION, STATE
from dual_ur10.policies.learned.lerobot_files import IMAGES
from ur_core.kinematics.ur10 import ARMS

DATA_PATH: Final = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
VIDEO_PATH: Final = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_JOINTS: Final = 6


class DatasetWriterV21(DatasetWriter):
    """Writer of a new dataset of format v2.1; see `DatasetWriter`."""

    version = "v2.1"

    def video_name(self, key: str, episode: int) -> str:
        """Return the path of a video of an episode."""
        return VIDEO_PATH.format(episode_chunk=episode // CHUNK, video_key=key, episode_index=episode)

    def begin(self) -> None:
        """Do nothing: each episode has a file of its own."""

    def write(self, number: int, table: pa.Table) -> None:
        """Write the table of an episode."""
        path = self.part / DATA_PATH.format(episode_chunk=number // CHUNK, episode_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, path, compression="snappy", use_dictionary=False)

    def end(self, *, whole: bool) -> None:
        """Write what describes the episodes, if all of them are there."""
        if not whole:
            return
        count = len(self.lengths)
        self.write_json(
            "meta/info.json",
            {
                **self.info(),
                "total_videos": count * len(self.image_keys),
                "total_chunks": -(-count // CHUNK),
                "data_path": DATA_PATH,
                "video_path": VIDEO_PATH if self.image_keys else None,
            },
        )
        self.write_json("meta/stats.json", self.all_statistics())
        self.write_json("meta/modality.json", self.modality())
        self.write_lines("meta/tasks.jsonl", [{"task_index": k, "task": each} for k, each in enumerate(self.tasks)])
        pairs = enumerate(zip(self.lengths, self.task_of, strict=True))
        self.write_lines(
            "meta/episodes.jsonl",
            [{"episode_index": k, "tasks": [task], "length": length} for k, (length, task) in pairs],
        )
        self.write_lines(
            "meta/episodes_stats.jsonl",
            [
                {
                    "episode_index": k,
                    "stats": {
                        name: {kind: value.tolist() for kind, value in found.items() if kind not in QUANTILES}
                        for name, found in each.items()
                    },
                }
                for k, each in enumerate(self.statistics)
            ],
        )

    def modality(self) -> dict[str, Any]:
        """Return the parts of states and actions by name, the cameras and the task, as GR00T asks for them."""
        return {
            "state": self._parts(STATE),
            "action": self._parts(ACTION),
            "video": {key.removeprefix(IMAGES): {"original_key": key} for key in self.image_keys},
            "annotation": {"human.task_description": {"original_key": "task_index"}},
        }

    def _parts(self, name: str) -> dict[str, dict[str, int]]:
        """Return begin and end of both arms' joints and grippers in a vector."""
        if name not in self.features:
            return {}
        size = self.features[name].size // len(ARMS)
        found = {}
        for k, arm in enumerate(ARMS):
            found[f"{arm}_arm"] = {"start": k * size, "end": k * size + _JOINTS}
            if size > _JOINTS:
                found[f"{arm}_gripper"] = {"start": k * size + _JOINTS, "end": (k + 1) * size}
        return found
