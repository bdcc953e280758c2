//! Measures an update, the kernels of its products, and the limit of the processor.
//!
//!     cargo bench -p dmprl-learner --bench update_kernels [-- --rounds 300 --only update]
//!
//! The update is that of DDPG-DMP with Pusher's sizes (actor 23-256-256-70, critic 58-256-256-1,
//! batch 256). All candidates alternate in one process, because on a shared machine only ratios of
//! medians are meaningful. Times are CPU times of the calling thread, so that other processes do
//! not count, except for updates on two threads, whose times are wall times. `dmprl bench learner`
//! compares the update with all of its products.

use std::hint::black_box;
use std::time::{Duration, Instant};

use dmprl_learner::algorithms::{Algorithm, Batch};
use dmprl_learner::update::kernels::bf16::Bf16;
use dmprl_learner::update::kernels::{
    Activation, Backward, Forward, GradientShard, InstructionSet, WeightGradient, pack, packed_len,
};
use dmprl_shared::config::{ExperimentConfig, Layers};
use dmprl_shared::policy::Policy;
use dmprl_shared::spec::EnvSpec;

struct Candidate {
    name: String,
    /// Multiplications and additions, if they are known.
    operations: Option<usize>,
    /// Whether the calling thread does all the work.
    single_threaded: bool,
    work: Box<dyn FnMut()>,
    times_s: Vec<f64>,
}

fn candidate(name: &str, operations: Option<usize>, work: impl FnMut() + 'static) -> Candidate {
    Candidate {
        name: name.into(),
        operations,
        single_threaded: true,
        work: Box::new(work),
        times_s: Vec::new(),
    }
}

/// Measures the processor's limit: independent chains of fused multiplications and additions on
/// registers.
fn peak() -> Candidate {
    const ROUNDS: usize = 20_000;
    let instructions = InstructionSet::detect();
    let operations = instructions.saturate(1) * ROUNDS;
    candidate("processor's limit", Some(operations), move || {
        let _ = black_box(instructions.saturate(ROUNDS));
    })
}

fn config(threads: &str, precision: &str, norm: &str) -> (ExperimentConfig, EnvSpec) {
    let mut layers = Layers::new();
    let keys = [
        ("algorithm.name", "ddpg"),
        ("learner.threads", threads),
        ("learner.precision", precision),
        ("algorithm.critic_layer_norm", norm),
        ("algorithm.batch_size", "256"),
        ("policy.hidden", "[256, 256]"),
        ("algorithm.critic_hidden", "[256, 256]"),
    ];
    for (key, value) in keys {
        layers.set("bench", key, value).expect("a known key");
    }
    let spec = EnvSpec::new("Pusher-v5", 23, &[(-2.0, 2.0); 7], 0.05, 100);
    (layers.finish().expect("a valid configuration"), spec)
}

fn update(threads: &str, precision: &str, norm: &str) -> impl FnMut() + 'static {
    let (config, spec) = config(threads, precision, norm);
    let policy = Policy::new(config.policy_description(&spec)).expect("a policy");
    let mut algorithm = Algorithm::new(&config, &policy, None).expect("an algorithm");
    let mut batch = Batch::new(algorithm.batch_shape());
    let numbers = [
        &mut batch.observations,
        &mut batch.inputs,
        &mut batch.critic_inputs,
        &mut batch.rewards,
        &mut batch.bootstrap,
        &mut batch.next_observations,
        &mut batch.next_inputs,
    ];
    for values in numbers {
        values.iter_mut().enumerate().for_each(|(i, value)| *value = (i as f32 * 0.37).sin());
    }
    let mut count = 0;
    move || {
        count += 1;
        black_box(algorithm.update(&policy, &batch, count).expect("an update"));
    }
}

/// Rows, inputs and outputs of the measured products.
const SIZE: usize = 256;

