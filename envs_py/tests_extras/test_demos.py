"""Small data sets, made locally, of Minari and in the layout of LeRobot (extra `demos`).

Minari's package writes its data sets. LeRobot's package is too large for a test, so the files are
written as its versions 0.3.3 (data format v2.1) and 0.4.2 (v3.0) write them.
"""

import contextlib
import io
import json
import os
import tempfile
import unittest
import warnings
from pathlib import Path
from unittest import mock

import gymnasium
import minari
import numpy as np
import pyarrow as pa
from gymnasium import spaces
from minari.data_collector import EpisodeBuffer
from pyarrow import parquet

from dmprl.demos.__main__ import main
from dmprl.demos.opening import open_source
from dmprl.demos.source import Columns, DemosError
from dmprl.flat_spaces import flattened


class Point(gymnasium.Env):
    """A point that moves by its action; observes a Dict whose keys are not in order."""

    observation_space = spaces.Dict(
        velocity=spaces.Box(-9, 9, (2,), np.float32),
        achieved_goal=spaces.Box(-9, 9, (1, 2), np.float64),
        mode=spaces.Discrete(3),
    )
    action_space = spaces.Box(-1, 1, (2, 1), np.float32)
    max_episode_steps = 5

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.steps = self.np_random.uniform(-1, 1, (1, 2)), 0
        return self.observe(np.zeros(2)), {}

    def step(self, action):
        self.place = self.place + action.T
        self.steps += 1
        done = bool(np.abs(self.place).max() < 0.2)
        return self.observe(action[:, 0]), -float(self.steps), done, False, {"is_success": done}

    def observe(self, velocity):
        mode = self.steps % 3
        velocity = np.asarray(velocity, np.float32)
        return {"velocity": velocity, "achieved_goal": self.place.copy(), "mode": mode}


def rollout(seed):
    """Returns an episode as Minari's collector stores it, and its observations in a worker."""
    env = gymnasium.wrappers.TimeLimit(Point(), Point.max_episode_steps)
    flat = flattened(Point(), "Point")
    rows, actions, rewards, ends, infos = [env.reset(seed=seed)[0]], [], [], [], []
    flat_rows = [flat.reset(seed=seed)[0]]
    while not ends or not any(ends[-1]):
        action = np.clip(-rows[-1]["achieved_goal"].T, -0.1, 0.1).astype(np.float32)
        row, reward, *end, info = env.step(action)
        flat_rows.append(flat.step(action.ravel())[0])
        for values, value in [(rows, row), (actions, action), (rewards, reward), (ends, end)]:
            values.append(value)
        infos.append(info["is_success"])
    buffer = EpisodeBuffer(
        observations={key: [row[key] for row in rows] for key in rows[0]},
        actions=actions,
        rewards=rewards,
        terminations=[bool(end[0]) for end in ends],
        truncations=[bool(end[1]) for end in ends],
        infos={"is_success": [False, *infos]},
    )
    return buffer, np.stack(flat_rows)


class MinariTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        store = {"MINARI_DATASETS_PATH": str(self.folder / "store")}
        environment = mock.patch.dict(os.environ, store)
        environment.start()
        self.addCleanup(environment.stop)

    def make(self, name, buffers, data_format="hdf5"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # author and permalink are not given
            minari.create_dataset_from_buffers(
                name,
                buffers,
                action_space=Point.action_space,
                observation_space=Point.observation_space,
                data_format=data_format,
            )

    def convert(self, source, *words):
        output = self.folder / "demos.npz"
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            status = main(["convert", source, str(output), "--json", *words])
        self.assertEqual(status, 0)
        with np.load(output) as file:
            return json.loads(printed.getvalue()), dict(file)

    def test_a_data_set_is_flattened_as_the_environment_is(self):
        episodes = [rollout(seed) for seed in range(4)]
        expected = np.concatenate([rows[:-1] for _, rows in episodes])
        after = np.concatenate([rows[1:] for _, rows in episodes])
        for data_format in ("hdf5", "arrow"):
            self.make(f"points/{data_format}-v0", [buffer for buffer, _ in episodes], data_format)
            words = f"minari:points/{data_format}-v0", "--task", f"{__name__}:Point"
            result, file = self.convert(*words)
            np.testing.assert_allclose(file["observations"], expected, rtol=1e-6)
            np.testing.assert_allclose(file["next_observations"], after, rtol=1e-6)
            buffers = [buffer for buffer, _ in episodes]
            for name, key in [("rewards", "rewards"), ("terminated", "terminations")]:
                recorded = np.concatenate([getattr(buffer, key) for buffer in buffers])
                np.testing.assert_array_equal(file[name], recorded)
            actions = np.concatenate([np.stack(buffer.actions)[:, :, 0] for buffer in buffers])
            np.testing.assert_array_equal(file["actions"], actions)
            ended = [buffer.terminations[-1] for buffer in buffers]
            self.assertGreater(len(set(ended)), 1, "one of each")
            self.assertEqual(result["successes"], sum(ended))

    def test_a_task_takes_the_entries_by_name(self):
        self.make("points/some-v0", [rollout(0)[0]])
        folder = str(self.folder / "store" / "points" / "some-v0")
        expected = rollout(0)[1][:-1]
        _, file = self.convert(folder, "--task", f"{__name__}:Point")
        np.testing.assert_allclose(file["observations"], expected, rtol=1e-6)
        # Minari sorts the keys, the environment does not.
        _, file = self.convert(folder)
        np.testing.assert_allclose(file["observations"], np.roll(expected, -2, axis=1), rtol=1e-6)
        _, some = self.convert(folder, "--observation", "velocity")
        self.assertEqual(some["observations"].shape[1], 2)
        source = open_source(f"{folder}/data")
        self.assertEqual(source.columns["mode"], ["mode[0]", "mode[1]", "mode[2]"])

    def test_what_is_not_in_the_store_or_damaged_is_refused(self):
        with self.assertRaisesRegex(DemosError, "minari download points/none-v0"):
            open_source("minari:points/none-v0")
        self.make("points/some-v0", [rollout(0)[0]])
        data = self.folder / "store" / "points" / "some-v0" / "data"
        (data / "main_data.hdf5").write_bytes(b"no HDF5")
        with self.assertRaisesRegex(DemosError, "cannot be read as Minari"):
            source = open_source("minari:points/some-v0")
            list(source.episodes(Columns(("velocity",), "action", None)))
        metadata = json.loads((data / "metadata.json").read_text())
        (data / "metadata.json").write_text(json.dumps({**metadata, "total_episodes": 0}))
        with self.assertRaisesRegex(DemosError, "no episodes"):
            open_source("minari:points/some-v0")


FEATURES = {
    "observation.state": {"dtype": "float32", "shape": [3], "names": ["a", "b", "c"]},
    "observation.force": {"dtype": "float32", "shape": [1], "names": None},
    "observation.images.top": {"dtype": "video", "shape": [48, 64, 3], "names": None},
    "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["x", "y"]}},
    "next.reward": {"dtype": "float32", "shape": [1], "names": None},
    "next.done": {"dtype": "bool", "shape": [1], "names": None},
    "next.success": {"dtype": "bool", "shape": [1], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
FPS = 20
LENGTHS = (5, 8, 3)
"""Frames of each episode."""


def table(episode, **changes):
    """Returns the frames of an episode."""
    frames = np.arange(LENGTHS[episode])
    done = frames == frames[-1]
    columns = {
        "observation.state": [[episode, t, 10 * episode + t] for t in frames.tolist()],
        "observation.force": frames / 8,
        "action": [[t / 10, -episode / 10] for t in frames.tolist()],
        "next.reward": frames.astype(float),
        "next.done": done,
        "next.success": done & (episode != 1),
        "timestamp": frames / FPS,
        "frame_index": frames,
        "episode_index": np.full(len(frames), episode),
        "index": sum(LENGTHS[:episode]) + frames,
        "task_index": np.zeros(len(frames), int),
    }
    columns |= changes
    arrays = {}
    for name, values in columns.items():
        feature = FEATURES[name]
        kind = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}[feature["dtype"]]
        length = feature["shape"][0]
        # `datasets` stores columns of length 1 as numbers.
        arrays[name] = pa.array(values, kind if length == 1 else pa.list_(kind, length))
    return pa.table(arrays)


class LeRobotTest(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def make(self, version, tables=None, **info):
        """Writes a data set; returns its folder."""
        tables = tables or [table(episode) for episode in range(len(LENGTHS))]
        folder = self.folder / f"{version}-{len(list(self.folder.iterdir()))}"
        (folder / "meta").mkdir(parents=True)
        chunk = folder / "data" / "chunk-000"
        chunk.mkdir(parents=True)
        if version == "v3.0":
            for number, group in enumerate(filter(None, (tables[:2], tables[2:]))):
                joined = pa.concat_tables(group)
                parquet.write_table(joined, chunk / f"file-{number:03d}.parquet")
            path = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
        else:
            for episode, frames in enumerate(tables):
                parquet.write_table(frames, chunk / f"episode_{episode:06d}.parquet")
            path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
            lines = [{"episode_index": it, "length": n} for it, n in enumerate(LENGTHS)]
            text = "".join(f"{json.dumps(line)}\n" for line in lines)
            (folder / "meta" / "episodes.jsonl").write_text(text)
        info = {
            "codebase_version": version,
            "robot_type": None,
            "total_episodes": len(LENGTHS),
            "total_frames": sum(LENGTHS),
            "chunks_size": 1000,
            "fps": FPS,
            "data_path": path,
            "features": FEATURES,
            **info,
        }
        (folder / "meta" / "info.json").write_text(json.dumps(info, indent=4))
        return str(folder)

    def run_main(self, *words):
        """Returns status and output."""
        with (
            contextlib.redirect_stdout(io.StringIO()) as printed,
            contextlib.redirect_stderr(io.StringIO()) as said,
        ):
            status = main(list(words))
        return status, printed.getvalue() or said.getvalue()

    def converted(self, source, *words):
        output = self.folder / "demos.npz"
        status, printed = self.run_main("convert", source, str(output), "--json", *words)
        self.assertEqual(status, 0, printed)
        with np.load(output) as file:
            return json.loads(printed), dict(file)

    def test_all_versions_give_the_same_steps(self):
        for version in ("v2.0", "v2.1", "v3.0"):
            result, file = self.converted(self.make(version))
            # A frame less than recorded for each episode, because the last has no successor.
            self.assertEqual((result["episodes"], result["steps"]), (3, 13))
            self.assertEqual((result["rate_hz"], result["successes"]), (20.0, 2))
            steps = [(e, t) for e, frames in enumerate(LENGTHS) for t in range(frames - 1)]
            rows = [[e, t, 10 * e + t] for e, t in steps]
            np.testing.assert_array_equal(file["observations"], rows)
            after = [[e, t + 1, 10 * e + t + 1] for e, t in steps]
            np.testing.assert_array_equal(file["next_observations"], after)
            actions = np.array([[t / 10, -e / 10] for e, t in steps], np.float32)
            np.testing.assert_array_equal(file["actions"], actions)
            np.testing.assert_array_equal(file["rewards"], [t for _, t in steps])
            ends = [t == LENGTHS[e] - 2 for e, t in steps]
            np.testing.assert_array_equal(file["truncated"], ends)
            self.assertFalse(file["terminated"].any())

    def test_columns_can_be_joined_and_left_out(self):
        words = "--observation", "observation.force,observation.state", "--reward", "-1"
        result, file = self.converted(self.make("v3.0"), *words)
        np.testing.assert_array_equal(file["observations"][3], [3 / 8, 0, 3, 3])
        self.assertEqual((set(file["rewards"].tolist()), result["rewards"]), ({-1.0}, "constant"))

    def test_a_recording_is_resampled_to_the_rate_of_the_result(self):
        result, file = self.converted(self.make("v3.0"), "--rate", "10", "--episodes", "2")
        # 4 and 7 steps of 50 ms are 2 and 3 of 100 ms.
        np.testing.assert_array_equal(file["observations"][:, 1], [0, 2, 0, 2, 4])
        np.testing.assert_array_equal(file["rewards"], [1, 3, 1, 3, 5])
        self.assertIn("resampled from 20 to 10 Hz", result["notes"][0])

    def test_show_lists_columns_and_what_a_task_lacks(self):
        status, text = self.run_main("show", self.make("v2.1"), "--task", "reacher")
        self.assertEqual(status, 0)
        for words in (
            "LeRobotDataset v2.1",
            "3, 13 steps (2 to 7 each)",
            "observation.images.top (video, cannot be read)",
            "2 of 3",
            "Reacher-v5 expects 10 entries, got 3 from observation.state",
        ):
            self.assertIn(words, text)

    def test_a_damaged_data_set_is_refused(self):
        good = [table(episode) for episode in range(len(LENGTHS))]
        no_frames = {"frame_index": [0, 1, 2, 4, 5]}
        nan = {"next.reward": [0, 0, np.nan, 0, 0]}
        null = {"next.reward": [0, 0, None, 0, 0]}
        cases = [
            ({"total_frames": 99}, good, "has 99 frames, the data files have 16"),
            ({"total_frames": 0}, [table(0).slice(0, 0)], "no episodes"),
            ({"total_episodes": 4}, good, "expected 4 episodes, the data files have 3"),
            ({}, [table(0, **no_frames), *good[1:]], "expected the frames of episode 0 in order"),
            ({}, [table(0, **nan), *good[1:]], "episode 0, step 2: reward"),
            ({}, [table(0, **null), *good[1:]], "next.reward: expected 1 numbers in each of"),
            ({"codebase_version": "v1.6"}, good, "expected v2.0, v2.1, v3.0"),
        ]
        for info, tables, words in cases:
            for version in ("v2.1", "v3.0"):
                source = self.make(version, tables, **info)
                output = str(self.folder / "demos.npz")
                status, said = self.run_main("convert", source, output)
                self.assertEqual(status, 2, words)
                self.assertIn(words, said)
        status, said = self.run_main("show", self.make("v3.0"), "--observation", "observation.poze")
        self.assertIn("no column observation.poze; there are: observation.state (3)", said)


if __name__ == "__main__":
    unittest.main()
