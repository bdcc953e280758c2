//! Exports the newest figures of every run to Prometheus, in the OpenMetrics text format.

use std::fmt;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Registry;
use serde_json::Value;

use super::catalogue::Catalogue;
use super::watched::{State, Watched};

/// Content type of the response.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// A figure: its name, its description, and its key in a line of `metrics.jsonl`.
struct Figure {
    name: &'static str,
    help: &'static str,
    key: &'static str,
    kind: Kind,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A total over the whole run. It only decreases if a resume goes back to a checkpoint.
    Total,
    Now,
}

const fn total(name: &'static str, key: &'static str, help: &'static str) -> Figure {
    Figure { name, help, key, kind: Kind::Total }
}

const fn now(name: &'static str, key: &'static str, help: &'static str) -> Figure {
    Figure { name, help, key, kind: Kind::Now }
}

/// Figures of `metrics.jsonl`. Means that are null have no sample.
const FIGURES: [Figure; 28] = [
    total("dmprl_env_steps", "env_steps", "Environment steps inserted"),
    total("dmprl_updates", "updates", "Updates done"),
    total("dmprl_segments", "segments", "Segments inserted"),
    total("dmprl_training_seconds", "wall_s", "Seconds of training, over all sessions"),
    total("dmprl_worker_restarts", "worker_restarts", "Starts of workers after a death"),
    total("dmprl_learner_restarts", "learner_restarts", "Starts of the learner after a death"),
    total("dmprl_env_failures", "env_failures", "Failures of environments"),
    total("dmprl_lost_segments", "lost", "Segments missing in the workers' sequences"),
    total("dmprl_produced_segments", "delivery.produced", "Segments finished by workers"),
    total("dmprl_received_segments", "delivery.received", "Segments inserted or refused"),
    now("dmprl_env_steps_per_second", "env_steps_per_s", "Environment steps a second, lately"),
    now("dmprl_updates_per_second", "updates_per_s", "Updates a second, lately"),
    now("dmprl_workers", "workers", "Workers that are attached"),
    now("dmprl_queued_segments", "queued_segments", "Segments waiting for the learner"),
    now("dmprl_replay_segments", "replay_segments", "Segments the replay holds"),
    now("dmprl_samples_per_insert", "samples_per_insert", "Updates x batch size / steps"),
    now("dmprl_updates_owed", "updates_owed", "Updates that the pacing still demands"),
    now("dmprl_policy_lag_p50", "policy_lag_p50", "Median of versions a policy is behind"),
    now("dmprl_policy_lag_max", "policy_lag_max", "Largest number of versions behind"),
    now("dmprl_critic_loss", "critic_loss", "Mean squared error of Q"),
    now("dmprl_actor_loss", "actor_loss", "The actor's loss"),
    now("dmprl_q_mean", "q_mean", "Mean Q over the samples"),
    now("dmprl_temperature", "temperature", "SAC: weight of the entropy"),
    now("dmprl_entropy", "entropy", "SAC, NDP: entropy of the policy"),
    now("dmprl_policy_loss", "policy_loss", "NDP: the policy's loss"),
    now("dmprl_value_loss", "value_loss", "NDP: the value's loss"),
    now("dmprl_training_return_mean", "training_return_mean", "Of episodes with exploration"),
    now("dmprl_training_success_rate", "training_success_rate", "Of episodes with exploration"),
];

/// The current figures of one run.
#[derive(Debug)]
struct Sample {
    labels: Vec<(&'static str, String)>,
    training: bool,
    steps_wanted: u64,
    last: Value,
    rejected: Vec<(String, f64)>,
    /// Return, success rate and smoothness of the newest evaluation.
    evaluation: Option<(f64, Option<f64>, f64)>,
}

#[derive(Debug)]
struct Samples(Vec<Sample>);

/// Returns the response to a scrape.
///
/// # Errors
/// None is known: it is written into memory.
pub fn text(catalogue: &mut Catalogue) -> anyhow::Result<String> {
    super::answers::refresh(catalogue);
    let whole = |(_, watched): &(&String, &Watched)| watched.fault.is_none();
    let samples = catalogue.runs.iter().filter(whole).map(|(name, run)| Sample::of(name, run));
    let mut registry = Registry::default();
    registry.register_collector(Box::new(Samples(samples.collect())));
    let mut text = String::new();
    encode(&mut text, &registry)?;
    Ok(text)
}

impl Sample {
    fn of(name: &str, watched: &Watched) -> Self {
        let facts = &watched.facts;
        let rejected = watched.last["rejected"].as_object().into_iter().flatten();
        Self {
            labels: vec![
                ("run", name.to_owned()),
                ("task", facts.task.clone()),
                ("algorithm", facts.algorithm.clone()),
                ("policy", facts.policy.clone()),
                ("seed", facts.seed.to_string()),
            ],
            training: watched.state == State::Training,
            steps_wanted: facts.steps,
            rejected: rejected
                .filter_map(|(reason, count)| Some((reason.clone(), count.as_f64()?)))
                .collect(),
            last: watched.last.clone(),
            evaluation: watched
                .evaluations
                .last()
                .map(|row| (row.return_mean, row.success_rate, row.smoothness)),
        }
    }

    fn number(&self, key: &str) -> Option<f64> {
        key.split('.').fold(&self.last, |value, key| &value[key]).as_f64()
    }
}

impl Collector for Samples {
    fn encode(&self, mut encoder: DescriptorEncoder) -> fmt::Result {
        for figure in &FIGURES {
            self.family(&mut encoder, figure, |sample| sample.number(figure.key))?;
        }
        let rejected = "Segments refused, by reason";
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
        let training = now("dmprl_training", "", "1 while the run is trained, else 0");
        self.family(&mut encoder, &training, |sample| Some(f64::from(u8::from(sample.training))))?;
        let wanted = now("dmprl_env_steps_wanted", "", "Environment steps the run was asked for");
        self.family(&mut encoder, &wanted, |sample| Some(sample.steps_wanted as f64))?;
        let mean = now("dmprl_evaluation_return_mean", "", "Of the newest evaluation");
        self.family(&mut encoder, &mean, |sample| sample.evaluation.map(|row| row.0))?;
        let rate = now("dmprl_evaluation_success_rate", "", "Of the newest evaluation");
        self.family(&mut encoder, &rate, |sample| sample.evaluation.and_then(|row| row.1))?;
        let smoothness = now(
            "dmprl_evaluation_smoothness",
            "",
            "Mean absolute change of an action in the newest evaluation",
        );
        self.family(&mut encoder, &smoothness, |sample| sample.evaluation.map(|row| row.2))
    }
}

impl Samples {
    fn family(
        &self,
        encoder: &mut DescriptorEncoder,
        figure: &Figure,
        value: impl Fn(&Sample) -> Option<f64>,
    ) -> fmt::Result {
        let kind = match figure.kind {
            Kind::Total => MetricType::Counter,
            Kind::Now => MetricType::Gauge,
        };
        let mut family = encoder.encode_descriptor(figure.name, figure.help, None, kind)?;
        for sample in &self.0 {
            let Some(value) = value(sample) else { continue };
            let encoder = family.encode_family(&sample.labels)?;
            match figure.kind {
                Kind::Total => ConstCounter::new(value).encode(encoder)?,
                Kind::Now => ConstGauge::new(value).encode(encoder)?,
            }
        }
        Ok(())
    }
}
