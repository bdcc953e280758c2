"""The search of ``dmprl sweep``: which values to try next, and which trials to give up.

``python -m dmprl.search STORAGE`` answers each JSON object on standard input, one a line, with one
on standard output. The first line is ``{"ready": "optuna 5.0.0"}``, or ``{"absent": "why"}``.

================================================= =============================================
``{"op": "open", "study": …, "identity": …, …}``  ``{"identity": …, "trials": [{"trial", "state",
                                                  "values", "objective", "reported"}, …]}``
``{"op": "ask", "study": …}``                     ``{"trial": 7, "values": {key: value}}``
``{"op": "report", …, "step": 3, "value": -5.1}`` ``{"prune": false}``
``{"op": "tell", …, "state": …, "objective": …}`` ``{}``
================================================= =============================================

A request that cannot be done is answered by ``{"error": "why"}``. It ends with its input, so the
death of the program that started it ends it too. Everything stands in an Optuna storage, written
before the answer: whoever opens it again finds each trial, those under way too.
"""

from __future__ import annotations

import json
import os
import signal
import sys

import numpy as np

try:
    import optuna
    from optuna.trial import FrozenTrial, Trial, TrialState
except ModuleNotFoundError as error:
    optuna, ABSENT = None, str(error)

IDENTITY = "dmprl"
"""The study's attribute with what its trials have in common."""
STATES = {"running": "RUNNING", "finished": "COMPLETE", "pruned": "PRUNED", "failed": "FAIL"}
"""Our words for Optuna's. A trial that waits has not been asked for."""


class RefusedError(Exception):
    """A request that cannot be done. The message says why."""


class Study:
    """One task and method: an Optuna study, and the space that it is asked for values of."""

    def __init__(self, storage: str, request: dict) -> None:
        self.sampler, self.seed = request["sampler"], request["seed"]
        self.space, self.identity = request["space"], request["identity"]
        self.first = request["first"]
        self.study = optuna.create_study(
            storage=storage,
            study_name=request["study"],
            direction="maximize",
            load_if_exists=True,
            pruner=pruner(request),
        )
        if IDENTITY not in self.study.user_attrs:
            self.study.set_user_attr(IDENTITY, self.identity)

    def asked(self) -> list[FrozenTrial]:
        """Every trial that anybody has asked for, in order."""
        return [trial for trial in self.study.trials if trial.state != TrialState.WAITING]

    def opened(self) -> dict:
        """All that the storage knows. A kill may have left a trial with some of its values."""
        identity = self.study.user_attrs[IDENTITY]
        # Otherwise the caller refuses it, and nothing may be changed.
        if identity == self.identity:
            for values in self.first:
                self.study.enqueue_trial(values, skip_if_exists=True)
            for trial in self.asked():
                if trial.state == TrialState.RUNNING:
                    self.suggest(self.running(trial.number))
        return {"identity": identity, "trials": [described(trial) for trial in self.asked()]}

    def ask(self) -> dict:
        """The next trial."""
        # A seed of its own for each trial: with one for all, a study that goes on would be asked
        # what it was asked at its start.
        seed = np.random.SeedSequence([self.seed, len(self.asked())]).generate_state(1)[0]
        self.study.sampler = sampler(self.sampler, int(seed))
        trial = self.study.ask()
        return {"trial": trial.number, "values": self.suggest(trial)}

    def suggest(self, trial: Trial) -> dict:
        """A value for each key; those that the trial has already stay."""
        values = {}
        for entry in self.space:
            key = entry["key"]
            if "choices" in entry:
                values[key] = trial.suggest_categorical(key, entry["choices"])
            else:
                suggest = trial.suggest_int if entry["kind"] == "int" else trial.suggest_float
                values[key] = suggest(key, entry["low"], entry["high"], log=entry["log"])
        return values

    def running(self, number: int) -> Trial:
        """A trial under way; another state is a mistake of the caller's."""
        frozen = self.study.trials[number]
        if frozen.state != TrialState.RUNNING:
            raise RefusedError(f"trial {number} is {frozen.state.name}, expected RUNNING")
        return Trial(self.study, frozen._trial_id)

    def report(self, number: int, step: int, value: float) -> dict:
        """Adds an intermediate value, the first of a step only; whether to give the trial up."""
        trial = self.running(number)
        if step not in self.study.trials[number].intermediate_values:
            trial.report(value, step)
        return {"prune": bool(trial.should_prune())}

    def tell(self, number: int, state: str, objective: float | None) -> dict:
        """Ends a trial."""
        self.running(number)
        self.study.tell(number, values=objective, state=TrialState[STATES[state]])
        return {}


def described(trial: FrozenTrial) -> dict:
    """A trial in JSON."""
    names = {name: ours for ours, name in STATES.items()}
    return {
        "trial": trial.number,
        "state": names[trial.state.name],
        "values": trial.params,
        "objective": trial.value if trial.state == TrialState.COMPLETE else None,
        "reported": sorted(trial.intermediate_values),
    }


def sampler(name: str, seed: int) -> optuna.samplers.BaseSampler:
    """By the name that the sweep file has."""
    if name == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed)


def pruner(request: dict) -> optuna.pruners.BasePruner:
    """By the name that the sweep file has."""
    if request["pruner"] == "median":
        return optuna.pruners.MedianPruner(n_startup_trials=request["prune_after_trials"])
    if request["pruner"] == "hyperband":
        return optuna.pruners.HyperbandPruner(max_resource=request["steps_max"])
    return optuna.pruners.NopPruner()


class Search:
    """The studies of one storage."""

    def __init__(self, storage: str) -> None:
        self.storage = storage
        self.studies: dict[str, Study] = {}

    def answer(self, request: dict) -> dict:
        """Does what a request asks for."""
        operation, name = request["op"], request["study"]
        if operation == "open":
            self.studies[name] = Study(self.storage, request)
            return self.studies[name].opened()
        study = self.studies[name]
        if operation == "ask":
            return study.ask()
        if operation == "report":
            return study.report(request["trial"], request["step"], request["value"])
        if operation == "tell":
            return study.tell(request["trial"], request["state"], request["objective"])
        raise RefusedError(f"unknown operation {operation}")


def main() -> None:
    """Speaks the protocol of the module's first lines."""
    # Ctrl-C may reach the whole process group; the program that reads our lines decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What a library prints must not become a line of the protocol.
    lines = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)

    def say(answer: dict) -> None:
        lines.write(json.dumps(answer) + "\n")

    if optuna is None:
        say({"absent": ABSENT})
        return
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    search = Search(sys.argv[1])
    say({"ready": f"optuna {optuna.__version__}"})
    for line in sys.stdin:
        try:
            answer = search.answer(json.loads(line))
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        say(answer)


if __name__ == "__main__":
    main()
