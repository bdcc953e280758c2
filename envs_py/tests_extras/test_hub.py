"""``dmprl.hub`` with the real ``huggingface_hub``, against a stand-in for the hub."""

import json
import shutil
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import hub_stand_in
from huggingface_hub import ModelCard

from dmprl import zoo
from dmprl.hub import FILES, POLICY

TASK, VERSION = "panda-push", 49272
REPO = "me/push-policy"
REFUSED, FAILED = 2, 1


class HubTest(unittest.TestCase):
    def setUp(self):
        place = tempfile.TemporaryDirectory()
        self.addCleanup(place.cleanup)
        self.place = Path(place.name)
        running = hub_stand_in.running(self.place / "hub")
        self.hub = running.__enter__()
        self.addCleanup(running.__exit__, None, None, None)
        self.folder = self.place / "folder"
        original = zoo.FOLDER / TASK
        shutil.copytree(original, self.folder)
        shutil.copy(original / f"policies/{VERSION}.safetensors", self.folder / POLICY)

    def call(self, action, folder, *words, repo=REPO, status=0, **client):
        """Runs ``dmprl.hub``; returns its answer."""
        answer = self.place / "answer.json"
        answer.unlink(missing_ok=True)
        command = [sys.executable, "-m", "dmprl.hub", action, folder, repo, "--answer", answer]
        env = hub_stand_in.environment(self.hub, self.place / "home", **client)
        ended = subprocess.run(
            [*command, *words], env=env, capture_output=True, text=True, timeout=120, check=False
        )
        self.assertEqual(ended.returncode, status, ended.stderr)
        return json.loads(answer.read_text())

    def push(self, *words, **more):
        words = [f"--policy-version={VERSION}", "--message=A policy", *words]
        return self.call("push", self.folder, *words, **more)

    def pull(self, *words, **more):
        return self.call("pull", self.place / "pulled", *words, **more)

    def files(self, revision=None):
        """Returns the folder of a commit in the stand-in."""
        return self.hub.files(REPO, revision)[1]

    def test_a_pushed_policy_is_pulled_with_the_same_bytes(self):
        film = self.place / "film.MP4"
        film.write_bytes(b"a film")
        pushed = self.push("--film", film)
        self.assertEqual(pushed["address"], f"{self.hub.address}/{REPO}")
        self.assertEqual((self.files() / "replay.mp4").read_bytes(), b"a film")
        pulled = self.pull()
        self.assertEqual(pulled, pushed)
        for name in FILES:
            expected = (self.folder / name).read_bytes()
            self.assertEqual((self.place / "pulled" / name).read_bytes(), expected, name)

    def test_the_hub_reads_the_result_from_the_card(self):
        self.push()
        data = ModelCard((self.files() / "README.md").read_text()).data
        self.assertEqual((data.library_name, data.model_name), ("dmprl", "push-policy"))
        self.assertLessEqual({"reinforcement-learning", "robotics", "td3"}, set(data.tags))
        results = {it.metric_type: it.metric_value for it in data.eval_results}
        self.assertEqual(results, {"mean_reward": "-14.38 +/- 5.47", "success_rate": 1.0})
        self.assertEqual(data.eval_results[0].dataset_type, "dmprl/PandaPush-v0")

    def test_a_revision_stays_available_and_an_old_film_is_removed(self):
        film = self.place / "film.gif"
        film.write_bytes(b"an animation")
        first = self.push("--film", film)["commit"]
        newer = self.folder / POLICY
        before = newer.read_bytes()
        newer.write_bytes(before + b" ")
        second = self.push()["commit"]
        self.assertNotEqual(first, second)
        self.assertTrue((self.files(first) / "replay.gif").is_file())
        self.assertFalse((self.files(second) / "replay.gif").exists())
        self.assertEqual(self.pull("--revision", first)["commit"], first)
        self.assertEqual((self.place / "pulled" / POLICY).read_bytes(), before)
        error = self.pull("--revision", "v7", status=REFUSED)["error"]
        self.assertIn(f"{REPO} has no revision v7: expected a branch, a tag or the id", error)

    def test_a_private_repository_needs_a_token(self):
        self.push("--private")
        error = self.pull(status=REFUSED, token=None)["error"]
        self.assertRegex(
            error, f"no repository .*{REPO}, or it is private: set HF_TOKEN, or run .*hf"
        )
        self.pull(token=hub_stand_in.READER)

    def test_a_repository_on_request_is_named_as_such(self):
        self.push()
        self.hub.write_state(REPO, {**self.hub.state(REPO), "gated": True})
        error = self.pull(status=REFUSED)["error"]
        self.assertRegex(error, f"{REPO} is open on request only: ask for access")

    def test_a_public_repository_does_not_become_private_unnoticed(self):
        self.push()
        error = self.push("--private", status=REFUSED)["error"]
        self.assertIn("exists and is public; --private is for a new repository", error)

    def test_a_token_that_cannot_write_is_refused(self):
        error = self.push(status=REFUSED, token=None)["error"]
        self.assertRegex(error, "no token for .*: expected one with write access in HF_TOKEN")
        error = self.push(status=REFUSED, token="hf_wrong")["error"]
        self.assertIn("does not accept the token", error)
        error = self.push(status=REFUSED, token=hub_stand_in.READER)["error"]
        self.assertIn(f"may not do this with {self.hub.address}/{REPO}", error)
        error = self.push(status=REFUSED, repo="you/push")["error"]
        self.assertIn("(to pull, read access) for you; create one at", error)

    def test_other_repositories_are_refused_with_their_files(self):
        error = self.pull(status=REFUSED)["error"]
        self.assertIn(f"there is no repository {self.hub.address}/{REPO}", error)
        self.push()
        (self.files() / POLICY).rename(self.files() / "model.bin")
        error = self.pull(status=REFUSED)["error"]
        self.assertRegex(
            error, f"is not a policy of dmprl: it has no {POLICY}; its files: .*model.bin"
        )

    def test_a_hub_that_cannot_be_reached_is_named(self):
        address = self.hub.address
        self.hub.shutdown()
        self.hub.server_close()
        for act in (self.push, self.pull):
            error = act(status=FAILED)["error"]
            self.assertIn(f"cannot reach {address}: ", error)
            self.assertIn("HF_ENDPOINT", error)


if __name__ == "__main__":
    unittest.main()
