"""Proposes the values of the next trial and prunes trials, for ``dmprl sweep``.

``python -m dmprl.search STORAGE`` reads requests from standard input and writes one answer to each
on standard output; both are JSON objects, one per line. The first output line is
``{"ready": "optuna 5.0.0"}``, or ``{"absent": "reason"}``.

================================================= =============================================
``{"op": "open", "study": …, "identity": …, …}``  ``{"identity": …, "trials": [{"trial", "state",
                                                  "values", "objective", "reported"}, …]}``
``{"op": "ask", "study": …}``                     ``{"trial": 7, "values": {key: value}}``
``{"op": "report", …, "step": 3, "value": -5.1}`` ``{"prune": false}``
``{"op": "tell", …, "state": …, "objective": …}`` ``{}``
================================================= =============================================

A failed request is answered by ``{"error": "reason"}``. The process exits at the end of its input,
and thus with the program that started it. All data are in an Optuna storage, and are written before
the answer. Reopening the storage returns all trials, including active ones.
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
"""Attribute of the Optuna study with the settings that all its trials share."""
STATES = {"running": "RUNNING", "finished": "COMPLETE", "pruned": "PRUNED", "failed": "FAIL"}
"""Optuna's states by dmprl's names. A trial in Optuna's state WAITING has not been requested."""


class RefusedError(Exception):
    """Raised for an invalid request. The message gives the reason."""


class Study:
    """One task and method: an Optuna study and its search space."""

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
        """Returns every trial that has been requested, in order."""
        return [trial for trial in self.study.trials if trial.state != TrialState.WAITING]

    def opened(self) -> dict:
        """Returns all stored data.

        If a process was killed while it created a trial, this adds the trial's missing values.
        """
        identity = self.study.user_attrs[IDENTITY]
        # If they differ, the caller rejects the study, and nothing may change.
        if identity == self.identity:
            for values in self.first:
                self.study.enqueue_trial(values, skip_if_exists=True)
            for trial in self.asked():
                if trial.state == TrialState.RUNNING:
                    self.suggest(self.running(trial.number))
        return {"identity": identity, "trials": [described(trial) for trial in self.asked()]}

    def ask(self) -> dict:
        """Creates the next trial."""
        # A different seed for each trial. With a common one, a resumed study would repeat its first
        # values.
        seed = np.random.SeedSequence([self.seed, len(self.asked())]).generate_state(1)[0]
        self.study.sampler = sampler(self.sampler, int(seed))
        trial = self.study.ask()
        return {"trial": trial.number, "values": self.suggest(trial)}

    def suggest(self, trial: Trial) -> dict:
        """Suggests a value for each key; values that the trial already has are kept."""
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
        """Returns a trial that is running; raises RefusedError if it is not."""
        frozen = self.study.trials[number]
        if frozen.state != TrialState.RUNNING:
            raise RefusedError(f"trial {number} is {frozen.state.name}, expected RUNNING")
        return Trial(self.study, frozen._trial_id)

    def report(self, number: int, step: int, value: float) -> dict:
        """Reports an intermediate value, once per step; returns whether to prune the trial."""
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
    """Converts a trial to JSON."""
    names = {name: ours for ours, name in STATES.items()}
    return {
        "trial": trial.number,
        "state": names[trial.state.name],
        "values": trial.params,
        "objective": trial.value if trial.state == TrialState.COMPLETE else None,
        "reported": sorted(trial.intermediate_values),
    }


def sampler(name: str, seed: int) -> optuna.samplers.BaseSampler:
    """Creates a sampler by its name in the sweep file."""
    if name == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed)


def pruner(request: dict) -> optuna.pruners.BasePruner:
    """Creates a pruner by its name in the sweep file."""
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
        """Executes a request."""
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
    """Answers requests, as described in the module's docstring."""
    # Ctrl-C may reach the whole process group; the program that started this one handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Libraries may print; only answers may reach the caller.
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