/// Measures each kernel on square matrices.
fn kernels() -> [Candidate; 3] {
    let numbers = || (0..SIZE * SIZE).map(|i| (i as f32).sin()).collect::<Vec<_>>();
    let instructions = InstructionSet::detect();
    let (inputs, weights, bias) = (numbers(), numbers(), vec![0.0; SIZE]);
    let mut packed = vec![0.0; packed_len(SIZE, SIZE)];
    pack(&weights, SIZE, SIZE, &mut packed, instructions);
    let mut outputs = numbers();
    let operations = Some(2 * SIZE * SIZE * SIZE);
    let forward = candidate("Forward 256^3", operations, move || {
        let (inputs, outputs) = (&inputs, &mut outputs);
        let activation = Activation::Linear;
        Forward { inputs, packed: &packed, bias: &bias, activation, outputs }.run(instructions);
    });
    let (gradient, mut inputs_gradient) = (numbers(), numbers());
    let backward = candidate("Backward 256^3", operations, move || {
        let (gradient, weights, inputs_gradient) = (&gradient, &weights, &mut inputs_gradient);
        let (outputs_len, first, activations) = (SIZE, 0, None);
        Backward { gradient, weights, outputs_len, first, activations, inputs_gradient }
            .run(instructions);
    });
    let (gradient, inputs) = (numbers(), numbers());
    let (mut weights, mut bias) = (numbers(), vec![0.0; SIZE]);
    let weight_gradient = candidate("WeightGradient 256^3", operations, move || {
        WeightGradient {
            shards: std::iter::once(GradientShard { gradient: &gradient, inputs: &inputs }),
            inputs_len: SIZE,
            outputs_len: SIZE,
            outputs: 0..SIZE,
            weights: &mut weights,
            bias: &mut bias,
        }
        .run(instructions);
    });
    [forward, backward, weight_gradient]
}

/// Returns the CPU time of this thread.
fn thread_time() -> Duration {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer refers to a local timespec.
    let status = unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &raw mut time) };
    assert_eq!(status, 0, "the clock of a thread");
    Duration::new(time.tv_sec.unsigned_abs(), time.tv_nsec.unsigned_abs() as u32)
}

fn main() {
    let argument = |name: &str| std::env::args().skip_while(|it| it != name).nth(1);
    let rounds = argument("--rounds").map_or(100, |text| text.parse().expect("a number"));
    let mut candidates = vec![peak()];
    candidates.extend(kernels());
    let mut precisions = vec!["f32"];
    precisions.extend(Bf16::detect().map(|_| "bf16"));
    for (precision, threads) in precisions.into_iter().flat_map(|it| [(it, "1"), (it, "2")]) {
        let name = format!("update, {precision}, {threads}");
        let plain = candidate(&name, None, update(threads, precision, "false"));
        candidates.push(Candidate { single_threaded: threads == "1", ..plain });
        if threads == "1" {
            let name = format!("update, {precision}, 1, layer norm");
            candidates.push(candidate(&name, None, update("1", precision, "true")));
        }
    }
    let only = argument("--only").unwrap_or_default();
    candidates.retain(|candidate| candidate.name.contains(&only));
    for round in 0..rounds + 5 {
        for candidate in &mut candidates {
            let (begun, begun_running) = (Instant::now(), thread_time());
            (candidate.work)();
            let running = thread_time() - begun_running;
            let time = if candidate.single_threaded { running } else { begun.elapsed() };
            if round >= 5 {
                candidate.times_s.push(time.as_secs_f64());
            }
        }
    }
    for Candidate { name, operations, times_s, .. } in &mut candidates {
        times_s.sort_by(f64::total_cmp);
        let median_s = times_s[times_s.len() / 2];
        let best_s = times_s[times_s.len() / 10];
        let (median_us, best_us) = (median_s * 1e6, best_s * 1e6);
        let rate =
            operations.map(|count| format!("{:6.1} GFLOP/s", count as f64 / median_s * 1e-9));
        let rate = rate.unwrap_or_default();
        println!("{name:32} {median_us:9.1} us (10 %: {best_us:9.1})  {rate}");
    }
}
