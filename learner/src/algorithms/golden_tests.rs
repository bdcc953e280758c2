//! Whole updates against an independent implementation in PyTorch.
//!
//! The numbers are those of tests/golden/update/*.safetensors, which make_golden.py beside them
//! computed; the README there says with which versions and what the tensors are.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use dmprl_shared::config::Layers;
use safetensors::SafeTensors;
use serde_json::Value;

use super::*;
use crate::learner::tests::spec;

/// Of a tensor's norm, after an update or two and after all.
pub(super) const FIRST: f64 = 1e-5;
const LAST: f64 = 1e-4;

pub(super) fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/golden/update")
}

/// Of the algorithms that learn from a replay.
fn files() -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    let learns_from_batches = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_str().unwrap();
        let kinds = ["ddpg_", "td3_", "sac_"];
        kinds.iter().any(|kind| name.starts_with(kind)) && name.ends_with(".safetensors")
    };
    let mut files: Vec<_> = entries.filter(learns_from_batches).collect();
    files.sort();
    files
}

/// A file of one case.
pub(super) struct Golden {
    name: String,
    about: Value,
    /// By their names there; what has been compared is taken out.
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
        // A price of ours, which what the files were made with does not know.
        layers.set("golden file", "algorithm.action_rate_penalty", "0.0").unwrap();
        for (key, value) in self.about["configuration"].as_object().unwrap() {
            layers.set("golden file", key, value.as_str().unwrap()).unwrap();
        }
        layers.finish().unwrap()
    }

    /// Copies update `index`'s share of a tensor that has one for each update.
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
        // They are the first columns of the critic's inputs.
        let inputs = batch.critic_inputs.chunks_exact(shape.critic_inputs());
        let rows = batch.observations.chunks_exact_mut(shape.observation_len).zip(inputs);
        rows.for_each(|(row, input)| row.copy_from_slice(&input[..row.len()]));
        // Nothing is normalised.
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

    /// Gives every network and target the parameters that the file begins with.
    fn start(&self, algorithm: &mut Algorithm) {
        let initial = |name: &str| &self.tensors[&format!("initial.{name}")];
        algorithm
            .each_network(|name, trained| {
                trained.network.set(initial(name))?;
                match &mut trained.target {
                    Some(target) => target.set(initial(&format!("{name}_target"))),
                    None => Ok(()),
                }
            })
            .unwrap();
    }

    /// Runs all updates and compares everything that the file holds of them.
    fn check(mut self) {
        let config = self.config();
        let policy = Policy::new(&config, &spec()).unwrap();
        let mut algorithm = Algorithm::new(&config, &policy).unwrap();
        let shape = algorithm.batch_shape();
        let mut batch = Batch::new(shape);
        self.start(&mut algorithm);
        for index in 0..self.updates() {
            self.fill_batch(shape, index, &mut batch);
            let log_temperature = log_temperature(&algorithm);
            let update = index as u64 + 1;
            let losses = algorithm.update(&policy, &batch, update).unwrap();
            let ours = ours(&algorithm, losses, log_temperature, &config);
            self.compare(index + 1, &ours);
        }
        self.assert_all_compared();
    }

    /// Nothing that the file holds of updates may be left.
    pub(super) fn assert_all_compared(&self) {
        let left: Vec<_> = self.tensors.keys().filter(|name| name.starts_with("update_")).collect();
        assert!(left.is_empty(), "{}: nothing was compared with {left:?}", self.name);
    }

    /// Compares with what the file has of this update, and takes it out.
    pub(super) fn compare(&mut self, update: usize, ours: &BTreeMap<String, Vec<f32>>) {
        let tolerance = if update == self.updates() { LAST } else { FIRST };
        self.compare_with(&format!("update_{update}."), ours, tolerance);
    }

    /// As [`Golden::compare`], with the tensors whose names begin with `prefix`.
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
    let (_, trained) = networks.into_iter().find(|(name, _)| *name == "log_temperature")?;
    trained.network.values().first().copied()
}

/// What an update has left, by the names that the files use.
fn ours(
    algorithm: &Algorithm,
    losses: Losses,
    log_temperature: Option<f32>,
    config: &ExperimentConfig,
) -> BTreeMap<String, Vec<f32>> {
    let blocks = match &algorithm.kind {
        Kind::Ddpg(ddpg) => &ddpg.blocks,
        Kind::Td3(td3) => &td3.blocks,
        Kind::Sac(sac) => &sac.blocks,
        Kind::Ndp(_) => panic!("an on-policy algorithm has no blocks of a batch"),
    };
    let targets = blocks.iter().flat_map(|block| block.targets.iter().copied()).collect();
    let mut ours = BTreeMap::from([
        ("targets".to_owned(), targets),
        ("loss.critic".to_owned(), vec![losses.critic_loss]),
    ]);
    if let Some(loss) = losses.actor_loss {
        ours.insert("loss.actor".into(), vec![loss]);
    }
    if let (Some(entropy), Some(log_temperature)) = (losses.entropy, log_temperature) {
        let per_action = config.algorithm.sac.target_entropy_per_action as f32;
        let target = per_action * algorithm.shape.segment_actions_len as f32;
        ours.insert("loss.temperature".into(), vec![log_temperature * (entropy - target)]);
    }
    for (name, trained) in algorithm.networks() {
        ours.insert(format!("gradient.{name}"), trained.gradient().to_vec());
        ours.insert(format!("parameters.{name}"), trained.network.values().to_vec());
        if let Some(target) = &trained.target {
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
    for kind in ["ddpg_dmp", "ddpg_mlp", "td3_dmp", "td3_mlp", "sac_dmp", "sac_mlp"] {
        let file = folder().join(kind).with_extension("safetensors");
        assert!(files.contains(&file), "no {kind}");
    }
    files.iter().for_each(|file| Golden::read(file).check());
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
