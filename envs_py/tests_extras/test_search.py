import json
import signal
import subprocess
import sys
import tempfile
import unittest

import optuna

from dmprl.search import RefusedError, Search

SPACE = [
    {"key": "rate", "kind": "float", "low": 1e-4, "high": 1e-1, "log": True},
    {"key": "count", "kind": "int", "low": 3, "high": 7, "log": False},
    {"key": "noise", "choices": ["gaussian", "pink"]},
]
OPENING = {
    "op": "open",
    "study": "reacher/td3",
    "identity": {"space": SPACE, "seeds": [1]},
    "space": SPACE,
    "sampler": "random",
    "seed": 3,
    "pruner": "none",
    "prune_after_trials": 1,
    "steps_max": 3,
    "first": [],
}


class SearchTest(unittest.TestCase):
    """Tests with one storage in a folder; a search that is started again only has this storage."""

    def setUp(self):
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = folder.name
        self.storage = f"sqlite:///{self.folder}/optuna.db"

    def start(self, **changes):
        """Starts another search with this storage; returns its data about the study."""
        self.search = Search(self.storage)
        return self.say({**OPENING, **changes})

    def say(self, request):
        """Answers a request, with JSON as between the processes."""
        return json.loads(json.dumps(self.search.answer(json.loads(json.dumps(request)))))

    def do(self, op, **more):
        return self.say({"op": op, "study": OPENING["study"], **more})

    def finish(self, objective):
        trial = self.do("ask")
        self.do("report", trial=trial["trial"], step=1, value=objective)
        self.do("tell", trial=trial["trial"], state="finished", objective=objective)
        return trial

    def test_values_have_the_types_and_ranges_of_their_keys(self):
        self.start()
        for number in range(10):
            asked = self.do("ask")
            self.assertEqual(asked["trial"], number)
            values = asked["values"]
            self.assertEqual(list(values), ["rate", "count", "noise"])
            self.assertTrue(1e-4 <= values["rate"] <= 1e-1)
            self.assertTrue(isinstance(values["count"], int) and 3 <= values["count"] <= 7)
            self.assertIn(values["noise"], ["gaussian", "pink"])

    def test_after_a_kill_the_next_process_continues_without_loss(self):
        self.start()
        finished = self.finish(-4.5)
        running = self.do("ask")
        self.do("report", trial=1, step=2, value=-9.0)
        opened = self.start()
        self.assertEqual(
            opened["trials"],
            [
                {**finished, "state": "finished", "objective": -4.5, "reported": [1]},
                {**running, "state": "running", "objective": None, "reported": [2]},
            ],
        )
        # A step may be reported twice, because the run may have been resumed before it.
        self.assertEqual(self.do("report", trial=1, step=2, value=-8.0), {"prune": False})
        self.assertEqual(self.do("tell", trial=1, state="finished", objective=-3.0), {})
        self.assertEqual(self.do("ask")["trial"], 2)

    def test_a_trials_values_do_not_depend_on_restarts_of_the_search(self):
        self.start()
        whole = [self.finish(-float(number)) for number in range(4)]
        self.assertEqual(len({trial["values"]["rate"] for trial in whole}), 4)
        self.storage = f"sqlite:///{self.folder}/other.db"
        broken = []
        for number in range(4):
            self.start()
            broken.append(self.finish(-float(number)))
        self.assertEqual(whole, broken)

    def test_a_trial_without_all_values_after_a_kill_is_completed(self):
        self.start()
        study = optuna.load_study(study_name=OPENING["study"], storage=self.storage)
        half = study.ask()
        half.suggest_float("rate", 1e-4, 1e-1, log=True)
        trial = self.start()["trials"][0]
        self.assertEqual(list(trial["values"]), ["rate", "count", "noise"])
        self.assertEqual(trial["values"]["rate"], half.params["rate"])

    def test_the_median_pruner_prunes_worse_trials_and_keeps_better_ones(self):
        self.start(pruner="median")
        self.finish(-5.0)
        for value, prune in [(-100.0, True), (-1.0, False)]:
            trial = self.do("ask")["trial"]
            answer = self.do("report", trial=trial, step=1, value=value)
            self.assertEqual(answer, {"prune": prune})
        self.assertEqual(self.do("tell", trial=1, state="pruned", objective=None), {})
        states = [trial["state"] for trial in self.start(pruner="median")["trials"]]
        self.assertEqual(states, ["finished", "pruned", "running"])

    def test_hyperband_prunes_some_trials_and_never_the_best(self):
        self.start(pruner="hyperband", sampler="tpe", steps_max=9)
        pruned = []
        for number in range(12):
            self.assertEqual(self.do("ask")["trial"], number)
            value = 0.0 if number == 0 else -float(number)
            for step in range(1, 10):
                if self.do("report", trial=number, step=step, value=value)["prune"]:
                    self.do("tell", trial=number, state="pruned", objective=None)
                    pruned.append(number)
                    break
            else:
                self.do("tell", trial=number, state="finished", objective=value)
        self.assertTrue(pruned)
        self.assertNotIn(0, pruned)

    def test_first_points_come_first_and_once(self):
        first = [{"rate": 0.01}, {"count": 4, "noise": "pink"}]
        self.start(first=first)
        self.assertEqual(self.do("ask")["values"]["rate"], 0.01)
        self.start(first=first)
        values = self.do("ask")["values"]
        self.assertEqual((values["count"], values["noise"]), (4, "pink"))
        self.assertNotEqual(self.do("ask")["values"]["rate"], 0.01)

    def test_a_different_identity_is_returned_and_changes_nothing(self):
        self.start()
        self.do("ask")
        opened = self.start(identity={"seeds": [2]}, first=[{"count": 5}])
        self.assertEqual(opened["identity"], OPENING["identity"])
        study = optuna.load_study(study_name=OPENING["study"], storage=self.storage)
        self.assertEqual(len(study.trials), 1)

    def test_a_finished_trial_cannot_be_finished_again(self):
        self.start()
        self.finish(-1.0)
        with self.assertRaisesRegex(RefusedError, "trial 0 is COMPLETE"):
            self.do("tell", trial=0, state="finished", objective=-1.0)
        with self.assertRaisesRegex(RefusedError, "unknown operation"):
            self.do("sing")

    def test_the_process_answers_invalid_requests_ignores_ctrl_c_and_ends_with_its_input(self):
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "dmprl.search", self.storage],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.addCleanup(process.kill)

        def say(request):
            process.stdin.write(request + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        self.assertTrue(json.loads(process.stdout.readline())["ready"].startswith("optuna "))
        process.send_signal(signal.SIGINT)
        self.assertEqual(say(json.dumps(OPENING))["trials"], [])
        self.assertIn("error", say("no JSON"))
        self.assertIn("KeyError", say('{"op": "ask", "study": "none"}')["error"])
        self.assertEqual(say('{"op": "ask", "study": "reacher/td3"}')["trial"], 0)
        process.stdin.close()
        self.assertEqual(process.wait(timeout=60), 0)
        process.stdout.close()


if __name__ == "__main__":
    unittest.main()
