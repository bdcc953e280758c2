//! Measures parts of an update separately: matrix products, sampling, optimiser.

use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use anyhow::{bail, ensure};
use dmprl_learner::algorithms::{Batch, BatchShape, SampleSource};
use dmprl_learner::learner::Learner;
use dmprl_learner::regime::Regime;
use dmprl_learner::update::kernels::InstructionSet;
use dmprl_learner::update::thread_pool::ThreadPool;
use dmprl_shared::policy::Head;
use rustix::time::{ClockId, clock_gettime};

use super::figures::Timed;
use super::floor::{Engine, Floor};
use super::optimiser::OptimiserSteps;
use super::products::{Cycle, Product};

/// The warm-up takes 1 / `WARM_UP_DIVISOR` of the measurement's duration. It brings caches and
/// clock frequency to the state of a long run.
const WARM_UP_DIVISOR: u32 = 8;

/// Calls `work` repeatedly for `duration`, after a warm-up, and returns the mean time of a call.
pub(crate) fn timed(
    duration: Duration,
    mut work: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<Timed> {
    let end = Instant::now() + duration / WARM_UP_DIVISOR;
    while Instant::now() < end {
        work()?;
    }
    let (start, cpu, mut calls) = (Instant::now(), cpu_s(), 0.0);
    // Calls it at least once: on a busy machine, the time may be over before the first call.
    loop {
        work()?;
        calls += 1.0;
        if start.elapsed() >= duration {
            break;
        }
    }
    let wall_s = start.elapsed().as_secs_f64() / calls;
    ensure!(wall_s > 0.0, "the clock did not advance within {duration:?}");
    Ok(Timed { wall_s, cpu_s: (cpu_s() - cpu) / calls })
}

/// Returns the processor time of all threads of this process so far [s].
fn cpu_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// The matrix products of an update, with the rows divided among the threads. Excludes the sum over
/// the threads' weight gradients, which is not a product.
pub(super) struct FloorWork {
    pool: ThreadPool,
    shares: Vec<Floor>,
    updates: f64,
}

impl FloorWork {
    pub(super) fn new(learner: &Learner, cycle: &Cycle) -> Self {
        let threads = learner.config().learner.threads;
        let Cycle { products, updates } = cycle;
        let share = |index: usize| {
            let of = |product: &Product| {
                let rows = product.rows * (index + 1) / threads - product.rows * index / threads;
                (rows > 0).then_some(Product { rows, ..*product })
            };
            Floor::new(products.iter().filter_map(of), learner.config().learner.precision)
        };
        Self {
            pool: ThreadPool::new(threads),
            shares: (0..threads).map(share).collect(),
            updates: *updates as f64,
        }
    }

    pub(super) fn measure(&mut self, engine: Engine, duration: Duration) -> anyhow::Result<Timed> {
        let Self { pool, shares, updates } = self;
        let cycle = timed(duration, || {
            pool.for_each(shares, |floor| floor.run(engine));
            Ok(())
        })?;
        Ok(cycle.over(*updates))
    }
}

/// Multiplications and additions on registers, as many as all matrix products of an update have. No
/// update is faster.
pub(super) struct LimitWork {
    pool: ThreadPool,
    /// Rounds of each thread.
    rounds: Vec<usize>,
}

impl LimitWork {
    pub(super) fn new(learner: &Learner, cycle: &Cycle) -> Self {
        let threads = learner.config().learner.threads;
        let products = cycle.products.iter().map(|product| {
            let Product { rows, inputs, outputs, .. } = product;
            2 * rows * inputs * outputs
        });
        let update = products.sum::<usize>() / cycle.updates as usize;
        let rounds = update / threads / InstructionSet::detect().saturate(1);
        Self { pool: ThreadPool::new(threads), rounds: vec![rounds; threads] }
    }

    pub(super) fn measure(&mut self, duration: Duration) -> anyhow::Result<Timed> {
        let instructions = InstructionSet::detect();
        timed(duration, || {
            self.pool.for_each(&mut self.rounds, |rounds| {
                let _ = instructions.saturate(*rounds);
            });
            Ok(())
        })
    }
}

/// Round trips of a cache line between two readings of the clock.
const ROUND_TRIPS: u32 = 200;
/// Readings of the clock. The scheduler may interrupt some of them.
const READINGS: usize = 101;
/// Time limit of all readings. Without a free core, each way of the line takes a time slice.
const HANDOVER_MAX: Duration = Duration::from_millis(200);
/// Value of the line that ends the other thread.
const END: u32 = u32::MAX;

/// Measures how long a cache line takes from one core to another. Threads exchange thousands of
/// lines in an update. In a virtual machine this time changes with the cores that it runs on.
pub(super) fn handover() -> Timed {
    let line = AtomicU32::new(0);
    let start = Instant::now();
    let mut readings = Vec::with_capacity(READINGS);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut awaited = 1;
            loop {
                match line.load(Ordering::Acquire) {
                    END => break,
                    value if value == awaited => {
                        line.store(value + 1, Ordering::Release);
                        awaited += 2;
                    }
                    _ => std::hint::spin_loop(),
                }
            }
        });
        let mut sent = 1;
        while readings.len() < READINGS && (readings.is_empty() || start.elapsed() < HANDOVER_MAX) {
            let (start, cpu) = (Instant::now(), cpu_s());
            for _ in 0..ROUND_TRIPS {
                line.store(sent, Ordering::Release);
                while line.load(Ordering::Acquire) != sent + 1 {
                    std::hint::spin_loop();
                }
                sent += 2;
            }
            let all = Timed { wall_s: start.elapsed().as_secs_f64(), cpu_s: cpu_s() - cpu };
            readings.push(all.over(f64::from(2 * ROUND_TRIPS)));
        }
        line.store(END, Ordering::Release);
    });
    readings.sort_by(|a, b| a.wall_s.total_cmp(&b.wall_s));
    readings[readings.len() / 2]
}

