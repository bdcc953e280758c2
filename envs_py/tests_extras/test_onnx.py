"""Exported graphs in onnxruntime, compared with Rust's actions for the same observations.

``tests/tests/python_extras.rs`` writes both to the folder ``TEST_EXPORTED``.
"""

import json
import os
import pathlib
import unittest

import numpy as np
import onnxruntime

TOLERANCE = 1e-5
TOLERANCE_ACTION = 1e-4
"""For policies that see tanh⁻¹ of the last action: it multiplies rounding errors near bounds."""


class ExportedGraphs(unittest.TestCase):
    def setUp(self) -> None:
        folder = pathlib.Path(os.environ["TEST_EXPORTED"])
        self.folders = sorted(folder.iterdir())

    def test_each_graph_returns_rusts_actions(self) -> None:
        self.assertGreaterEqual(len(self.folders), 14)
        for folder in self.folders:
            with self.subTest(folder.name):
                session = onnxruntime.InferenceSession(folder / "policy.onnx")
                shapes = {entry.name: entry.shape for entry in session.get_outputs()}
                _, steps, action_len = shapes["actions"]
                inputs = {entry.name: entry.shape for entry in session.get_inputs()}
                observations = np.fromfile(folder / "observations.f64")
                observations = observations.reshape(-1, inputs["observation"][1]).astype("f4")
                expected = np.fromfile(folder / "segments.f64")
                expected = expected.reshape(-1, steps, action_len)
                if "state" in inputs:
                    got = run_in_sequence(session, observations, inputs["state"][1])
                else:
                    got = session.run(["actions"], {"observation": observations})[0]
                is_action = folder.name.startswith("action")
                tolerance = TOLERANCE_ACTION if is_action else TOLERANCE
                self.assertLess(np.abs(got - expected).max(), tolerance)

    def test_each_graph_contains_its_description(self) -> None:
        for folder in self.folders:
            session = onnxruntime.InferenceSession(folder / "policy.onnx")
            metadata = session.get_modelmeta().custom_metadata_map
            description = json.loads(metadata["description"])
            (observation, *_) = session.get_inputs()
            self.assertEqual(description["spec"]["observation_len"], observation.shape[1])


def run_in_sequence(
    session: onnxruntime.InferenceSession, observations: np.ndarray, state_len: int
) -> np.ndarray:
    """Returns the segments of successive decisions, each with the state after the previous one."""
    state, segments = np.zeros((1, state_len), np.float32), []
    for row in observations:
        feeds = {"observation": row[None], "state": state}
        actions, state = session.run(["actions", "next_state"], feeds)
        segments.append(actions)
    return np.concatenate(segments)


if __name__ == "__main__":
    unittest.main()
