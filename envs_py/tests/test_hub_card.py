"""The model card of ``dmprl push``; it needs no other package."""

import dataclasses
import unittest

from dmprl import zoo
from dmprl.hub import card

REPO = "me/push-policy"
FILM = "https://hub.example/me/push-policy/resolve/main/replay.mp4"


def facts(**changes):
    """Returns the facts about the zoo's policy for ``panda-push``."""
    read = card.read(zoo.FOLDER / "panda-push", REPO, 49272, FILM)
    return dataclasses.replace(read, **changes)


class CardTest(unittest.TestCase):
    def test_the_metadata_name_task_and_result(self):
        head, _, body = card.model_card(facts()).removeprefix("---\n").partition("\n---\n")
        for line in [
            "library_name: dmprl",
            "pipeline_tag: reinforcement-learning",
            '- "robotics"',
            '- "td3"',
            '- "dynamic-movement-primitives"',
            '- name: "push-policy"',
            '      name: "panda-push"',
            '      type: "dmprl/PandaPush-v0"',
            # The population's deviation of the 100 returns, as `dmprl eval` prints it.
            '      value: "-14.38 +/- 5.47"',
            "      value: 1.0",
        ]:
            self.assertIn(line, head.splitlines())
        self.assertTrue(body.startswith("\n# TD3 policy for panda-push\n"))

    def test_the_text_states_seeds_steps_and_evaluation(self):
        text = card.model_card(facts())
        for line in [
            "| Task | `panda-push` (dmprl/PandaPush-v0) |",
            "| Algorithm | TD3, policy `dmp`, segments of 5 steps, blended at every step |",
            "| Seed of the training | 1 |",
            "| Environment steps | 200,000 |",
            "| Return | -14.38 ± 5.47 |",
            "| Success rate | 1.00 |",
            "| Episodes | 100, without noise, seeds 1000 to 1099 |",
        ]:
            self.assertIn(line, text.splitlines())
        self.assertIn("dmprl train panda-push --seed 1 --steps 200000", text)
        self.assertIn("commit fe437a55479305e79965391814b7c8a8b7458112", text)
        self.assertIn(f'src="{FILM}"', text)

    def test_the_text_shows_how_to_use_the_policy(self):
        text = card.model_card(facts())
        for line in [
            "dmprl pull me/push-policy",
            "dmprl play runs/me-push-policy",
            'policy = dmprl.Policy.load("policy.safetensors")',
        ]:
            self.assertIn(line, text.splitlines())
        self.assertIn("observation = [0.0] * 27 ", text)

    def test_the_best_of_many_evaluations_is_called_so(self):
        row = facts().row
        worse = {**row, "policy_version": 3, "return_mean": -30.0, "returns": []}
        self.assertNotIn("It is the best", card.model_card(facts()))
        best = card.model_card(facts(rows=[worse, row, worse]))
        self.assertIn("It is the best of the run's 3 evaluations", best)
        better = {**worse, "return_mean": -1.0}
        self.assertNotIn("It is the best", card.model_card(facts(rows=[better, row])))
        rarer = {**better, "success_rate": 0.0}
        self.assertIn("It is the best", card.model_card(facts(rows=[rarer, row])))

    def test_a_task_without_success_has_no_rate_and_no_film_is_no_video(self):
        row = {**facts().row, "success_rate": None}
        text = card.model_card(facts(rows=[row], film=None))
        self.assertNotIn("success", text.lower())
        self.assertNotIn("<video", text)
        animation = card.model_card(facts(film=FILM.replace("mp4", "gif")))
        self.assertIn("![Episodes of the policy](https://", animation)

    def test_the_kind_says_how_segments_are_executed(self):
        policy = facts().config["policy"]
        del policy["execution"]
        self.assertEqual(card.kind(policy), "`dmp`, segments of 5 steps, executed as a whole")
        self.assertEqual(card.kind(policy | {"kind": "mlp", "execution": "ensemble"}), "`mlp`")

    def test_names_cannot_break_the_metadata(self):
        config = facts().config
        config["task"] |= {"name": 'a: "b"\n- c', "id": "arms:Arm-v0"}
        head = card.metadata(facts(config=config))
        self.assertIn('      name: "a: \\"b\\"\\n- c"\n', head)
        self.assertIn("in the Python module `arms`", card.description(facts(config=config)))
        config["task"]["id"] = "Reacher-v5"  # of Gymnasium, as the task `reacher`
        self.assertNotIn("module", card.description(facts(config=config)))

    def test_all_sessions_of_a_resumed_run_are_listed(self):
        manifest = facts().manifest
        again = {**manifest["sessions"][0], "command": ["dmprl", "resume", "mine"]}
        manifest = {**manifest, "sessions": [*manifest["sessions"], again]}
        text = card.training(facts(manifest=manifest))
        self.assertIn("evaluation.first_seed=5000\ndmprl resume mine\n```", text)


if __name__ == "__main__":
    unittest.main()
