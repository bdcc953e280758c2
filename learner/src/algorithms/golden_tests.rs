//! Compares complete updates with an independent implementation in PyTorch.
//!
//! The numbers in tests/golden/update/*.safetensors come from make_golden.py in the same folder.
//! Its README lists the versions and the tensors.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use dmprl_shared::config::{Backend, Layers};
use safetensors::SafeTensors;
use serde_json::Value;

use super::*;
use crate::algorithms::tests::alone_on_gpu;
use crate::learner::tests::spec;

/// Maximum difference after the first updates, relative to a tensor's norm.
pub(super) const FIRST: f64 = 1e-5;
/// Maximum difference after all updates, relative to a tensor's norm.
const LAST: f64 = 1e-4;

pub(super) fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/update")
}

/// Returns the files of the algorithms that learn from a replay.
fn files() -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    let learns_from_batches = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_str().unwrap();
        name.ends_with(".safetensors") && !name.starts_with("ndp")
    };
    let mut files: Vec<_> = entries.filter(learns_from_batches).collect();
    files.sort();
    files
}

/// The file of one case.
pub(super) struct Golden {
    name: String,
    about: Value,
    /// Tensors by name. Compared tensors are removed.
    pub(super) tensors: BTreeMap<String, Vec<f32>>,
}

impl Golden {
    pub(super) fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let (_, metadata) = SafeTensors::read_metadata(&bytes).unwrap();
        let about = metadata.metadata().as_ref().unwrap()["about"].clone();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        let values = tensors.iter().map(|(name, tensor)| {
            let chunks = tensor.data().as_chunks::<4>().0;
            (name.to_owned(), chunks.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
        });
        Self {
            name: path.file_stem().unwrap().to_str().unwrap().to_owned(),
            about: serde_json::from_str(&about).unwrap(),
            tensors: values.collect(),
        }
    }

    pub(super) fn updates(&self) -> usize {
        self.about["updates"].as_u64().unwrap() as usize
    }

    pub(super) fn config(&self) -> ExperimentConfig {
        let mut layers = Layers::new();
        // Penalties are not part of the implementation that made the files. The other is 0 anyway.
        layers.set("golden file", "algorithm.action_rate_penalty", "0.0").unwrap();
        for (key, value) in self.about["configuration"].as_object().unwrap() {
            layers.set("golden file", key, value.as_str().unwrap()).unwrap();
        }
        layers.finish().unwrap()
    }

    /// Copies the part of a batch tensor that belongs to update `index`.
    fn fill(&self, name: &str, index: usize, out: &mut [f32]) {
        let all = &self.tensors[&format!("batch.{name}")];
        let len = all.len() / self.updates();
        out.copy_from_slice(&all[index * len..(index + 1) * len]);
    }

    fn fill_batch(&self, shape: BatchShape, index: usize, batch: &mut Batch) {
        self.fill("critic_inputs", index, &mut batch.critic_inputs);
        self.fill("rewards", index, &mut batch.rewards);
        self.fill("bootstrap", index, &mut batch.bootstrap);
        self.fill("next_observations", index, &mut batch.next_observations);
        // The observations are the first columns of the critic inputs.
        let inputs = batch.critic_inputs.chunks_exact(shape.critic_inputs());
        let rows = batch.observations.chunks_exact_mut(shape.observation_len).zip(inputs);
        rows.for_each(|(row, input)| row.copy_from_slice(&input[..row.len()]));
        // Normalisation is off.
        batch.inputs.copy_from_slice(&batch.observations);
        batch.next_inputs.copy_from_slice(&batch.next_observations);
        for (name, out) in [
            (if shape.noise { "next_noise" } else { "target_noise" }, &mut batch.next_noise),
            ("noise", &mut batch.noise),
        ] {
            if !out.is_empty() {
                self.fill(name, index, out);
            }
        }
    }

    /// Sets every network and target to the file's initial parameters.
    fn start(&self, algorithm: &mut Algorithm) {
        let initial = |name: &str| &self.tensors[&format!("initial.{name}")];
        algorithm
            .for_each_network(|name, network| {
                network.parameters.set(initial(name))?;
                match &mut network.target {
                    Some(target) => target.set(initial(&format!("{name}_target"))),
                    None => Ok(()),
                }
            })
            .unwrap();
    }

    /// Runs all updates by kernels or graphs and compares them with the file.
    fn check(mut self, backend: Backend, device: config::Device) {
        let _alone = alone_on_gpu();
        let mut config = self.config();
        config.learner.backend = backend;
        config.learner.device = device;
        let policy = Policy::new(config.policy_description(&spec())).unwrap();
        let mut algorithm = Algorithm::new(&config, &policy, None).unwrap();
        assert_eq!(algorithm.replica.is_some(), config.updates_by_graph());
        let shape = algorithm.batch_shape();
        let mut batch = Batch::new(shape);
        self.start(&mut algorithm);
        for index in 0..self.updates() {
            self.fill_batch(shape, index, &mut batch);
            let log_temperature = log_temperature(&algorithm);
            let update = index as u64 + 1;
            let losses = algorithm.update(&policy, &batch, update).unwrap();
            algorithm.fetch().unwrap();
            let ours = ours(&algorithm, losses, log_temperature, &config);
            self.compare(index + 1, &ours);
        }
        if config.updates_by_graph() {
            // A graph does not keep its targets.
            self.tensors.retain(|name, _| !name.ends_with(".targets"));
        }
        self.assert_all_compared();
    }

