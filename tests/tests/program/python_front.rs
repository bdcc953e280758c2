//! The program from Python: `dmprl.train`, `dmprl.Run`, `dmprl.make`.

use std::process::Command;

use dmprl_shared::config::TASKS;
use dmprl_tests::program::{Finished, Workplace};
use dmprl_tests::{project_root, venv};
use rustix::process::Signal;

/// Settings of every script: small networks, few updates.
const SMALL: &str = "dict(
    policy__hidden=[32], algorithm__critic_hidden=[32], exploration__warm_up_steps=500,
    evaluation__episodes=2, evaluation__interval_steps=500, checkpoint__interval_steps=500,
    metrics__interval_steps=500)";

fn command(script: &str) -> Command {
    let mut command = Command::new(&venv().executable);
    let path = dmprl_tests::program::executable().parent().unwrap().to_owned();
    command.args(["-c", &format!("import dmprl\nSMALL = {SMALL}\n{script}")]);
    command.env("PYTHONPATH", project_root().join("envs_py"));
    command.env("PATH", format!("{}:{}", path.display(), std::env::var("PATH").unwrap()));
    command
}

fn python(place: &Workplace, script: &str) -> Finished {
    place.start_command(command(script)).wait()
}

#[test]
fn a_run_is_trained_read_and_acted_with() {
    let place = Workplace::new();
    let script = "
run = dmprl.train('reacher', run_dir='mine', steps=1200, seed=3, **SMALL)
assert run.config['run']['seed'] == 3 and run.config['policy']['hidden'] == [32]
env = dmprl.make('reacher')
observation, _ = env.reset(seed=1)
policy = run.policy('latest')
for action in policy.segment(observation):
    assert env.action_space.contains(action.astype('f4')), action
    observation, *_ = env.step(action)
print(run, policy)
try:
    run.record(policy='first')
except dmprl.ProgramError as error:
    print(error)
";
    let ended = python(&place, script).with_status(0).saying("evaluation at");
    let first = format!(
        "Run('{}') <Policy for Reacher-v5: observation of 10 values, 5 actions of 2 values per \
         decision, 0.02 s per action>",
        place.path("mine")
    );
    let (printed, refused) = ended.printed.split_once('\n').unwrap();
    assert_eq!(printed, first);
    for words in ["dmprl record ended with status 2", "first", "latest"] {
        assert!(refused.contains(words), "no `{words}` in {refused}");
    }
    place.assert_no_process();
}

#[test]
fn what_the_program_refuses_is_an_error_in_its_own_words() {
    let place = Workplace::new();
    let script = "
for task, settings in [('reachr', {}), ('reacher', {'algorithm__batch_sise': 3})]:
    try:
        dmprl.train(task, quiet=True, **settings)
    except dmprl.TrainingError as error:
        print(error.status, error)
";
    let printed = python(&place, script).with_status(0).printed;
    for words in ["2 dmprl train ended with status 2", "reacher", "algorithm.batch_size"] {
        assert!(printed.contains(words), "no `{words}` in {printed}");
    }
}

#[test]
fn an_interrupt_of_python_stops_the_training_with_a_checkpoint() {
    for signal in [Signal::INT, Signal::KILL] {
        let place = Workplace::new();
        let script = "dmprl.train('reacher', run_dir='mine', steps=10**9, **SMALL)";
        let mut running = place.start_command(command(script));
        running.until_steps(&place.path("mine"), 500);
        running.signal(signal);
        let ended = running.wait();
        place.until_no_process();
        if signal == Signal::INT {
            assert!(ended.said.contains("KeyboardInterrupt"), "{}", ended.said);
        }
        let latest = place.path("mine/checkpoints/latest/state.json");
        assert!(std::path::Path::new(&latest).is_file(), "{signal:?}: no checkpoint");
    }
}

#[test]
fn whatever_ends_the_call_nobody_trains_on() {
    let place = Workplace::new();
    let script = "
import signal, threading
def alarm(*_): raise TimeoutError('enough')
signal.signal(signal.SIGALRM, alarm)
class Watch(threading.Thread):
    def run(self):
        import os, pathlib
        while not pathlib.Path('mine/checkpoints/latest').exists(): threading.Event().wait(0.05)
        os.kill(os.getpid(), signal.SIGALRM)
Watch(daemon=True).start()
try:
    dmprl.train('reacher', run_dir='mine', steps=10**9, init_from=None, quiet=True, **SMALL)
except TimeoutError as error:
    print(error)
";
    assert_eq!(python(&place, script).with_status(0).printed.trim(), "enough");
    place.until_no_process();
}

#[test]
fn callbacks_see_a_run_and_stop_it_with_a_checkpoint() {
    let place = Workplace::new();
    let script = "
import json
class Told(dmprl.Callback):
    def __init__(self): self.evaluations, self.metrics, self.checkpoints, self.ends = [], [], [], 0
    def on_evaluation(self, run, row):
        self.evaluations.append(row['env_steps'])
        return len(self.evaluations) < 4
    def on_metrics(self, run, row): self.metrics.append(row['delivery/received'])
    def on_checkpoint(self, run, path): self.checkpoints.append(path)
    def on_end(self, run): self.ends += 1
told = Told()
run = dmprl.train('reacher', run_dir='mine', steps=10**9, quiet=True, callbacks=[told], **SMALL)
seen = [row['env_steps'] for row in map(json.loads, open('mine/evaluations.jsonl'))]
assert told.evaluations == seen and len(seen) >= 4, (told.evaluations, seen)
assert told.metrics == sorted(told.metrics) and told.metrics[-1] > 0
assert told.checkpoints[-1] == (run.path / 'checkpoints/latest').resolve()
assert told.ends == 1
class Failing(dmprl.Callback):
    def on_checkpoint(self, run, path): raise LookupError('no space for', path.name)
try:
    dmprl.train('reacher', run_dir='other', steps=10**9, quiet=True, callbacks=[Failing()], **SMALL)
except LookupError as error:
    print(error)
";
    let printed = python(&place, script).with_status(0).printed;
    assert!(printed.contains("no space for"), "{printed}");
    place.until_no_process();
}

#[test]
fn every_task_has_its_short_name_in_python_too() {
    let place = Workplace::new();
    let script = "import json; print(json.dumps(dmprl.SHORT_NAMES))";
    let names = python(&place, script).with_status(0).json();
    assert_eq!(names.as_object().unwrap().len(), TASKS.len());
    for task in TASKS {
        let id = names[task.name].as_str().unwrap();
        assert_eq!(id.trim_start_matches("dmprl/"), task.id.trim_start_matches("dmprl/"));
    }
}