/// The sampling of a batch.
pub(super) struct SampleWork {
    batch: Batch,
    shape: BatchShape,
    omega: f32,
}

impl SampleWork {
    pub(super) fn new(learner: &Learner) -> anyhow::Result<Self> {
        let Regime::OffPolicy(off_policy) = &learner.regime else {
            bail!("an on-policy algorithm samples no batch")
        };
        let shape = off_policy.algorithm.batch_shape();
        let omega = match learner.policy().head() {
            Head::Dmp(head) => head.omega(),
            Head::Mlp => 1.0,
        };
        Ok(Self { batch: Batch::new(shape), shape, omega })
    }

    pub(super) fn measure(
        &mut self,
        learner: &mut Learner,
        duration: Duration,
    ) -> anyhow::Result<Timed> {
        let config = learner.config().algorithm.clone();
        let Self { batch, shape, omega } = self;
        timed(duration, || {
            let Learner { replay, sampler, hindsight, jerk_cost, normaliser, .. } = &mut *learner;
            let (hindsight, jerk_cost) = (hindsight.as_ref(), jerk_cost.as_ref());
            let normaliser = normaliser.as_ref();
            let mut source = SampleSource { replay, sampler, hindsight, jerk_cost, normaliser };
            Ok(batch.sample(*shape, &config, *omega, &mut source)?)
        })
    }
}

/// The optimiser and the target networks, without the gradients.
pub(super) struct OptimiserWork(OptimiserSteps);

impl OptimiserWork {
    pub(super) fn new(learner: &Learner, cycle: &Cycle) -> Self {
        Self(OptimiserSteps::new(learner, cycle.updates))
    }

    pub(super) fn measure(&mut self, duration: Duration) -> anyhow::Result<Timed> {
        let cycle = timed(duration, || {
            self.0.run();
            Ok(())
        })?;
        Ok(cycle.over(self.0.updates as f64))
    }
}
