//! Exports the newest metrics of every run to Prometheus, in the OpenMetrics text format.

use std::fmt;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Registry;
use serde_json::Value;

use super::cached_run::{CachedRun, State};
use super::catalogue::Catalogue;

/// Content type of the response.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// A metric of `metrics.jsonl`, by its key in a line of that file.
struct Metric {
    name: &'static str,
    help: &'static str,
    key: &'static str,
    kind: Kind,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A total over the whole run. It decreases only when a resume goes back to a checkpoint.
    Counter,
    Gauge,
}

const fn counter(name: &'static str, key: &'static str, help: &'static str) -> Metric {
    Metric { name, help, key, kind: Kind::Counter }
}

const fn gauge(name: &'static str, key: &'static str, help: &'static str) -> Metric {
    Metric { name, help, key, kind: Kind::Gauge }
}

/// Metrics of `metrics.jsonl`. A null value has no sample.
const METRICS: [Metric; 28] = [
    counter("dmprl_env_steps", "env_steps", "Environment steps inserted"),
    counter("dmprl_updates", "updates", "Updates done"),
    counter("dmprl_segments", "segments", "Segments inserted"),
    counter("dmprl_training_seconds", "wall_s", "Training time over all sessions, in seconds"),
    counter("dmprl_worker_restarts", "worker_restarts", "Restarts of workers"),
    counter("dmprl_learner_restarts", "learner_restarts", "Restarts of the learner"),
    counter("dmprl_env_failures", "env_failures", "Environment failures"),
    counter("dmprl_lost_segments", "lost", "Segments missing from the workers' sequences"),
    counter("dmprl_produced_segments", "delivery.produced", "Segments finished by workers"),
    counter("dmprl_received_segments", "delivery.received", "Segments inserted or rejected"),
    gauge("dmprl_env_steps_per_second", "env_steps_per_s", "Current environment steps per second"),
    gauge("dmprl_updates_per_second", "updates_per_s", "Current updates per second"),
    gauge("dmprl_workers", "workers", "Attached workers"),
    gauge("dmprl_queued_segments", "queued_segments", "Segments waiting for the learner"),
    gauge("dmprl_replay_segments", "replay_segments", "Segments in the replay buffer"),
    gauge("dmprl_samples_per_insert", "samples_per_insert", "Updates x batch size / steps"),
    gauge("dmprl_updates_owed", "updates_owed", "Updates due according to the pacing"),
    gauge("dmprl_policy_lag_p50", "policy_lag_p50", "Median policy lag, in versions"),
    gauge("dmprl_policy_lag_max", "policy_lag_max", "Maximum policy lag, in versions"),
    gauge("dmprl_critic_loss", "critic_loss", "Loss of the critics"),
    gauge("dmprl_actor_loss", "actor_loss", "Loss of the actor"),
    gauge("dmprl_q_mean", "q_mean", "Mean Q over the samples"),
    gauge("dmprl_temperature", "temperature", "SAC, TQC: weight of the entropy"),
    gauge("dmprl_entropy", "entropy", "SAC, TQC, NDP: entropy of the policy"),
    gauge("dmprl_policy_loss", "policy_loss", "NDP: loss of the policy"),
    gauge("dmprl_value_loss", "value_loss", "NDP: loss of the value function"),
    gauge(
        "dmprl_training_return_mean",
        "training_return_mean",
        "Mean return of training episodes, with exploration",
    ),
    gauge(
        "dmprl_training_success_rate",
        "training_success_rate",
        "Success rate of training episodes, with exploration",
    ),
];

