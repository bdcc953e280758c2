use dmprl_actors::{evaluate::Evaluator, python_env::*, rollout::*};
use dmprl_learner::{learner::Learner, session::*};
use dmprl_shared::config::*;
use dmprl_shared::transport::*;
fn main() {
    let mut layers = Layers::new();
    let args: Vec<String> = std::env::args().collect();
    let task = task_defaults(&args[1]).unwrap();
    layers.add("task", task.table()).unwrap();
    for a in &args[2..] {
        let (k, v) = a.split_once('=').unwrap();
        if k == "preset" {
            layers.add(v, PRESETS.iter().find(|p| p.name == v).unwrap().table()).unwrap();
            continue;
        }
        layers.set("--set", k, v).unwrap();
    }
    let mut config = layers.finish().unwrap();
    config.run.deterministic = true;
    let config = config.resolve(Limits { cores: 2 }).unwrap();
    let venv = dmprl_tests::venv().venv.clone();
    let interp = Interpreter::start(&InterpreterOptions { venv, python_path: vec![] }).unwrap();
    let k = config.policy.decision_steps();
    let envs =
        PythonEnvironments::start(&interp, &config.task.id, config.actors.envs_per_worker, k)
            .unwrap();
    let spec = envs.spec().clone();
    let ee = PythonEnvironments::start(&interp, &config.task.id, 10, k).unwrap();
    let mut judge = Evaluator::new(&config, ee, 10).unwrap();
    let learner = Learner::new(config.clone(), &spec, 1).unwrap();
    let mut rollout =
        Rollout::start(&config, envs, Identity { run_id: 1, worker_id: 0, incarnation: 0 })
            .unwrap();
    let (mut senders, receiver) =
        in_process::segment_queues(1, config.actors.envs_per_worker, learner.policy().layout());
    let (publisher, mut parameters) =
        in_process::parameter_channel(learner.policy().architecture_hash());
    let mut session =
        Session::start::<std::convert::Infallible>(learner, receiver, publisher).unwrap();
    let t0 = std::time::Instant::now();
    let mut eval = |l: &mut Learner| {
        let e = judge.evaluate(&l.snapshot().values, 20, 5000).unwrap();
        println!(
            "{} steps {} ret {:.2} smooth {:.4} t {:.1} upd {}",
            args[2..].join(" "),
            l.counters.env_steps,
            e.return_mean(),
            e.smoothness,
            t0.elapsed().as_secs_f64(),
            l.counters.updates
        );
    };
    loop {
        let end = loop {
            let t = session
                .turn(&mut |d, l: &mut Learner| {
                    if d == Due::Evaluation {
                        eval(l)
                    }
                    Ok::<_, std::convert::Infallible>(())
                })
                .unwrap();
            if t != Turn::Worked {
                break t;
            }
        };
        if end == Turn::Finished {
            break;
        }
        parameters.newest(&mut rollout.snapshot).unwrap();
        rollout
            .segment::<RolloutError>(&mut |h, b| {
                assert_eq!(senders[0].try_send(h, b).unwrap(), SendOutcome::Delivered);
                Ok(())
            })
            .unwrap();
    }
    session.publish::<std::convert::Infallible>().unwrap();
    eval(&mut session.learner);
}