    /// Fails if a tensor of an update was not compared.
    pub(super) fn assert_all_compared(&self) {
        let left: Vec<_> = self.tensors.keys().filter(|name| name.starts_with("update_")).collect();
        assert!(left.is_empty(), "{}: nothing was compared with {left:?}", self.name);
    }

    /// Compares with the file's tensors of this update and removes them.
    pub(super) fn compare(&mut self, update: usize, ours: &BTreeMap<String, Vec<f32>>) {
        let tolerance = if update == self.updates() { LAST } else { FIRST };
        self.compare_with(&format!("update_{update}."), ours, tolerance);
    }

    /// Compares with the tensors whose names begin with `prefix` and removes them.
    pub(super) fn compare_with(
        &mut self,
        prefix: &str,
        ours: &BTreeMap<String, Vec<f32>>,
        tolerance: f64,
    ) {
        for (name, got) in ours {
            let Some(expected) = self.tensors.remove(&format!("{prefix}{name}")) else { continue };
            assert_close(&format!("{}, {prefix}{name}", self.name), got, &expected, tolerance);
        }
    }
}

fn log_temperature(algorithm: &Algorithm) -> Option<f32> {
    let networks = algorithm.networks();
    let (_, network) = networks.into_iter().find(|(name, _)| *name == "log_temperature")?;
    network.parameters.values().first().copied()
}

/// Returns the results of an update under the names that the files use.
fn ours(
    algorithm: &Algorithm,
    losses: Losses,
    log_temperature: Option<f32>,
    config: &ExperimentConfig,
) -> BTreeMap<String, Vec<f32>> {
    let shards = match &algorithm.kind {
        Kind::Ddpg(ddpg) => &ddpg.shards,
        Kind::Td3(td3) => &td3.shards,
        Kind::Sac(sac) => &sac.shards,
        Kind::Graph(_) => &Vec::new(),
    };
    let mut ours = BTreeMap::from([("loss.critic".to_owned(), vec![losses.critic_loss])]);
    if !config.updates_by_graph() {
        let targets = shards.iter().flat_map(|shard| shard.targets.iter().copied()).collect();
        ours.insert("targets".to_owned(), targets);
    }
    if let Some(loss) = losses.actor_loss {
        ours.insert("loss.actor".into(), vec![loss]);
    }
    if let (Some(entropy), Some(log_temperature)) = (losses.entropy, log_temperature) {
        let per_action = config.algorithm.sac.target_entropy_per_action as f32;
        let target = per_action * algorithm.shape.segment_actions_len as f32;
        ours.insert("loss.temperature".into(), vec![log_temperature * (entropy - target)]);
    }
    for (name, network) in algorithm.networks() {
        ours.insert(format!("gradient.{name}"), network.gradient().to_vec());
        ours.insert(format!("parameters.{name}"), network.parameters.values().to_vec());
        if let Some(target) = &network.target {
            ours.insert(format!("parameters.{name}_target"), target.values().to_vec());
        }
    }
    ours
}

fn assert_close(what: &str, got: &[f32], expected: &[f32], tolerance: f64) {
    assert_eq!(got.len(), expected.len(), "{what}");
    let norm = |values: &mut dyn Iterator<Item = f32>| {
        values.map(|value| f64::from(value).powi(2)).sum::<f64>().sqrt()
    };
    let size = norm(&mut expected.iter().copied());
    let lost = norm(&mut got.iter().zip(expected).map(|(a, b)| a - b)) / size;
    assert!(size > 1e-6, "{what}: nothing to compare");
    assert!(lost < tolerance, "{what}: differs by {lost:.1e} of its norm");
}

#[test]
fn every_update_equals_that_of_an_independent_implementation() {
    let files = files();
    for algorithm in ["ddpg", "td3", "sac", "tqc"] {
        for policy in ["dmp", "mlp", "chunk"] {
            let file = folder().join(format!("{algorithm}_{policy}.safetensors"));
            assert!(files.contains(&file), "no {}", file.display());
        }
    }
    for file in &files {
        let golden = Golden::read(file);
        if !golden.config().algorithm.name.is_graph_only() {
            golden.check(Backend::Kernels, config::Device::Cpu);
        }
        Golden::read(file).check(Backend::Graph, config::Device::Cpu);
        if cfg!(feature = "cuda") {
            Golden::read(file).check(Backend::Graph, config::Device::Cuda);
        }
    }
}

#[test]
fn golden_updates_name_the_versions_they_come_from() {
    let requirements = std::fs::read_to_string(folder().join("requirements.txt")).unwrap();
    for file in files() {
        let about = Golden::read(&file).about;
        let torch = about["versions"]["torch"].as_str().unwrap();
        assert!(requirements.contains(&format!("\ntorch=={torch}\n")), "{file:?}: {torch}");
        assert_eq!(about["script"], "tests/golden/update/make_golden.py");
    }
}