/// Current values of one run.
#[derive(Debug)]
struct Sample {
    labels: Vec<(&'static str, String)>,
    training: bool,
    steps_wanted: u64,
    last_metrics: Value,
    rejected: Vec<(String, f64)>,
    evaluation: Option<Evaluation>,
}

/// Results of the newest evaluation.
#[derive(Debug, Clone, Copy)]
struct Evaluation {
    return_mean: f64,
    success_rate: Option<f64>,
    smoothness: f64,
}

#[derive(Debug)]
struct Samples(Vec<Sample>);

/// Returns the response to a scrape.
///
/// # Errors
/// Encoding fails, which is not expected: the text is written to memory.
pub fn text(catalogue: &mut Catalogue) -> anyhow::Result<String> {
    super::api::refresh(catalogue);
    let readable = |(_, run): &(&String, &CachedRun)| run.fault.is_none();
    let samples = catalogue.runs.iter().filter(readable).map(|(name, run)| Sample::of(name, run));
    let mut registry = Registry::default();
    registry.register_collector(Box::new(Samples(samples.collect())));
    let mut text = String::new();
    encode(&mut text, &registry)?;
    Ok(text)
}

impl Sample {
    fn of(name: &str, run: &CachedRun) -> Self {
        let info = &run.info;
        let rejected = run.last_metrics["rejected"].as_object().into_iter().flatten();
        Self {
            labels: vec![
                ("run", name.to_owned()),
                ("task", info.task.clone()),
                ("algorithm", info.algorithm.clone()),
                ("policy", info.policy.clone()),
                ("seed", info.seed.to_string()),
            ],
            training: run.state == State::Training,
            steps_wanted: info.steps,
            rejected: rejected
                .filter_map(|(reason, count)| Some((reason.clone(), count.as_f64()?)))
                .collect(),
            last_metrics: run.last_metrics.clone(),
            evaluation: run.evaluations.last().map(|row| Evaluation {
                return_mean: row.return_mean,
                success_rate: row.success_rate,
                smoothness: row.smoothness,
            }),
        }
    }

    /// Returns the number at a key, in which dots separate the levels of nested objects.
    fn number(&self, key: &str) -> Option<f64> {
        key.split('.').fold(&self.last_metrics, |value, key| &value[key]).as_f64()
    }
}

impl Collector for Samples {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        for metric in &METRICS {
            self.family(&mut encoder, metric, |sample| sample.number(metric.key))?;
        }
        let rejected = "Segments rejected, by reason";
        let kind = MetricType::Counter;
        let mut family =
            encoder.encode_descriptor("dmprl_rejected_segments", rejected, None, kind)?;
        for sample in &self.0 {
            for (reason, count) in &sample.rejected {
                let mut labels = sample.labels.clone();
                labels.push(("reason", reason.clone()));
                ConstCounter::new(*count).encode(family.encode_family(&labels)?)?;
            }
        }
        let training = gauge("dmprl_training", "", "1 while the run is training, else 0");
        self.family(&mut encoder, &training, |sample| Some(f64::from(u8::from(sample.training))))?;
        let wanted = gauge("dmprl_env_steps_wanted", "", "Configured number of environment steps");
        self.family(&mut encoder, &wanted, |sample| Some(sample.steps_wanted as f64))?;
        self.encode_evaluations(&mut encoder)
    }
}

impl Samples {
    fn encode_evaluations(&self, encoder: &mut DescriptorEncoder) -> fmt::Result {
        let return_mean =
            gauge("dmprl_evaluation_return_mean", "", "Mean return in the newest evaluation");
        self.family(encoder, &return_mean, |sample| Some(sample.evaluation?.return_mean))?;
        let success_rate =
            gauge("dmprl_evaluation_success_rate", "", "Success rate in the newest evaluation");
        self.family(encoder, &success_rate, |sample| sample.evaluation?.success_rate)?;
        let smoothness = gauge(
            "dmprl_evaluation_smoothness",
            "",
            "Mean absolute change of an action in the newest evaluation",
        );
        self.family(encoder, &smoothness, |sample| Some(sample.evaluation?.smoothness))
    }

    /// Encodes one metric of all runs.
    fn family(
        &self,
        encoder: &mut DescriptorEncoder,
        metric: &Metric,
        value: impl Fn(&Sample) -> Option<f64>,
    ) -> fmt::Result {
        let kind = match metric.kind {
            Kind::Counter => MetricType::Counter,
            Kind::Gauge => MetricType::Gauge,
        };
        let mut family = encoder.encode_descriptor(metric.name, metric.help, None, kind)?;
        for sample in &self.0 {
            let Some(value) = value(sample) else { continue };
            let encoder = family.encode_family(&sample.labels)?;
            match metric.kind {
                Kind::Counter => ConstCounter::new(value).encode(encoder)?,
                Kind::Gauge => ConstGauge::new(value).encode(encoder)?,
            }
        }
        Ok(())
    }
}
